"""Solutions that another method beats in their own model are searched again or reported."""

from __future__ import annotations

import control
import numpy as np
import pytest

import impc
from impc.checking import replace
from impc.control.closed_loop import simulate
from impc.inverse.cross_check import cross_checked
from impc.inverse.problem import Problem, controller_for, misfit, scenarios


@pytest.fixture(scope="module")
def problem() -> Problem:
    """Noisy cart at its limit."""
    system = control.ss(
        [[1, 0.1], [0, 1]], [[0.005, 0], [0.1, 0.1]], np.eye(2), 0, 0.1, inputs=["u", "push"]
    )
    plant, rng = impc.Plant(system, ["u"]), np.random.default_rng(6)
    bounds = impc.Bounds(plant, u_min=-1, u_max=1)
    law = impc.Controller(
        plant, impc.Weights(np.diag([3.0, 1.0]), 1), bounds, 4, terminal_set=False
    )
    push = rng.choice([-1.1, 0, 1.1], 30).repeat(8)
    x = law.simulate(np.zeros(2), disturbance=push).x[:-1]
    trial = impc.Recording(plant, x + 0.02 * rng.standard_normal(x.shape), push)
    return Problem(plant, bounds, 4, (trial,), terminal_set=False, unknown_start=True)


def at(problem: Problem, K: np.ndarray, S: np.ndarray) -> float:
    law = controller_for(problem, K, S)
    return misfit(problem, [simulate(law, drive) for drive in scenarios(problem)])


def fitted(problem: Problem, names: list[str]) -> dict[str, impc.Estimate]:
    start = impc.fit(problem)
    return {name: impc.fit(problem, name, start=start) for name in names}


def test_a_method_that_loses_begins_again(problem: Problem) -> None:
    """Poor starting weights for inverse MPC and for the search without bounds."""
    names = ["feedback_gain", "inverse_lqr_output", "inverse_mpc"]
    found = fitted(problem, names)
    poor = impc.solve_lqr(problem.plant, impc.Weights(np.eye(2) * 50, 1))
    changed = dict(found)
    for name in ("inverse_lqr_output", "feedback_gain"):
        one = found[name]
        left = at(one.problem, np.array(poor.K), np.array(poor.S))
        assert left > 1.01 * one.misfit
        changed[name] = replace(one, K=poor.K, S=poor.S, weights=poor.weights, misfit=left)
    checked = cross_checked(problem, changed)
    for name in names:
        assert checked[name].misfit <= found[name].misfit * (1 + 2e-3)
        assert not checked[name].fit.beaten_by
    worse = replace(found["inverse_mpc"], K=poor.K, S=poor.S, weights=poor.weights)
    worse = replace(worse, misfit=at(worse.problem, np.array(poor.K), np.array(poor.S)))
    checked = cross_checked(problem, found | {"inverse_mpc": worse})
    assert checked["inverse_mpc"].misfit <= found["inverse_mpc"].misfit * (1 + 1e-4)


def test_no_answer_is_beaten_and_nested_models_are_ordered(problem: Problem) -> None:
    """The free gain fits no worse than weights without bounds; each is best in its model."""
    names = ["feedback_gain", "inverse_lqr_gradient", "inverse_lqr_output", "inverse_mpc"]
    found = cross_checked(problem, fitted(problem, names))
    assert found["feedback_gain"].misfit <= found["inverse_lqr_output"].misfit * (1 + 1e-3)
    assert found["inverse_lqr_output"].misfit <= found["inverse_lqr_gradient"].misfit * (1 + 1e-3)
    for own in (found["inverse_mpc"], found["inverse_lqr_output"]):
        for other in found.values():
            if other.weights is not None:
                left = at(own.problem, other.gain, other.metric)
                assert own.misfit <= left * (1 + 1e-3)
