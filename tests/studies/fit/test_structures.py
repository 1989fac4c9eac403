"""Fit with structures: sentences, tables, and result.json."""

from __future__ import annotations

import functools
import json
from typing import Any

import numpy as np
import pytest

from experiments.driver import with_noise
from experiments.printed_intervals import carts
from impc.assess.lack_of_fit import LackOfFit, ModelError
from impc.checking import replace
from impc.control.controller import Controller
from impc.errors import InputError
from impc.inverse.noisy_fit import fit_controller
from impc.levels import Level
from impc.model.bounds import Bounds
from impc.model.weights import Weights
from impc.reporting.document import Report
from impc.reporting.verdict import Verdict
from impc.studies.fit.asked import fit_problem, fit_structures
from impc.studies.fit.result import FitResult
from impc.studies.fit.settings import FitSettings, fit_settings
from impc.studies.fit.structures import (
    structure_data,
    structure_section,
    structure_sentences,
)
from impc.studies.fit.subject import fit_recordings, stages
from impc.studies.fit.verdict import fit_verdict

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
    plant = carts(2)
    Q = np.diag([4.0, 5.0, 1.0, 1.0])
    Q[0, 1] = Q[1, 0] = cross * np.sqrt(20.0)
    limits = Bounds(plant, u_min=-1, u_max=1)
    truth = Controller(plant, Weights(Q, np.eye(2)), limits, 8, terminal_set=False)
    rng = np.random.default_rng(4)
    pushes = np.repeat(rng.choice([-0.8, 0.0, 0.8], (2, 40, 2)), 10, axis=1)
    trials = [with_noise(truth, push, rng, 98.0, 0.0) for push in pushes]
    settings = fit_settings(TABLE)
    return fit_recordings(fit_problem(plant, trials, settings), settings)


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
    held = [
        item.holds(np.log(truth[name])) for name, item in zip(truth, found.intervals, strict=True)
    ]
    assert sum(held) >= 4  # with a coverage of 95 % each


@pytest.mark.full
def test_a_cost_weight_of_zero_makes_the_intervals_less_sure() -> None:
    result = fitted(0.0)
    found = result.structures[0]
    assert found.estimate is not None
    assert not any("best cost weight is zero" in line for line in structure_sentences(result))
    cost_weights = np.array(found.estimate.cost_weights)
    cost_weights[3] = -np.inf
    zero = replace(found, estimate=replace(found.estimate, cost_weights=cost_weights))
    lines = structure_sentences(replace(result, structures=(zero, *result.structures[1:])))
    assert any(line.startswith("If the best cost weight is zero") for line in lines)


@pytest.mark.full
def test_a_rejection_may_be_the_fault_of_the_model() -> None:
    result = fitted(0.5)
    assert not any("error of the body model" in line for line in structure_sentences(result))
    wrong = (LackOfFit((ModelError("delay", 1e-5, 11.5, 1.0, 0.1),), alarm=True, untestable=()),)
    assert "error of the body model" in structure_sentences(replace(result, lack=wrong))[1]
    whole = replace(fitted(0.0), lack=wrong)
    assert not any("error of the body model" in line for line in structure_sentences(whole))


@pytest.mark.full
def test_a_structure_that_does_not_hold_is_rejected_first() -> None:
    result = fitted(0.5)
    assert result.structures[0].refused
    lines = structure_sentences(result)
    assert lines[0].startswith("The recordings reject the structure “one by one”")
    assert not any("combinations" in line for line in lines)
    assert any(
        "rejects" in one.title or "reject the" in one.title for one in fit_verdict(result).alerts
    )


@pytest.mark.full
def test_the_section_has_every_structure() -> None:
    result = fitted(0.0)
    section = structure_section(result)
    found = {
        item.name: item
        for item in Report("", "", Verdict(Level.NOTE, "", ""), [section]).findings()
    }
    side_by_side = found["structures"].rows
    assert [row[0] for row in side_by_side] == ["weights of any kind", "one by one", "positions"]
    assert side_by_side[2][-1] == "rejected"  # no cost weight on speeds
    assert {"structure_ratios", "structure_power"} < set(found)
    kept = structure_data(result)
    assert [item["name"] for item in kept] == ["one by one", "positions"]
    assert len(found["structure_cost_weights"].rows) == 5
    json.dumps([item["refused"] for item in kept])


def test_settings_name_structures() -> None:
    settings = fit_settings(TABLE)
    found = fit_structures(carts(2), settings)
    assert [item.name for item in found] == ["one by one", "positions"]
    assert fit_structures(carts(2), FitSettings()) == ()
    with pytest.raises(InputError, match=r"^\[fit.structures\[0\]\] features: is not a setting"):
        fit_settings({"structures": [{"features": ["x[0]"]}]})
    with pytest.raises(InputError, match=r"^\[fit.structure\] Q: Expected"):
        fit_settings({"structure": {"Q": 3}})
    plain = fit_settings({**TABLE, "structure": None, "structures": []})
    problem = fitted(0.0).given
    assert len(stages(problem, settings)) == len(stages(problem, plain)) + 2


def test_the_fit_begins_with_what_is_fitted_without_a_structure() -> None:
    """A structure adds results and changes no others."""
    result = fitted(0.0)
    again = fit_controller(result.given)
    np.testing.assert_array_equal(again.gain, result.fitted.gain)
