"""Fit the cost weights of a structure, or weights for a terminal weight given by the user.

    starts  ->  searches with a weak prior  ->  the same without it along identified combinations

Unknowns are logarithms of cost weights, so a cost weight whose optimum is zero would diverge: it is
set to zero if the misfit does not grow. With noise, some combinations are almost free. A weak prior
holds them during the search; at its end combinations known to within a factor of e^3 are refitted
without it (docs/howto/weights.md).

The misfit of trajectories has local minima in the cost weights. Near a gain that fits it is almost
the quadratic form |J (K(z) - K)|^2, J the derivative of the residual by the gain after projection
on initial states and parameters. Starts are the weights of nearest gain in this form, searched from
Bryson's rule over a range of command weights, and that rule itself.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence

import numpy as np
import scipy.linalg
import scipy.optimize

from impc.arrays import Array, BoolArray
from impc.checking import replace
from impc.errors import ImpcError, SolverError, WeightsError
from impc.inverse.estimates import Estimate, determined, simulated_estimate
from impc.inverse.laws import GainLaw, WeightLaw, regulator_slopes
from impc.inverse.problem import EXPLAINED, Problem, explains, recorded_size, simulated
from impc.inverse.residuals import controlled_residual
from impc.inverse.search import stop_at
from impc.inverse.starts import regulators
from impc.inverse.unknowns import Fitted, Unknowns, linear_at
from impc.model.riccati import solve_lqr
from impc.model.structure import Structure

# Prior SD of a log cost weight during a search: a factor of 150 about the start.
_SPREAD = 5.0
# Combinations with a larger standard error keep that prior to the end.
_FREE = 3.0
# A log cost weight with a larger standard error is tried at zero.
_NEARLY_ZERO, _ENDLESS = 2.0, 1e6
# Promise at which a search has converged; largest number of evaluations of one and of all from a
# start.
_FINE, _EVALUATIONS, _MOST, _ROUNDS = 1e-3, 60, 120, 8
# Relative differences below which misfits count as equal: with and without a cost weight, from two
# starts; least decrease of the objective that continues the removal of the prior.
_EQUAL, _AGREE, _PULL = 1e-6, 1e-5, 0.1
# Natural logarithms of the command weight relative to Bryson's rule: -6 to 6 decades.
_EFFORTS = np.log(10.0) * np.arange(-6, 7, 2)
# Starts that are searched; with a given terminal weight also random ones (SD of a log cost weight).
_ATTEMPTS, _STAGED, _DRAWN, _DRAWN_SPREAD = 3, 6, 3, 1.0
# A log parameter beyond this has compensated for the free gain; the search restarts at its nominal.
_RUNAWAY = 3.0
# Gains closer than this, in noise SDs of the recordings, count as equal.
_ALIKE = 0.5


def search_from(problem: Problem, structure: Structure, cost_weights: Array) -> Fitted:
    """One search from given unknowns `cost_weights` (count,)."""
    space = Unknowns(problem, WeightLaw(structure, cost_weights))
    weights = np.full(space.controller.stop, 1 / _SPREAD)
    shared = np.concatenate([weights, np.ones(len(problem.logarithms))])
    end = space.search(space.start, stop_at(problem, _FINE, _MOST), shared=shared, own=1.0)
    end = _polished(problem, structure, end)
    end = _with_zeros(problem, structure, end)
    if explains(problem, end.misfit):
        return end
    end = _without_zeros(problem, structure, end, np.isfinite(cost_weights))
    return _without_pull(structure, end)


def _polished(
    posed: Problem, structure: Structure, end: Fitted, cost_weights: Array | None = None
) -> Fitted:
    """Refit from an end without the prior along identified combinations of cost weights.

    The prior of the others is about `cost_weights` (count,), by default those of the end.
    """
    start = end.cost_weights if cost_weights is None else cost_weights
    space = Unknowns(posed, WeightLaw(structure, np.array(start)))
    z = space.placed(end.problem)
    rows, deviations = _deviations(space, z)
    beside = len(posed.logarithms)
    found = space.search(
        z,
        stop_at(posed, _FINE, _EVALUATIONS),
        shared=np.concatenate([(deviations >= _FREE) / _SPREAD, np.ones(beside)]),
        own=1.0,
        along=scipy.linalg.block_diag(rows.T, np.eye(beside)),
    )
    return replace(found, evaluations=end.evaluations + found.evaluations)


def _deviations(space: Unknowns, z: Array) -> tuple[Array, Array]:
    """Directions of the free cost weights and their standard errors, all else fitted (a,)."""
    noise = space.misfit(z) / np.sqrt(space.problem.recorded_numbers)
    _, values, rows = np.linalg.svd(space.without_nuisance(z), full_matrices=False)
    return rows, noise / np.maximum(values, 1e-300)


def _with_zeros(posed: Problem, structure: Structure, end: Fitted) -> Fitted:
    """Set cost weights to zero if the misfit does not grow, widest first."""
    tried: set[int] = set()
    labels = len(structure.labels)
    while end.evaluations < _MOST and not structure.coupled:
        law = WeightLaw(structure, _unknowns(end))
        if np.count_nonzero(law.moving[:labels]) < 2:
            break
        space = Unknowns(posed, law)
        rows, along = _deviations(space, space.placed(end.problem))
        widths = np.full(structure.count, -np.inf)
        widths[law.moving] = np.sqrt((rows**2).T @ np.minimum(along, _ENDLESS) ** 2)
        widths[labels:] = widths[list(tried)] = -np.inf
        index = int(np.argmax(widths))
        if widths[index] <= _NEARLY_ZERO:
            break
        tried.add(index)
        cost_weights = _unknowns(end)
        cost_weights[index] = -np.inf
        try:
            without = _polished(posed, structure, end, cost_weights)
        except WeightsError:  # no Riccati solution without that cost weight
            continue
        if without.misfit <= end.misfit * (1 + _EQUAL):
            end = without
    return end


def _without_zeros(posed: Problem, structure: Structure, end: Fitted, free: BoolArray) -> Fitted:
    """Restore zero cost weights, of those that were `free`, whose restoration lowers the misfit."""
    for index in np.flatnonzero(np.isneginf(_unknowns(end)) & free):
        if end.evaluations >= _MOST:
            break
        cost_weights = _unknowns(end)
        cost_weights[index] = _least_seen(structure, end, int(index))
        try:
            found = _polished(posed, structure, end, cost_weights)
        except WeightsError:  # no Riccati solution
            continue
        if found.misfit < end.misfit * (1 - _EQUAL):
            end = found
    return end


def _least_seen(structure: Structure, end: Fitted, index: int) -> float:
    """Log cost weight that moves the outputs by one noise SD, all else fixed."""
    problem = end.problem.with_nuisance_fixed()
    solution = solve_lqr(problem.plant, structure.weights(_unknowns(end)))
    dK, dS = regulator_slopes(problem, structure, _unknowns(end), solution)
    law = GainLaw(problem, np.array(end.K), np.array(end.S))
    column = linear_at(problem, law, law.start).parts(problem)[0] @ law.along(dK, dS)[index]
    noise = end.misfit / np.sqrt(problem.recorded_numbers)
    return float(np.log(noise / max(np.linalg.norm(column), 1e-300)))


def _without_pull(structure: Structure, end: Fitted) -> Fitted:
    """Recentre the prior at the solution until it no longer affects the misfit."""
    for _ in range(_ROUNDS):
        if end.evaluations >= _MOST:
            break
        found = _polished(end.problem, structure, end)
        fell = end.problem.recorded_numbers * (1 - (found.misfit / end.misfit) ** 2)
        if fell > 0:
            end = found
        if fell < _PULL:
            break
    return end


def _unknowns(end: Fitted) -> Array:
    return np.array(end.cost_weights)


def fit_structure(
    problem: Problem, structure: Structure, gain: Array, metric: Array, *starts: Array
) -> Fitted:
    """Fit a structure near a `gain` (m, n), `metric` (m, m), and from `*starts` (count,)."""
    target = _Target(problem, structure, gain, metric)
    ladder = bryson_cost_weights(problem, structure, gain, metric)
    nearest = _distinct([target.nearest(cost_weights) for cost_weights in ladder])
    tried = [*starts, *nearest, *ladder]
    best, spent = None, 0
    for cost_weights in _ranked(problem, structure, tried)[:_ATTEMPTS]:
        found = search_from(problem, structure, cost_weights)
        spent += found.evaluations
        again = best is not None and abs(found.misfit - best.misfit) < _AGREE * best.misfit
        if best is None or found.misfit < best.misfit:
            best = found
        if again or explains(problem, best.misfit):
            break
    if best is None:
        raise SolverError(
            f"structure {structure.name}",
            "no controller of this structure can be simulated on the recordings",
            "penalise other features",
        )
    return replace(best, evaluations=spent)


def fit_structured(problem: Problem, structure: Structure, near: Estimate) -> Estimate:
    """Fit a structure, starting from an estimate with its initial states and parameters."""
    own = (np.array(getattr(near.problem, name)) for name in ("starts", "logarithms", "errors"))
    posed = problem.at(*own)
    end = fit_structure(posed, structure, np.array(near.gain), np.array(near.metric))
    given = np.array(problem.logarithms)
    if np.any(np.abs(near.problem.logarithms - given) > _RUNAWAY):
        there = problem.at(np.array(end.problem.starts), given, np.array(end.problem.errors))
        try:
            again = search_from(there, structure, _unknowns(end))
        except WeightsError:  # a zero cost weight may have no Riccati solution
            return structured_estimate(posed, structure, end)
        spent = end.evaluations + again.evaluations
        best = min(end, again, key=lambda one: one.misfit)
        end = replace(best, evaluations=spent)
    return structured_estimate(posed, structure, end)


def structured_estimate(problem: Problem, structure: Structure, end: Fitted) -> Estimate:
    """Estimate of the method "structured" from the end of a search."""
    return simulated_estimate(
        "structured",
        replace(end.problem, structure=structure),
        np.array(end.K),
        np.array(end.S),
        weights=structure.weights(_unknowns(end)),
        noise=max(end.misfit, EXPLAINED * recorded_size(problem)),
        evaluations=end.evaluations,
        settled=end.converged,
        cost_weights=_unknowns(end),
    )


def fit_weights(problem: Problem) -> Estimate:
    """Fit the weights for a terminal weight given by the user, from several starts.

    Such a controller has a gain and a metric per stage (docs/why/theory.md), so that no single gain
    links recordings and weights. Default structure: all of Q and R. The rank of the derivative at
    the solution counts the identified directions.
    """
    structure = problem.structure or Structure(problem.plant, "full", "full")
    posed = replace(problem, terminal_set=False, structure=structure)
    loose, first = replace(posed, terminal_weight=None), regulators(problem)[0]
    ladder = np.array(bryson_cost_weights(loose, structure, np.array(first.K), np.array(first.S)))
    drawn = np.random.default_rng(0).normal(scale=_DRAWN_SPREAD, size=(_DRAWN, *ladder.shape))
    starts = _ranked(posed, structure, [*ladder, *np.concatenate(ladder + drawn)])
    ends: list[Fitted] = []
    for start in starts[:_STAGED]:
        space = Unknowns(posed, WeightLaw(structure, start))
        ends.append(space.search(space.start, stop_at(posed, 1e-3 * _FINE, 2 * _MOST)))
        if explains(posed, ends[-1].misfit):
            break
    if not ends:
        raise SolverError(
            "weights",
            "no weights found whose controller can be simulated on all trials",
            "check plant and bounds",
        )
    best = min(ends, key=lambda end: end.misfit)
    again = sum(end.misfit <= (1 + 1e-3) * best.misfit for end in ends) > 1
    space = Unknowns(best.problem, WeightLaw(structure, _unknowns(best)))
    values = np.linalg.svd(space.without_nuisance(space.start), compute_uv=False)
    weights = structure.weights(_unknowns(best))
    estimate = simulated_estimate(
        "inverse_mpc",
        best.problem,
        np.array(best.K),
        np.array(best.S),
        noise=best.misfit,
        weights=weights,
        evaluations=sum(end.evaluations for end in ends),
        settled=best.converged,
        unconfirmed=len(ends) > 1 and not again,
        cost_weights=_unknowns(best),
        rank=int(np.count_nonzero(determined(best.problem, np.asarray(values)))),
    )
    return replace(estimate, weights=weights)  # keep the scale of the terminal weight


def feature_sizes(problem: Problem, structure: Structure, gain: Array, metric: Array) -> Array:
    """RMS of each feature (k,), in its unit, under a `gain` (m, n) and `metric` (m, m).

    A feature that never moves gets the least of the others.
    """
    runs = simulated(problem, gain, metric)
    x = np.concatenate([run.x[: run.reached + 1] for run in runs])
    sizes = np.sqrt(np.mean((x @ structure.features.T) ** 2, axis=0))
    return np.asarray(np.maximum(sizes, np.min(sizes[sizes > 0], initial=np.inf)))


def bryson_cost_weights(
    problem: Problem, structure: Structure, gain: Array, metric: Array
) -> list[Array]:
    """Unknowns (count,) at which every feature costs a multiple of the command, at its RMS."""
    sizes = feature_sizes(problem, structure, gain, metric)
    runs = simulated(problem, gain, metric)
    u = np.concatenate([run.u[: max(run.reached, 1)] for run in runs])
    efforts = np.mean((u @ structure.input_features.T) ** 2, axis=0)
    efforts = np.maximum(efforts, np.max(efforts, initial=1e-300) * 1e-12)
    k, first = len(structure.labels), np.zeros(structure.count)
    states = np.log(efforts[0]) - 2 * np.log(sizes)
    first[:k] = states / (2 if structure.coupled else 1)
    inputs = np.flatnonzero(structure.is_cost_weight)[k:]
    first[inputs] = np.log(efforts[0] / efforts[1:]) / (2 if structure.input_coupled else 1)
    step = np.zeros(structure.count)
    step[:k] = 1 / (2 if structure.coupled else 1)
    return [first + effort * step for effort in _EFFORTS]


class _Target:
    """Quadratic approximation of the misfit as a function of the gain, near a fit."""

    def __init__(self, problem: Problem, structure: Structure, gain: Array, metric: Array) -> None:
        self.problem, self.structure = problem, structure
        self.law = GainLaw(problem, gain, metric)
        space = Unknowns(problem, self.law)
        noise = space.misfit(space.start) / np.sqrt(problem.recorded_numbers)
        self.noise = max(noise, 1e-9)
        # Only the gain: the metric has an effect only while bounds are active.
        seen = space.without_nuisance(space.start)[:, : gain.size]
        self.form: Array = np.asarray(np.linalg.qr(seen, mode="r"))
        self.gain = self.law.natural(gain)

    def nearest(self, cost_weights: Array) -> tuple[float, Array, Array] | None:
        """Distance, gain and weights of nearest gain, from a start; None without any."""
        weight = self.noise / _SPREAD

        @functools.lru_cache(maxsize=1)  # scipy asks for residual and derivative separately
        def regulated(step: tuple[float, ...]) -> tuple[Array, Array]:
            z = cost_weights + np.array(step)
            solution = solve_lqr(self.problem.plant, self.structure.weights(z))
            dK, _ = regulator_slopes(self.problem, self.structure, z, solution)
            far = self.law.natural(np.array(solution.K)) - self.gain
            slopes = self.law.natural(dK[: len(z)]).reshape(len(z), -1)
            return self.form @ far.ravel(), self.form @ slopes.T

        def residual(step: Array) -> Array:
            try:
                return np.concatenate([regulated(tuple(step))[0], weight * step])
            except WeightsError:
                return np.full(len(self.form) + len(step), 1e6 * max(self.noise, 1.0))

        def derivative(step: Array) -> Array:
            return np.vstack([regulated(tuple(step))[1], weight * np.eye(len(step))])

        try:
            found = scipy.optimize.least_squares(
                residual, np.zeros(len(cost_weights)), jac=derivative, ftol=1e-6, max_nfev=40
            )
            far, _ = regulated(tuple(found.x))
        except WeightsError:
            return None
        far = far / self.noise
        return float(np.linalg.norm(far)), far, cost_weights + found.x


def _distinct(found: Sequence[tuple[float, Array, Array] | None]) -> list[Array]:
    """Weights with different gains, nearest first."""
    kept: list[tuple[float, Array, Array]] = []
    for item in sorted((one for one in found if one is not None), key=lambda one: one[0]):
        if all(np.linalg.norm(item[1] - other[1]) > _ALIKE for other in kept):
            kept.append(item)
    return [cost_weights for _, _, cost_weights in kept]


def _ranked(problem: Problem, structure: Structure, starts: Sequence[Array]) -> list[Array]:
    """Starts that can be simulated, least misfit first."""
    usable = []
    for place, cost_weights in enumerate(starts):
        law = WeightLaw(structure, cost_weights)
        try:
            controller = law.controller(problem, law.start, None, None)
        except ImpcError:
            continue
        residual, reason = controlled_residual(problem, controller)
        if not reason:
            usable.append((float(np.linalg.norm(residual)), place, cost_weights))
    return [cost_weights for _, _, cost_weights in sorted(usable, key=lambda item: item[:2])]
