"""Report of a single estimate from Python."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from impc.control.controller import Controller
from impc.inverse.estimates import Estimate
from impc.inverse.methods import fit
from impc.inverse.problem import Problem
from impc.model.bounds import Bounds
from impc.model.plant import Plant
from impc.model.recordings import Recording
from impc.model.weights import Weights
from impc.studies.estimate_page import report
from plants import yalmip_example


@pytest.fixture(scope="module")
def problem() -> Problem:
    plant = Plant(yalmip_example())
    bounds = Bounds(plant, u_min=-1, u_max=1)
    law = Controller(plant, Weights([[1, 0], [0, 1]], 1), bounds, 3)
    return Problem(plant, bounds, 3, [Recording(plant, law.simulate([1, 3], 20).x)])


@pytest.fixture(scope="module")
def estimate(problem: Problem) -> Estimate:
    return fit(problem)


def test_it_explains_and_says_what_is_missing(estimate: Estimate, tmp_path: Path) -> None:
    names = {path.relative_to(tmp_path).as_posix() for path in report(estimate, tmp_path)}
    assert {"report.html", "result.json", "gain.csv", "figures/trial-1.svg"} < names
    found = json.loads((tmp_path / "result.json").read_text(encoding="utf-8"))
    assert found["verdict"]["level"] == "amber"  # neither intervals nor left-out trials
    assert "explains 100.00 %" in found["verdict"]["headline"]
    assert any("interval" in line for line in found["verdict"]["may_not_report"])
    gain = pd.read_csv(tmp_path / "gain.csv")["value"]
    np.testing.assert_allclose(gain, np.ravel(estimate.gain))


def test_a_method_that_knows_no_limit_is_said_to_know_none(
    problem: Problem, estimate: Estimate, tmp_path: Path
) -> None:
    report(fit(problem, "feedback_gain", start=estimate), tmp_path)
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "1.23" in page
    assert '<span class="detail">no limit</span>' in page
