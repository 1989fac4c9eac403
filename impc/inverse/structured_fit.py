"""Weights of a structure behind recordings: from any gain that fits to the weights that fit best.

    a gain near the recordings  ->  cost weights whose gain comes nearest, from many starts ->
    searches

The misfit of trajectories has local minima in the cost weights. Near a gain that fits it is all but
a quadratic form of the gain, known from one simulation: |J (K(z) - K)|^2, J the derivative of the
residual with respect to the gain, without what initial states and parameters can make up for. The
regulators of this small problem take a millisecond, so it is solved from cost weights by Bryson's
rule at many cost weights of the command; from the few ends that differ the recordings themselves
are searched (docs/structures.md).
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.optimize

from impc.arrays import Array
from impc.checking import replace
from impc.errors import SolverError, WeightsError
from impc.inverse.coordinates import Coordinates
from impc.inverse.estimates import Estimate, simulated_estimate
from impc.inverse.problem import EXPLAINED, recorded_size, simulated
from impc.inverse.residuals import misfit_or_reason
from impc.inverse.structured_search import StructuredEnd, regulator_slopes, search_from
from impc.model.riccati import solve_lqr

if TYPE_CHECKING:
    from collections.abc import Sequence

    from impc.inverse.problem import Problem
    from impc.model.structure import Structure

# Decades of the cost weight of the command, as in `bryson_weights`.
_EFFORTS = np.log(10.0) * np.arange(-6, 7, 2)
# Logarithm of a cost weight: a factor of 150 about Bryson's, where the nearest gain leaves it free.
_SPREAD = 5.0
_ATTEMPTS = 3
# Two searches that end at the same misfit, to a third of chi-squared's unit on 18000 samples.
_AGREE = 1e-5
# Logarithm of a parameter for which a free gain has made up: there it has no slope to return on.
_RUNAWAY = 3.0
# Ends whose gains differ by less, in deviations of the recordings, are one.
_ALIKE = 0.5


def fit_structure(
    problem: Problem, structure: Structure, gain: Array, metric: Array, *starts: Array
) -> StructuredEnd:
    """Fit the unknowns of a structure; `gain` (m, n); `metric` (m, m); `*starts` (count,)."""
    target = _Target(problem, structure, gain, metric)
    ladder = bryson_cost_weights(problem, structure, gain, metric)
    ends = _distinct([target.nearest(cost_weights) for cost_weights in ladder])
    ranked = _ranked(
        problem, structure, [*starts, *(cost_weights for _, cost_weights in ends), *ladder]
    )
    best, spent = None, 0
    for cost_weights in ranked[:_ATTEMPTS]:
        found = search_from(problem, structure, cost_weights)
        spent += found.evaluations
        again = best is not None and abs(found.misfit - best.misfit) < _AGREE * best.misfit
        if best is None or found.misfit < best.misfit:
            best = found
        if again or best.misfit <= EXPLAINED * recorded_size(problem):
            break
    if best is None:
        raise SolverError(
            f"structure {structure.name}",
            "none of its regulators can be simulated on the recordings",
            "cost weight other features",
        )
    return dataclasses.replace(best, evaluations=spent)


def fit_structured(problem: Problem, structure: Structure, near: Estimate) -> Estimate:
    """Fit a structure from an estimate that fits, with its initial states and parameters."""
    own = (np.array(getattr(near.problem, name)) for name in ("starts", "logarithms", "shifts"))
    posed = problem.at(*own)
    end = fit_structure(posed, structure, np.array(near.gain), np.array(near.metric))
    given = np.array(problem.logarithms)
    if np.any(np.abs(near.problem.logarithms - given) > _RUNAWAY):
        there = problem.at(np.array(end.problem.starts), given, np.array(end.problem.shifts))
        with contextlib.suppress(
            WeightsError
        ):  # a cost weight of zero may leave no regulator there
            again = search_from(there, structure, end.cost_weights)
            spent = end.evaluations + again.evaluations
            best = min(end, again, key=lambda one: one.misfit)
            end = dataclasses.replace(best, evaluations=spent)
    return structured_estimate(posed, structure, end)


def feature_sizes(problem: Problem, structure: Structure, gain: Array, metric: Array) -> Array:
    """Root-mean-square of each feature (k,), in its unit; of one that never moves the least other.

    Under the controller of a `gain` (m, n) and a `metric` (m, m).
    """
    runs = simulated(problem, gain, metric)
    x = np.concatenate([run.x[: run.reached + 1] for run in runs])
    sizes = np.sqrt(np.mean((x @ structure.features.T) ** 2, axis=0))
    return np.asarray(np.maximum(sizes, np.min(sizes[sizes > 0], initial=np.inf)))


def bryson_cost_weights(
    problem: Problem, structure: Structure, gain: Array, metric: Array
) -> list[Array]:
    """Unknowns (count,) by which every feature costs a multiple of the command, at its size."""
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


@dataclass(frozen=True)
class _Nearest:
    distance: float
    gain: Array


class _Target:
    """The quadratic form of gain and metric that the recordings are near a fit."""

    def __init__(self, problem: Problem, structure: Structure, gain: Array, metric: Array) -> None:
        self.problem, self.structure = problem, structure
        self.space = Coordinates(problem, gain, metric)
        start = self.space.start
        seen = self.space.without_nuisance(start)
        samples = problem.recorded_numbers
        self.noise = float(np.linalg.norm(self.space.at(start).residual)) / np.sqrt(samples)
        # Of the gain alone: the metric shows only where commands are at their limits.
        count = len(self.space.gains)
        here = self.space.natural(self.space.changes(self.space.unpack(start), start)[0][:count])
        self.form = np.linalg.qr(seen[:, :count], mode="r") @ here.reshape(count, -1)
        self.gain = self.space.natural(gain)

    def nearest(self, cost_weights: Array) -> tuple[_Nearest, Array] | None:
        """The weights whose gain comes nearest, from a start; None where there is no regulator."""
        weight = max(self.noise, 1e-9) / _SPREAD

        @functools.lru_cache(maxsize=1)  # the search asks for residual and derivative one by one
        def regulated(step: tuple[float, ...]) -> tuple[Array, Array]:
            z = cost_weights + np.array(step)
            solution = solve_lqr(self.problem.plant, self.structure.weights(z))
            dK, _ = regulator_slopes(self.problem, self.structure, z, solution)
            far = self.space.natural(np.array(solution.K)) - self.gain
            slopes = self.space.natural(dK[: len(z)]).reshape(len(z), -1)
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
        scale = max(self.noise, 1e-9)
        return _Nearest(float(np.linalg.norm(far)) / scale, far / scale), cost_weights + found.x


def _distinct(
    found: Sequence[tuple[_Nearest, Array] | None],
) -> list[tuple[_Nearest, Array]]:
    """Those with different gains, the nearest first."""
    kept: list[tuple[_Nearest, Array]] = []
    for item in sorted((one for one in found if one is not None), key=lambda one: one[0].distance):
        if all(np.linalg.norm(item[0].gain - other.gain) > _ALIKE for other, _ in kept):
            kept.append(item)
    return kept


def _ranked(problem: Problem, structure: Structure, starts: Sequence[Array]) -> list[Array]:
    """Those that can be simulated, the least misfit first."""
    usable = []
    for cost_weights in starts:
        try:
            solution = solve_lqr(problem.plant, structure.weights(cost_weights))
        except WeightsError:
            continue
        size, reason = misfit_or_reason(problem, np.array(solution.K), np.array(solution.S))
        if not reason:
            usable.append((size, cost_weights))
    usable.sort(key=lambda item: item[0])
    return [cost_weights for _, cost_weights in usable]


def structured_estimate(problem: Problem, structure: Structure, end: StructuredEnd) -> Estimate:
    """The end of a search as the estimate of the method "structured"."""
    return simulated_estimate(
        "structured",
        replace(end.problem, structure=structure),
        np.array(end.K),
        np.array(end.S),
        weights=structure.weights(np.array(end.cost_weights)),
        noise=max(end.misfit, EXPLAINED * recorded_size(problem)),
        evaluations=end.evaluations,
        settled=end.settled,
        cost_weights=np.array(end.cost_weights),
    )
