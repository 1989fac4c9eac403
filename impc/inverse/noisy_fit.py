"""From recordings to one controller: gain, weights, initial states, physical parameters.

    gain with initial states and parameters  ->  weights with that gain, or the direct form (3.6)

A gain that explains its recordings to 1e-9 has weights to find, and the reduced form finds them:
one semidefinite program. With noise a fitted gain usually has none. Then the direct form in natural
coordinates (`natural_search`) takes the weights that fit best. It begins at balanced weights, and
where these leave more than noise does at those whose gain is nearest as the recordings see it,
|J (K(Q, R) - K)|^2 with J the derivative of the residual, which takes no simulation. Last the
states in which trials start are fitted again, the controller being known (docs/fitting.md).
"""

from __future__ import annotations

import contextlib
import functools
from typing import TYPE_CHECKING

import numpy as np
import scipy.optimize
import scipy.special

from impc.arrays import Array
from impc.checking import checked, replace
from impc.errors import InputError, SolverError, WeightsError
from impc.inverse.coordinates import Coordinates, own_unit, with_own
from impc.inverse.equivalent_weights import least_condition_weights
from impc.inverse.estimates import Estimate, simulated_estimate
from impc.inverse.explaining_weights import metric_family, unidentified_metrics, weights_behind
from impc.inverse.gain_search import FEW, GainFit, fit_gain, refine_gain, regulators
from impc.inverse.inverse_lqr import inverse_lqr_gradient
from impc.inverse.natural_search import (
    CONDITION_SHARE,
    best_conditioned,
    in_natural_units,
    in_plant_units,
    inverse_mpc_natural,
)
from impc.inverse.problem import EXPLAINED, misfit, recorded_size, with_or_without_set
from impc.inverse.proximal_search import weights_near
from impc.inverse.residuals import keeps_hard, misfit_or_reason, own_residual, verify_hard
from impc.inverse.solution_set import gain_fibre, natural_coordinates
from impc.model.plant import change_coordinates
from impc.model.riccati import solve_lqr
from impc.model.weights import condition_number, normalised

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from impc.inverse.problem import Problem
    from impc.inverse.proximal_search import ConditionedFit
    from impc.model.plant import Plant
    from impc.model.recordings import Recording
    from impc.model.riccati import LqrSolution
    from impc.model.weights import Weights


# Weights that leave more than the free gain by what noise does in one of a hundred recordings are
# looked for again.
_RARE = 0.01
# Misfit, of the recordings, of weights behind an exact gain with which a search is over: where few
# samples show S, an error of K that rounding left is answered by one of S, which no weights have.
_NEARLY = 1e-6
# Misfits that differ by less, of themselves, are the same.
_SAME = 1e-3
# Regulators from which weights are looked for, at most.
_BEGINNINGS = 3


@checked
def fit_controller(problem: Problem, start: Weights | None = None) -> Estimate:
    """Fit the weights of the constrained controller behind recordings."""

    def fit(posed: Problem) -> Estimate:
        found = _fitted(posed, start)
        tried = posed.terminal_set and problem.terminal_set is None
        if tried and not keeps_hard(found.problem, found.stage_weights):
            raise SolverError("terminal set", "is not kept", "leave it out")
        return found

    def settled(found: Estimate) -> bool:
        return found.explained or not _set_may_matter(found)

    return with_or_without_set(problem, fit, settled)


def _set_may_matter(found: Estimate) -> bool:
    """Whether the controller found would do otherwise, had it to end in its terminal set.

    Where it cannot, another one might, unless what is left is noise. A search with the set takes
    far longer: many samples have to speak for it at the controller found.
    """
    posed = replace(found.problem, terminal_set=True)
    if posed.recorded_numbers > FEW:
        left, reason = misfit_or_reason(posed, found.gain, found.metric)
        return not reason and left < found.misfit
    try:
        runs = verify_hard(posed, found.stage_weights)
    except (WeightsError, SolverError, InputError):  # it has no such set
        return False
    if not all(run.complete for run in runs):
        return not found.fit.white
    return abs(misfit(posed, runs) - found.misfit) > EXPLAINED * recorded_size(posed)


