"""Solutions that another method beats in their own model are searched again or reported."""

from __future__ import annotations

import functools

import control
import numpy as np
import pytest

import impc
from impc.arrays import Array
from impc.control.closed_loop import simulate
from impc.inverse.cross_check import cross_checked
from impc.inverse.problem import controller_for, misfit, scenarios
from tests.support import posed, regulator


@functools.cache
def noisy_cart() -> impc.Problem:
    """Noisy cart at its limit."""
    system = control.ss(
        [[1, 0.1], [0, 1]], [[0.005, 0], [0.1, 0.1]], np.eye(2), 0, 0.1, inputs=["u", "push"]
    )
    plant, rng = impc.Plant(system, ["u"]), np.random.default_rng(6)
    law = regulator(plant, np.diag([3.0, 1.0]), 1, 4)
    push = rng.choice([-1.1, 0, 1.1], 30).repeat(8)
    x = law.simulate(np.zeros(2), disturbance=push).x[:-1]
    trial = impc.Recording(plant, x + 0.02 * rng.standard_normal(x.shape), push)
    return posed(law, trial, terminal_set=False, unknown_start=True)


@functools.cache
def fitted() -> dict[str, impc.Estimate]:
    start = impc.fit(noisy_cart())
    names = ("feedback_gain", "inverse_lqr_gradient", "inverse_lqr_output", "inverse_mpc")
    return {name: impc.fit(noisy_cart(), name, start=start) for name in names}


def at(problem: impc.Problem, K: Array, S: Array) -> float:
    law = controller_for(problem, K, S)
    return misfit(problem, [simulate(law, drive) for drive in scenarios(problem)])


@pytest.mark.parametrize(
    ("worse", "rel"), [(("inverse_lqr_output", "feedback_gain"), 2e-3), (("inverse_mpc",), 1e-4)]
)
def test_a_method_that_loses_begins_again(worse: tuple[str, ...], rel: float) -> None:
    """Poor weights for inverse MPC, and for the search without bounds."""
    names = ("feedback_gain", "inverse_lqr_output", "inverse_mpc")
    found = {name: fitted()[name] for name in names}
    poor, changed = impc.solve_lqr(noisy_cart().plant, impc.Weights(np.eye(2) * 50, 1)), dict(found)
    for name in worse:
        one = found[name]
        left = at(one.problem, np.array(poor.K), np.array(poor.S))
        assert left > 1.01 * one.misfit
        changed[name] = impc.replace(one, K=poor.K, S=poor.S, weights=poor.weights, misfit=left)
    checked = cross_checked(noisy_cart(), changed)
    for name in names:
        assert checked[name].misfit <= found[name].misfit * (1 + rel)
        assert not checked[name].fit.beaten_by


def test_no_answer_is_beaten_and_nested_models_are_ordered() -> None:
    """The free gain fits no worse than weights without bounds; each is best in its model."""
    found = cross_checked(noisy_cart(), fitted())
    output = found["inverse_lqr_output"]
    assert found["feedback_gain"].misfit <= output.misfit * (1 + 1e-3)
    assert output.misfit <= found["inverse_lqr_gradient"].misfit * (1 + 1e-3)
    for own in (found["inverse_mpc"], output):
        for other in found.values():
            if other.weights is not None:
                assert own.misfit <= at(own.problem, other.gain, other.metric) * (1 + 1e-3)
