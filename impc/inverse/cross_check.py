"""Cross-check: no solution may fit worse in its own model than that of another method.

    inverse_mpc, inverse_lqr_output    search all weights: candidates are weights of other methods
    feedback_gain                      searches all gains without bounds: any gain is a candidate

Each candidate is simulated in the model and at the initial states of the solution that it might
replace. If one fits better, the search restarts from it; `Estimate.doubts` names one that still
fits better afterwards.
"""

from __future__ import annotations

import numpy as np

from impc.arrays import Array
from impc.checking import replace
from impc.errors import ImpcError
from impc.inverse.estimates import Estimate
from impc.inverse.methods import METHODS, of_fitted_gain, output_penalty
from impc.inverse.noisy_fit import fit_controller
from impc.inverse.problem import Problem
from impc.inverse.residuals import misfit_or_reason
from impc.inverse.search import refine_gain

# Relative difference below which two misfits count as equal.
_SAME = 1e-3
# Methods that search all weights.
_WEIGHTS = ("inverse_mpc", "inverse_lqr_output")


def cross_checked(problem: Problem, found: dict[str, Estimate]) -> dict[str, Estimate]:
    """Estimates of several methods, inverse MPC among them, after the cross-check."""
    own = found["inverse_mpc"]
    winner = _winner(own, found)
    if winner is not None:
        again = _begun_again(own, winner)
        if again.misfit < own.misfit:
            found = {
                name: again if name == "inverse_mpc" else METHODS[name].estimate(problem, again)
                for name in found
            }
    checked = {}
    for name, first in found.items():
        last, winner = first, _winner(first, found)
        if winner is not None and name != "inverse_mpc":
            last = _searched_again(problem, found["inverse_mpc"], first, winner)
            winner = _winner(last, found)
        beaten_by = "" if winner is None else winner.method
        checked[name] = replace(last, fit=replace(last.fit, beaten_by=beaten_by))
    return checked


def _winner(own: Estimate, found: dict[str, Estimate]) -> Estimate | None:
    """Solution of another method with the least misfit in this model, if better than `own`."""
    if own.K is None or own.method not in (*_WEIGHTS, "feedback_gain"):
        return None
    best, least = None, (1 - _SAME) * own.misfit
    for other in found.values():
        usable = other.K is not None and (own.method not in _WEIGHTS or other.weights is not None)
        if other is own or not usable or other.method == own.method:
            continue
        size, reason = misfit_or_reason(own.problem, *_pair(other))
        if not reason and size < least:
            best, least = other, size
    return best


def _pair(estimate: Estimate) -> tuple[Array, Array]:
    return np.array(estimate.gain), np.array(estimate.metric)


def _begun_again(own: Estimate, winner: Estimate) -> Estimate:
    try:
        found = fit_controller(own.problem, winner.stage_weights)
        return replace(found, rivals=own.rivals)
    except ImpcError:  # keep the own solution
        return own


def _searched_again(problem: Problem, start: Estimate, own: Estimate, winner: Estimate) -> Estimate:
    """Restart the method from the solution of another one; return the better of both."""
    try:
        if own.method == "feedback_gain":
            posed = replace(own.problem, unknown_start=problem.unknown_start)
            gain = refine_gain(posed, *_pair(winner), prior=1.0)
            again = of_fitted_gain(problem, start, gain)
        else:
            again = output_penalty(problem, start, winner.stage_weights)
    except ImpcError:
        return own
    return again if again.misfit < own.misfit else own