def _fitted(problem: Problem, start: Weights | None) -> Estimate:
    """The same where it is known whether the controller ends in its terminal set."""
    free = fit_gain(problem) if start is None else free_gain(problem, start)
    if free.explained:  # otherwise no weights can have it: the direct form says which come near
        behind = weights_behind(free)
        nearly = behind.misfit <= _NEARLY * recorded_size(problem)
        if nearly and behind.equivalent is not None:
            weights = behind.equivalent.weights
            return _finish(free, free.problem, weights, evaluations=0, converged=True)
    found, spent = _weights(free, start)
    if found.misfit < free.misfit:  # the free gain is in a local minimum
        free = free_gain(free.problem, found.weights)
        found, more = _weights(free, found.weights)
        spent += more
    settled = free.problem
    if problem.own_unknowns:
        settled = with_fitted_starts(free.problem, found.solution.K, found.solution.S)
    return _finish(free, settled, found.weights, evaluations=spent, converged=found.converged)


def free_gain(problem: Problem, begin: Weights) -> GainFit:
    """The best gain of any kind near that of some weights, with what else the problem lacks."""
    solution = solve_lqr(problem.plant, begin)
    return refine_gain(problem, np.array(solution.K), np.array(solution.S), prior=1.0)


def noise_of(free: GainFit) -> float:
    """Misfit of the free gain, at least that of rounding."""
    return max(free.misfit, EXPLAINED * recorded_size(free.problem))


def _weights(free: GainFit, start: Weights | None) -> tuple[ConditionedFit, int]:
    """Weights of the direct form from a few beginnings."""
    best, spent, reason = None, 0, ""
    enough = _unlikely(free) * free.misfit
    for begin in _beginnings(free, start):
        try:
            found = inverse_mpc_natural(free.problem, begin, noise_of(free))
        except (WeightsError, SolverError) as error:  # the next may have a regulator to simulate
            reason = reason or str(error)
            continue
        spent += found.evaluations
        again = best is not None and abs(found.misfit - best.misfit) <= _SAME * best.misfit
        best = found if best is None or found.misfit < best.misfit else best
        if best.misfit <= enough or (again and not free.explained):
            break
    if best is None:
        raise SolverError("weights", f"none can be simulated: {reason}", "give a start of your own")
    return best, spent


def _unlikely(free: GainFit) -> float:
    """Ratio of misfits of the truth and of the best gain that noise rarely exceeds."""
    plant, problem = free.problem.plant, free.problem
    unknowns = plant.m * plant.n + plant.m * (plant.m + 1) // 2 - 1 + len(problem.logarithms)
    unknowns += problem.own_unknowns * len(problem.recordings)
    samples = problem.recorded_numbers
    return float(np.exp(scipy.special.chdtri(unknowns, _RARE) / (2 * samples)))


def _beginnings(free: GainFit, start: Weights | None) -> Iterator[Weights]:
    """The given weights, then those of some regulators, and those nearest to the free gain.

    With noise a free gain wanders off along what the recordings hardly identify, and weights near
    it with it. Last those whose gain is nearest entry by entry: near its limit a stick falls with
    any other.
    """
    if start is not None:
        yield start
    for regulator in regulators(free.problem)[:_BEGINNINGS]:
        if not free.explained:
            yield regulator.weights
        yield _nearest(free, regulator)
        if free.explained:
            yield regulator.weights
    with contextlib.suppress(WeightsError, SolverError):  # then there is no other
        nearest = inverse_lqr_gradient(free.problem.plant, free.K).weights
        if nearest is not None:
            yield nearest


def _nearest(free: GainFit, regulator: LqrSolution) -> Weights:
    """The weights whose gain is nearest to the free one, as the recordings see it."""
    problem, plant = free.problem, free.problem.plant
    space = Coordinates(problem, np.array(free.K), np.array(free.S))
    count = int(space.ends[0])
    triangle: Array = np.asarray(np.linalg.qr(space.without_nuisance(space.start), mode="r"))
    form = triangle[:, :count]
    T, G = natural_coordinates(plant, np.array(regulator.K))
    natural = change_coordinates(plant, T, G)
    # From coordinates about the free gain to those about the regulator.
    back = space.natural(G @ np.eye(count).reshape(-1, plant.m, plant.n) @ np.linalg.inv(T))
    form = form @ back.reshape(count, -1).T / noise_of(free)
    target = np.asarray(np.linalg.solve(G, free.K @ T))
    own = gain_fibre(natural, np.linalg.solve(G, regulator.K @ T), G.T @ regulator.S @ G)
    begin = best_conditioned(own, in_natural_units(regulator.weights, T, G))
    samples = problem.recorded_numbers
    share = CONDITION_SHARE / samples / condition_number(begin)
    return in_plant_units(weights_near(natural, form, target, begin, share).weights, T, G)


