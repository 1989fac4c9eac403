"""Inverse MPC for noisy recordings: gain, weights, initial states and physical parameters.

    gain with initial states and parameters  ->  weights with that gain, or the direct form (3.6)

A gain that explains the recordings to 1e-9 is converted to weights by one semidefinite program.
With noise, a fitted gain usually has no weights: then the direct form in whitened coordinates
(`natural_search`) fits the weights. It starts from balanced weights and, if these leave more than
noise, from those with the nearest gain in |J (K(Q, R) - K)|^2, J the derivative of the residual.
Finally the initial states are refitted with the controller fixed.
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
from impc.inverse.explaining_weights import weights_behind
from impc.inverse.gain_search import FEW, GainFit, fit_gain, refine_gain, regulators
from impc.inverse.inverse_lqr import inverse_lqr_gradient
from impc.inverse.metric_family import metric_family, unidentified_metrics
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


# Continue the search if the free gain fits better at this significance level (likelihood ratio).
_RARE = 0.01
# Largest relative misfit at which weights of an exact gain are accepted. If few samples identify S,
# a rounding error of K is compensated by an S that no weights have.
_NEARLY = 1e-6
# Relative difference below which two misfits count as equal.
_SAME = 1e-3
# Advantage of a second fit above which it replaces the first: chi-squared of one, p = 0.001.
_BETTER = 10.8
# Largest number of regulators used as starts.
_BEGINNINGS = 3


@checked
def fit_controller(problem: Problem, start: Weights | None = None) -> Estimate:
    """Fit the weights of the constrained controller to the recordings."""

    def fit(posed: Problem) -> Estimate:
        found = _fitted(posed, start)
        tried = posed.terminal_set and problem.terminal_set is None
        if tried and not keeps_hard(found.problem, found.stage_weights):
            raise SolverError(
                "terminal set", "the fitted controller leaves it", "pass terminal_set=False"
            )
        return found

    def settled(found: Estimate) -> bool:
        return found.explained or not _set_may_matter(found)

    return with_or_without_set(problem, fit, settled)


def _set_may_matter(found: Estimate) -> bool:
    """Whether a terminal set would change the fit; decides if the search with one is run.

    If the fitted controller cannot keep the set, another one might, unless the residuals are white.
    With many samples, the misfit at the fitted controller must decrease with the set.
    """
    posed = replace(found.problem, terminal_set=True)
    if posed.recorded_numbers > FEW:
        left, reason = misfit_or_reason(posed, found.gain, found.metric)
        return not reason and left < found.misfit
    try:
        runs = verify_hard(posed, found.stage_weights)
    except (WeightsError, SolverError, InputError):  # the plant has no such set
        return False
    if not all(run.complete for run in runs):
        return not found.fit.white
    return abs(misfit(posed, runs) - found.misfit) > EXPLAINED * recorded_size(posed)


def _fitted(problem: Problem, start: Weights | None) -> Estimate:
    """Fit for a decided terminal set."""
    free = fit_gain(problem) if start is None else free_gain(problem, start)
    if free.explained:  # otherwise no weights have exactly this gain: use the direct form
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
    if start is None and np.any(problem.stated):
        with contextlib.suppress(WeightsError, SolverError):  # it cannot be simulated: skip it
            other, again = _from_fixed_body(problem, found.weights)
            spent += again.evaluations
            if _advantage(other, again, free, found) > _BETTER:
                free, found = other, again
    settled = free.problem
    if problem.own_unknowns:
        settled = with_fitted_starts(free.problem, found.solution.K, found.solution.S)
    return _finish(free, settled, found.weights, evaluations=spent, converged=found.converged)


def _from_fixed_body(problem: Problem, begin: Weights) -> tuple[GainFit, ConditionedFit]:
    """Fit again from weights that are fitted with the body as it is posed.

    Gain and uncertain body, searched together, can end in a local minimum with a good fit and wrong
    gains: 3 of 8 simulated subjects on the seat.
    """
    fixed, _ = _weights(free_gain(problem.with_body_fixed(), begin), begin)
    free = free_gain(problem, fixed.weights)
    return free, _weights(free, fixed.weights)[0]


def _advantage(
    other: GainFit, again: ConditionedFit, free: GainFit, found: ConditionedFit
) -> float:
    """Decrease of misfit over noise variance, and prior of the body, of a second fit."""
    noise = min(again.misfit, found.misfit) / np.sqrt(free.problem.recorded_numbers)

    def size(fit: GainFit, weights: ConditionedFit) -> float:
        stated, family = fit.problem.stated, fit.problem.family
        spread = fit.problem.logarithms[stated] / family.deviations[stated] if family else 0.0
        return float((weights.misfit / noise) ** 2 + np.sum(np.square(spread)))

    return size(free, found) - size(other, again)


def free_gain(problem: Problem, begin: Weights) -> GainFit:
    """Best unrestricted gain near that of `begin`, with initial states and parameters."""
    solution = solve_lqr(problem.plant, begin)
    return refine_gain(problem, np.array(solution.K), np.array(solution.S), prior=1.0)


def noise_of(free: GainFit) -> float:
    """Misfit of the unrestricted gain, at least rounding level."""
    return max(free.misfit, EXPLAINED * recorded_size(free.problem))


def _weights(free: GainFit, start: Weights | None) -> tuple[ConditionedFit, int]:
    """Weights of the direct form, from several starts."""
    best, spent, reason = None, 0, ""
    enough = _unlikely(free) * free.misfit
    for begin in _beginnings(free, start):
        try:
            found = inverse_mpc_natural(free.problem, begin, noise_of(free))
        except (WeightsError, SolverError) as error:  # try the next start
            reason = reason or str(error)
            continue
        spent += found.evaluations
        again = best is not None and abs(found.misfit - best.misfit) <= _SAME * best.misfit
        best = found if best is None or found.misfit < best.misfit else best
        if best.misfit <= enough or (again and not free.explained):
            break
    if best is None:
        raise SolverError(
            "weights", f"no start can be simulated ({reason})", "pass start=Weights(Q, R)"
        )
    return best, spent


def _unlikely(free: GainFit) -> float:
    """Ratio of the misfits of truth and best gain that noise exceeds with probability `_RARE`."""
    plant, problem = free.problem.plant, free.problem
    unknowns = plant.m * plant.n + plant.m * (plant.m + 1) // 2 - 1 + len(problem.logarithms)
    unknowns += problem.own_unknowns * len(problem.recordings)
    samples = problem.recorded_numbers
    return float(np.exp(scipy.special.chdtri(unknowns, _RARE) / (2 * samples)))


def _beginnings(free: GainFit, start: Weights | None) -> Iterator[Weights]:
    """Starting weights: the given ones, balanced regulators, those nearest to the free gain.

    The last start is nearest entry by entry: near its bound an unstable plant diverges with others.
    """
    if start is not None:
        yield start
    for regulator in regulators(free.problem)[:_BEGINNINGS]:
        if not free.explained:
            yield regulator.weights
        if free.stabilises:  # without bounds a search may end at an unstable gain
            yield _nearest(free, regulator)
        if free.explained:
            yield regulator.weights
    with contextlib.suppress(WeightsError, SolverError):  # skip this start
        nearest = inverse_lqr_gradient(free.problem.plant, free.K).weights
        if nearest is not None:
            yield nearest


def _nearest(free: GainFit, regulator: LqrSolution) -> Weights:
    """Weights whose gain is nearest to the free one in the metric of the recordings."""
    problem, plant = free.problem, free.problem.plant
    space = Coordinates(problem, np.array(free.K), np.array(free.S))
    count = int(space.ends[0])
    triangle: Array = np.asarray(np.linalg.qr(space.without_nuisance(space.start), mode="r"))
    form = triangle[:, :count]
    T, G = natural_coordinates(plant, np.array(regulator.K))
    natural = change_coordinates(plant, T, G)
    # Transform from whitened coordinates of the free gain to those of the regulator.
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
    """Reported weights of those with the same gain; `weights` themselves if the program fails."""
    solution = solve_lqr(plant, weights)
    try:
        return least_condition_weights(gain_fibre(plant, solution.K, metrics), weights).weights
    except (WeightsError, SolverError):  # numerically at the edge of the cone
        return normalised(weights)


def _metrics(problem: Problem, solution: LqrSolution) -> Array:
    """Metric, then metric directions that the recordings do not identify (k, m, m)."""
    gain, metric = np.array(solution.K), np.array(solution.S)
    family = metric_family(problem.plant, gain) if problem.plant.m > 1 else None
    if family is None:
        return metric[None]
    return unidentified_metrics(problem, gain, family, family.nearest(metric))


_EVALUATIONS = 20
# The first round counts nonlinearity by saturation as noise; run a second one if the noise estimate
# changes by more than this share.
_ROUNDS, _SHARE = 2, 1e-4


def with_fitted_starts(
    problem: Problem, gain: Array, metric: Array, samples: int | None = None
) -> Problem:
    """Fit x0 and offsets of each trial to its first samples, controller fixed.

    A normal prior of the size of the states of the trial (`own_unit`), weighted as the residual
    noise, keeps unidentified components at the given x0. `gain` (m, n); `metric` (m, m).
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

    @functools.lru_cache(maxsize=1)  # scipy asks for residual and derivative separately
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
    """RMS of the residual after projection on the derivative: noise to first order."""
    left = residual - derivative @ np.linalg.lstsq(derivative, residual)[0]
    return float(np.linalg.norm(left) / np.sqrt(len(left)))


def _round(at: Callable[[Array], tuple[Array, Array]], z: Array, noise: float) -> Array:
    """One least-squares fit from z with noise SD `noise`."""

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
