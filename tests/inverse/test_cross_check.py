"""Solutions that another method beats in their own model are searched again or reported."""

from __future__ import annotations

import numpy as np
import pytest

import impc
from experiments.coverage import cart, noisy_trial
from impc.inverse.cross_check import cross_checked
from impc.inverse.residuals import misfit_or_reason

METHODS = ("feedback_gain", "inverse_lqr_gradient", "inverse_lqr_output", "inverse_mpc")


@pytest.fixture(scope="module")
def found() -> dict[str, impc.Estimate]:
    """Noisy cart at its limit."""
    settings = impc.FitSettings(horizon=10, u_max=1.0)
    start = impc.fit(impc.fit_problem(cart(), [noisy_trial(1, 0.0)], settings))
    return {name: impc.fit(start.problem, name, start=start) for name in METHODS}


@pytest.mark.parametrize(
    ("worse", "rel"), [(("inverse_lqr_output", "feedback_gain"), 2e-3), (("inverse_mpc",), 1e-4)]
)
def test_a_method_that_loses_begins_again(
    found: dict[str, impc.Estimate], worse: tuple[str, ...], rel: float
) -> None:
    """Poor weights for inverse MPC, and for the search without bounds."""
    changed = {name: found[name] for name in ("feedback_gain", "inverse_lqr_output", "inverse_mpc")}
    poor = impc.solve_lqr(cart(), impc.Weights(np.eye(2) * 50, 1))
    for name in worse:
        K, S, one = np.array(poor.K), np.array(poor.S), found[name]
        left = misfit_or_reason(one.problem, K, S)[0]
        assert left > 1.01 * one.misfit
        changed[name] = impc.replace(one, K=K, S=S, weights=poor.weights, misfit=left)
    checked = cross_checked(found["inverse_mpc"].problem, changed)
    for name, one in checked.items():
        assert one.misfit <= found[name].misfit * (1 + rel)
        assert not one.fit.beaten_by


def test_no_answer_is_beaten_and_nested_models_are_ordered(found: dict[str, impc.Estimate]) -> None:
    """The free gain fits no worse than weights without bounds; each is best in its model."""
    checked = cross_checked(found["inverse_mpc"].problem, found)
    output = checked["inverse_lqr_output"]
    assert checked["feedback_gain"].misfit <= output.misfit * (1 + 1e-3)
    assert output.misfit <= checked["inverse_lqr_gradient"].misfit * (1 + 1e-3)
    for own in (checked["inverse_mpc"], output):
        for other in checked.values():
            if other.weights is not None:
                left = misfit_or_reason(own.problem, np.array(other.gain), np.array(other.metric))
                assert own.misfit <= left[0] * (1 + 1e-3)
