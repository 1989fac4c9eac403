"""No method's answer may be worse, in its own model, than the answer of another method there.

    inverse_mpc, inverse_lqr_output    over all weights: those of any other method are candidates
    feedback_gain                      over all gains, without bounds: so is any gain

Each candidate is simulated once, in the model and at the initial states of the answer that it might
replace. One that leaves less is where that search begins again; what still leaves more afterwards
says so (`Estimate.doubts`; docs/fitting.md).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from impc.checking import replace
from impc.errors import ImpcError
from impc.inverse.gain_search import refine_gain
from impc.inverse.methods import METHODS, of_fitted_gain, output_penalty
from impc.inverse.noisy_fit import fit_controller
from impc.inverse.residuals import misfit_or_reason

if TYPE_CHECKING:
    from impc.arrays import Array
    from impc.inverse.estimates import Estimate
    from impc.inverse.problem import Problem

# Misfits that differ by less, of themselves, are the same.
_SAME = 1e-3
# Methods that search all weights.
_WEIGHTS = ("inverse_mpc", "inverse_lqr_output")


def cross_checked(problem: Problem, found: dict[str, Estimate]) -> dict[str, Estimate]:
    """The estimates of some methods, inverse MPC among them, none beaten in its own model."""
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
    """The answer of another method that leaves least in this one's model, if it leaves less."""
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
        return fit_controller(own.problem, winner.stage_weights)
    except ImpcError:  # its own answer stands
        return own


def _searched_again(problem: Problem, start: Estimate, own: Estimate, winner: Estimate) -> Estimate:
    """The method's own search from another method's answer; the better of both."""
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
