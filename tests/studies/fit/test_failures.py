"""Report of a fit if a stage fails, the VAF is low, or no weights have the gain."""

from __future__ import annotations

import json
from functools import cache
from typing import Any

import numpy as np
import pytest

import impc
from experiments.search_problems import stick
from impc.errors import SolverError
from impc.levels import Level
from impc.reporting.provenance import Provenance
from impc.studies.fit import first, subject
from impc.studies.fit.report import fit_report
from impc.studies.fit.result import FitResult
from impc.studies.fit.subject import fit_recordings
from impc.studies.fit.verdict import WEIGHTS, fit_verdict, forbidden


@cache
def posed(angle: float, rate: float, noise: float) -> tuple[impc.Problem, impc.FitSettings]:
    """A stick balanced by a gain, with recording noise (rad)."""
    plant, rng = impc.Plant(stick(), ["finger"]), np.random.default_rng(5)
    bounds = impc.Bounds(plant, u_min=-6, u_max=6)
    law = impc.Controller.from_gain(plant, [[angle, rate]], bounds, 5, terminal_set=False)
    push = rng.choice([-1.2, 0, 1.2], 30).repeat(10)
    seen = law.simulate(np.zeros(2), disturbance=push).x[:-1, :1]
    trial = impc.Recording(plant, seen + noise * rng.standard_normal(seen.shape), push)
    settings = impc.FitSettings(horizon=5, u_max=6.0)
    return impc.fit_problem(plant, [trial], settings), settings


def fitted(angle: float = -25.0, rate: float = -7.0, noise: float = 3e-4) -> FitResult:
    return fit_recordings(*posed(angle, rate, noise))


def data(result: FitResult) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(fit_report(result, Provenance()).files()["result.json"])
    return found


@pytest.mark.full
def test_less_than_half_explained_gives_no_interval_and_no_statement() -> None:
    """Noise of three times the motion."""
    result = fitted(noise=0.15)
    found = data(result)
    assert np.max(result.inverse_mpc.vaf) < 50
    assert found["usable"] is False
    assert not {"gain", "directions", "statements"} & set(found["findings"])
    assert fit_verdict(result).level is Level.RED
    assert found["verdict"]["level"] == "red"
    assert data(fitted())["usable"] is True


def test_no_weights_is_said_before_any_weights() -> None:
    """A gain without weights, with little noise, and the gain of a regulator."""
    result = fitted(-60.0, -4.0)
    assert result.weights_test.rejected
    verdict = fit_verdict(result)
    assert "no cost weights explain it" in verdict.headline
    assert WEIGHTS in forbidden(result)
    assert np.min(result.gain_shares) > 99
    assert f"{result.gain_shares[0]:.0f} %" in verdict.may[0].why
    assert "statements" not in data(result)["findings"]
    assert not fitted().weights_test.rejected


def test_a_stage_that_fails_is_one_sentence_in_its_place(monkeypatch: pytest.MonkeyPatch) -> None:
    """Drawn gains and the test of the model fail: the gain is still reported."""

    def fails(*_: Any, **__: Any) -> Any:
        raise SolverError("stage", "did not end", "try another")

    whole = fitted()
    monkeypatch.setattr(subject, "estimate_draws", fails)
    monkeypatch.setattr(first, "lack_of_fit", fails)
    result = fitted()
    assert set(result.failures) == {"drawn gains", "test of the model"}
    page = fit_report(result, Provenance()).page()
    for stage in result.failures:
        assert f"Not available: {stage}" in page
    np.testing.assert_array_equal(result.estimate.K, whole.estimate.K)
    assert data(result)["failures"] == dict(result.failures)