def _finish(
    free: GainFit, problem: Problem, weights: Weights, *, evaluations: int, converged: bool
) -> Estimate:
    metrics = _metrics(problem, solve_lqr(problem.plant, weights))
    weights = _by_convention(problem.plant, weights, metrics)
    solution = solve_lqr(problem.plant, weights)
    return simulated_estimate(
        "inverse_mpc",
        problem,
        np.array(solution.K),
        np.array(solution.S),
        weights=weights,
        metrics=metrics,
        noise=noise_of(free),
        evaluations=free.evaluations + evaluations,
        settled=converged,
        unconfirmed=free.unconfirmed,
    )


def _by_convention(plant: Plant, weights: Weights, metrics: Array) -> Weights:
    """Of all weights with the same gain the reported ones, or the given ones if a program fails."""
    solution = solve_lqr(plant, weights)
    try:
        return least_condition_weights(gain_fibre(plant, solution.K, metrics), weights).weights
    except (WeightsError, SolverError):  # at the edge of what a program can determine
        return normalised(weights)


def _metrics(problem: Problem, solution: LqrSolution) -> Array:
    """The metric, and directions along which it moves alone and unseen (k, m, m)."""
    gain, metric = np.array(solution.K), np.array(solution.S)
    family = metric_family(problem.plant, gain) if problem.plant.m > 1 else None
    if family is None:
        return metric[None]
    return unidentified_metrics(problem, gain, family, family.nearest(metric))


_EVALUATIONS = 20
# The first round also counts as noise what saturation keeps from being linear; a second, which does
# not, is worth its simulations where that was more than a share of it.
_ROUNDS, _SHARE = 2, 1e-4


def with_fitted_starts(
    problem: Problem, gain: Array, metric: Array, samples: int | None = None
) -> Problem:
    """Return the problem with x0 and offsets of each trial fitted to its first samples.

    Under a controller, from the given x0, by trust-region least squares. Where the samples leave x0
    free it stays: it is given a normal prior of the size of the trial's other states (`own_unit`),
    which weighs as the residual's own noise does.

    `gain` (m, n); `metric` (m, m).
    """
    fitted = []
    for trial in problem.recordings:
        seen = trial.samples if samples is None else min(samples, trial.samples)
        parts = {name: getattr(trial, name)[:seen] for name in ("outputs", "disturbance", "target")}
        short = replace(trial, commands=trial.commands[:seen], **parts)
        one = replace(problem, recordings=(short,), unknown_start=True)
        fitted.append(replace(trial, **_fit(one, gain, metric)))
    return replace(problem, recordings=tuple(fitted))


def _fit(problem: Problem, gain: Array, metric: Array) -> dict[str, Array]:
    unit = own_unit(problem, gain)
    simulated = own_residual(problem, gain, metric)

    def placed(z: Array) -> Recording:
        return with_own(problem, (unit @ z)[None]).recordings[0]

    @functools.lru_cache(maxsize=1)  # the search asks for residual and derivative one by one
    def seen(z: tuple[float, ...]) -> tuple[Array, Array]:
        moved = placed(np.array(z))
        residual, slope = simulated(np.array(moved.x0), np.array(moved.offset))
        return residual, slope @ unit

    def at(z: Array) -> tuple[Array, Array]:
        return seen(tuple(z))

    z: Array = np.zeros(len(unit))
    before = np.inf
    for _ in range(_ROUNDS):
        noise = _noise(*at(z))
        if abs(noise - before) <= _SHARE * noise:
            break
        z, before = _round(at, z, noise), noise
    moved = placed(z)
    return {"x0": moved.x0, "offset": moved.offset}


def _noise(residual: Array, derivative: Array) -> float:
    """What no x0 explains: to first order, the residual beside the derivative's columns."""
    left = residual - derivative @ np.linalg.lstsq(derivative, residual)[0]
    return float(np.linalg.norm(left) / np.sqrt(len(left)))


def _round(at: Callable[[Array], tuple[Array, Array]], z: Array, noise: float) -> Array:
    """One fit from z, with that noise."""

    def residual(z: Array) -> Array:
        return np.concatenate([at(z)[0], noise * z])

    def derivative(z: Array) -> Array:
        return np.vstack([at(z)[1], noise * np.eye(len(z))])

    found = scipy.optimize.least_squares(
        residual,
        z,
        jac=derivative,
        ftol=1e-10,
        xtol=1e-12,
        gtol=1e-15,
        max_nfev=_EVALUATIONS,
    )
    return np.asarray(found.x)
