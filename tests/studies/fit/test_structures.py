"""Fit with structures: sentences, tables, and result.json."""

from __future__ import annotations

import functools
import json
import re
from typing import Any

import numpy as np
import pytest

import impc
from experiments.driver import with_noise
from experiments.printed_intervals import carts
from impc.inverse.noisy_fit import fit_controller
from impc.levels import Level
from impc.reporting.document import Report
from impc.reporting.verdict import Verdict
from impc.studies.fit.asked import fit_structures
from impc.studies.fit.result import FitResult
from impc.studies.fit.settings import fit_settings
from impc.studies.fit.structures import structure_data, structure_section, structure_sentences
from impc.studies.fit.subject import fit_recordings, stages
from impc.studies.fit.verdict import RULES
from tests.studies.fit.test_verdict import model_error
from tests.support import regulator

TABLE: dict[str, Any] = {
    "horizon": 8,
    "u_max": 1.0,
    "methods": [],
    "held_out": True,
    "settle": 2.0,
    "intent_draws": False,
    "structure": {"Q": ["x[0]", "x[1]", "x[2]", "x[3]"], "name": "one by one"},
    "structures": [{"Q": "full", "over": ["x[0]", "x[1]"], "name": "positions"}],
}


@functools.cache
def fitted(cross: float) -> FitResult:
    """Two carts, two trials of 40 s at a VAF of 98 %, positions penalised together by `cross`."""
    plant, rng, Q = carts(2), np.random.default_rng(4), np.diag([4.0, 5.0, 1.0, 1.0])
    Q[0, 1] = Q[1, 0] = cross * np.sqrt(20.0)
    truth = regulator(plant, Q, 1, 8, np.eye(2))
    pushes = np.repeat(rng.choice([-0.8, 0.0, 0.8], (2, 40, 2)), 10, axis=1)
    trials = [with_noise(truth, push, rng, 98.0, 0.0) for push in pushes]
    settings = fit_settings(TABLE)
    return fit_recordings(impc.fit_problem(plant, trials, settings), settings)


@pytest.mark.full
def test_statements_within_a_structure_that_holds() -> None:
    result = fitted(0.0)
    lines = structure_sentences(result)
    assert lines[0].startswith("The recordings do not reject the structure “one by one” (p")
    assert any("identify 5 combinations" in line for line in lines)
    found = result.structures[0]
    ratio = next(item for item in found.ratios if item.first == "x[0]")
    assert ratio.interval.low < ratio.interval.value < ratio.interval.high
    truth = {"x[0]": 4.0, "x[1]": 5.0, "x[2]": 1.0, "x[3]": 1.0, "force2": 1.0}
    pairs = zip(truth.values(), found.intervals, strict=True)
    held = [item.holds(np.log(value)) for value, item in pairs]
    assert sum(held) >= 4  # with a coverage of 95 % each


@pytest.mark.full
def test_a_cost_weight_of_zero_makes_the_intervals_less_sure() -> None:
    result = fitted(0.0)
    found = result.structures[0]
    assert found.estimate is not None
    assert not any("best cost weight is zero" in line for line in structure_sentences(result))
    cost_weights = np.array(found.estimate.cost_weights)
    cost_weights[3] = -np.inf
    zero = impc.replace(found, estimate=impc.replace(found.estimate, cost_weights=cost_weights))
    lines = structure_sentences(impc.replace(result, structures=(zero, *result.structures[1:])))
    assert any(line.startswith("If the best cost weight is zero") for line in lines)


@pytest.mark.full
def test_a_rejection_comes_first_and_may_be_the_fault_of_the_model() -> None:
    result = fitted(0.5)
    lines = structure_sentences(result)
    assert result.structures[0].refused
    assert lines[0].startswith("The recordings reject the structure “one by one”")
    assert not any("combinations" in line or "error of the body model" in line for line in lines)
    assert any(re.search("rejects|reject the", one.title) for one in RULES.verdict(result).alerts)
    wrong = impc.replace(result, lack=(model_error(),))
    assert "error of the body model" in structure_sentences(wrong)[1]
    whole = impc.replace(fitted(0.0), lack=(model_error(),))
    assert not any("error of the body model" in line for line in structure_sentences(whole))


@pytest.mark.full
def test_the_section_has_every_structure() -> None:
    result = fitted(0.0)
    report = Report("", "", Verdict(Level.NOTE, "", ""), [structure_section(result)])
    found = {item.name: item for item in report.findings()}
    side_by_side = found["structures"].rows
    assert [row[0] for row in side_by_side] == ["weights of any kind", "one by one", "positions"]
    assert side_by_side[2][-1] == "rejected"  # no cost weight on speeds
    assert {"structure_ratios", "structure_power"} < set(found)
    kept = structure_data(result)
    assert [item["name"] for item in kept] == ["one by one", "positions"]
    assert len(found["structure_cost_weights"].rows) == 5
    json.dumps([item["refused"] for item in kept])


def test_settings_name_structures_which_change_no_other_result() -> None:
    settings = fit_settings(TABLE)
    found = fit_structures(carts(2), settings)
    assert [item.name for item in found] == ["one by one", "positions"]
    assert fit_structures(carts(2), impc.FitSettings()) == ()
    plain = fit_settings({**TABLE, "structure": None, "structures": []})
    problem = fitted(0.0).given
    assert len(stages(problem, settings)) == len(stages(problem, plain)) + 2
    # A structure adds results and changes no others.
    np.testing.assert_array_equal(fit_controller(problem).gain, fitted(0.0).fitted.gain)
