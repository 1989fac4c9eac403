"""The same recordings as inverse LQR explains them, beside inverse MPC.

    preliminary         gains on a few states and physical parameters (3.19), (3.20), if asked for
    feedback_gain       any gain, no bounds (3.12)
    inverse_lqr_gain    weights whose regulator is near that gain: Table 3.1, lines 2 to 7, (3.7)
    inverse_lqr_output  weights whose regulator, without bounds, fits the outputs best (3.16)
    clipped_lqr         the regulator of inverse MPC, its command cut off at the bounds
    inverse_mpc         the constrained controller

The inverse-LQR methods search in natural coordinates, as inverse MPC does (`natural_fit`); initial
states are fitted for each method's own controller, physical parameters are those of inverse MPC.
"""

from __future__ import annotations

import functools
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Array, Frozen, frozen
from impc.assess.judged import MethodFit, judge, without_gain
from impc.checking import replace
from impc.errors import SolverError, WeightsError
from impc.inverse.direct_and_reduced import auxiliary_weights
from impc.inverse.equivalent_weights import least_condition_weights
from impc.inverse.initial_states import with_fitted_starts
from impc.inverse.inverse_lqr import inverse_lqr_lmi
from impc.inverse.natural_search import in_plant_units, inverse_mpc_natural
from impc.inverse.noisy_fit import free_gain, noise_of
from impc.inverse.solution_set import gain_fibre, natural_coordinates
from impc.model.bounds import Bounds
from impc.model.plant import change_coordinates
from impc.model.riccati import is_stable, solve_lqr

if TYPE_CHECKING:
    from collections.abc import Callable

    from impc.assess.delayed_feedback import PreliminaryGain
    from impc.inverse.gain_search import GainFit
    from impc.inverse.noisy_fit import FittedController
    from impc.inverse.problem import Problem
    from impc.model.weights import Weights

__all__ = ["compare_methods"]


def compare_methods(
    fitted: FittedController,
    progress: Callable[[str], None] = lambda _: None,
    preliminary: Callable[[], PreliminaryGain] | None = None,
) -> tuple[MethodFit, ...]:
    """Run every method of the module's text on the recordings of a fit.

    Parameters
    ----------
    fitted : FittedController
        Inverse MPC, already done.
    progress : callable
        Told the name of each method when it is done.
    preliminary : callable, optional
        Computes the preliminary estimate.
    """
    known = _known(fitted.problem)
    loose = known.without_bounds()
    begin, gain = fitted.weights, np.array(fitted.solution.K)
    results = []

    def add(name: str, problem: Problem, find: Callable[[], _Found]) -> _Found:
        started = time.perf_counter()
        try:
            found = find()
        except (WeightsError, SolverError) as error:
            found = _Found(None, None, str(error))
        seconds = time.perf_counter() - started
        results.append(_judge(name, fitted, found.problem or problem, found, seconds))
        progress(name)
        return found

    def first_estimate(find: Callable[[], PreliminaryGain]) -> _Found:
        given = find()
        return _Found(np.array(given.K), None, "", _known(given.problem))

    free: list[GainFit] = []

    def feedback() -> _Found:
        free.append(free_gain(loose, begin))
        return _Found(np.array(free[0].K), None, "")

    def output_penalty() -> _Found:
        noise = noise_of(free[0] if free else fitted.free)
        weights = inverse_mpc_natural(loose, begin, noise).weights
        return _Found(np.array(solve_lqr(known.plant, weights).K), weights, "")

    if preliminary is not None:
        add("preliminary", loose, functools.partial(first_estimate, preliminary))
    first = add("feedback_gain", loose, feedback)
    add("inverse_lqr_gain", loose, lambda: _gain_penalty(known, first, begin))
    add("inverse_lqr_output", loose, output_penalty)
    add("clipped_lqr", _clipping(known), lambda: _Found(gain, fitted.weights, ""))
    add("inverse_mpc", known, lambda: _Found(gain, fitted.weights, ""))
    return tuple(results)


@dataclass(frozen=True)
class _Found(Frozen):
    K: Array | None
    weights: Weights | None
    reason: str
    problem: Problem | None = None  # when it is not the common one


def _known(problem: Problem) -> Problem:
    """The problem with what was fitted taken as known."""
    return replace(problem, unknown_start=False, family=None, logarithms=frozen([]))


def _gain_penalty(problem: Problem, first: _Found, begin: Weights) -> _Found:
    """Lines 2 to 7 of Table 3.1 in natural coordinates: the LMI, else the auxiliary problem."""
    if first.K is None:
        raise SolverError("gain", "none was found", "see the feedback gain")
    plant = problem.plant
    stable = is_stable(plant.A - plant.B @ first.K, discrete=True)
    start = solve_lqr(plant, begin).K
    T, G = natural_coordinates(plant, first.K if stable else start)
    natural = change_coordinates(plant, T, G)
    target: Array = np.asarray(np.linalg.solve(G, first.K @ T), dtype=np.float64)
    lmi = inverse_lqr_lmi(natural, target)
    weights = lmi.weights
    if weights is None:
        centre = least_condition_weights(gain_fibre(natural, np.linalg.solve(G, start @ T)))
        weights = auxiliary_weights(natural, target, centre.weights).weights
    found = in_plant_units(weights, T, G)
    return _Found(np.array(solve_lqr(plant, found).K), found, "")


def _clipping(problem: Problem) -> Problem:
    """A horizon of one sample without state bounds or terminal set: cut off, no foresight."""
    limits = Bounds(problem.plant, u_min=problem.bounds.u_min, u_max=problem.bounds.u_max)
    return replace(problem, bounds=limits, horizon=1, terminal_set=False)


def _judge(
    name: str, fitted: FittedController, problem: Problem, found: _Found, seconds: float
) -> MethodFit:
    """Simulate all recordings with the gain found, from initial states fitted for it."""
    if found.K is None:
        return without_gain(name, problem, seconds, found.reason)
    metric = np.array(fitted.solution.S)
    settled = problem
    if fitted.problem.unknown_start and name != "inverse_mpc":
        settled = with_fitted_starts(problem, found.K, metric)
    bounds = fitted.problem.bounds
    return judge(name, settled, bounds, found.K, metric, weights=found.weights, seconds=seconds)
