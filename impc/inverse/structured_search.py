"""Search over the unknowns of a structure: cost weights, initial states, parameters.

    minimise |Y_sim(z) - Y|^2 over z = (unknowns of the structure | x0 of each trial | parameters)

by trust-region least squares with exact derivatives: unknowns -> (Q, R) -> Riccati -> (K, S) ->
residual. Unknowns are logarithms, so a cost weight whose optimum is zero would diverge: it is set
to zero if the misfit does not grow.

With noise, some combinations of unknowns are almost free. A weak prior holds them during the
search; at its end combinations known to within a factor of e^3 are refitted without it
(docs/howto/weights.md).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.linalg

from impc.arrays import Array, frozen
from impc.checking import replace
from impc.errors import WeightsError
from impc.inverse.coordinates import Coordinates, Point, descend, own_values
from impc.inverse.least_squares import Stop
from impc.inverse.problem import recorded_size
from impc.inverse.residuals import evaluate, scaled_changes, unusable
from impc.model.plant_family import plant_differential
from impc.model.riccati import LqrSolution, regulator_changes, solve_lqr

if TYPE_CHECKING:
    from impc.arrays import BoolArray
    from impc.inverse.coordinates import Compressed
    from impc.inverse.problem import Problem
    from impc.inverse.residuals import Evaluation
    from impc.model.structure import Structure

# Prior SD of a log cost weight during the search: a factor of 150 about the start.
_SPREAD = 5.0
# Combinations with a larger standard error keep that prior to the end.
_FREE = 3.0
_ROUNDS = 8
# Relative difference below which two misfits count as equal.
_NOISY_TOLERANCE = 1e-6
# Relative misfit of exact recordings (`gain_search`).
_EXACT = 1e-9
# A log cost weight with a larger standard error is tried at zero.
_NEARLY_ZERO = 2.0
_EVALUATIONS = 60
_MOST = 120
# Nats at which a search ends; rounding relative to the recorded outputs.
_FINE, _ROUNDING = 1e-3, 1e-13
_ENDLESS = 1e6
# Least decrease of chi-squared that continues the removal of the prior.
_PULL = 0.1


def regulator_slopes(
    problem: Problem, structure: Structure, z: Array, solution: LqrSolution
) -> tuple[Array, Array]:
    """Derivatives of K (q, m, n) and S (q, m, m) by unknowns `z` (count,) and parameters."""
    plant = problem.plant
    dQ, dR = structure.changes(z)
    moved = len(problem.logarithms)
    dA, dB = np.zeros((len(dQ), *plant.A.shape)), np.zeros((len(dQ), *plant.B.shape))
    if problem.family is not None and moved:
        differential = plant_differential(problem.family, problem.logarithms)
        dA = np.concatenate([dA, np.moveaxis(differential.A, -1, 0)])
        dB = np.concatenate([dB, np.moveaxis(differential.B, -1, 0)])
        dQ = np.concatenate([dQ, np.zeros((moved, *dQ.shape[1:]))])
        dR = np.concatenate([dR, np.zeros((moved, *dR.shape[1:]))])
    return regulator_changes(solution, dQ, dR, dA, dB)


class WeightCoordinates(Coordinates):
    """Coordinates with the unknowns of a structure instead of gain and metric."""

    def __init__(self, problem: Problem, structure: Structure, cost_weights: Array) -> None:
        first = solve_lqr(problem.plant, structure.weights(cost_weights))
        super().__init__(problem, np.array(first.K), np.array(first.S))
        self.structure, self.cost_weights = structure, np.array(cost_weights)
        self.moving: BoolArray = np.isfinite(self.cost_weights)
        count = int(np.count_nonzero(self.moving))
        starts, parameters = np.diff(self.ends)[1:]
        self.ends = np.cumsum([count, 0, starts, parameters])
        self.start = np.zeros(int(self.ends[-1]))
        self.solved: tuple[bytes, LqrSolution] = (self.start.tobytes(), first)

    def placed(self, there: Problem) -> Array:
        """z (q,) of the starting weights at the initial states and parameters of `there`."""
        z = self.start.copy()
        first, last = int(self.ends[1]), int(self.ends[2])
        if last > first:
            away = own_values(there) - own_values(self.problem)
            z[first:last] = np.linalg.solve(self.own_unit, away.T).T.ravel()
        z[last:] = (there.logarithms - self.problem.logarithms) / self.units
        return z

    def unknowns(self, z: Array) -> Array:
        """Unknowns of the structure (count,) at z (q,)."""
        found = self.cost_weights.copy()
        found[self.moving] += z[: self.ends[0]]
        return found

    def unpack(self, z: Array) -> Point:
        """Gain, metric and problem at z (q,)."""
        _, _, starts, parameters = np.split(z, self.ends[:-1])
        problem = self.problem_at(starts, parameters)
        if self.solved[0] != z.tobytes():
            weights = self.structure.weights(self.unknowns(z))
            self.solved = (z.tobytes(), solve_lqr(problem.plant, weights))
        found = self.solved[1]
        return Point(np.array(found.K), np.array(found.S), problem)

    def evaluated(self, z: Array, known: Evaluation | None = None) -> tuple[Evaluation, Compressed]:
        """Residual and derivative at z (q,); a large residual without a Riccati solution."""
        try:
            return super().evaluated(z, known)
        except WeightsError as error:
            self.refused.append(str(error))
            nothing = np.zeros((len(z), self.m, self.n)), np.zeros((len(z), self.m, self.m))
            found = unusable(self.problem, str(error))
            self.last = z.tobytes(), found, self._compress(found, *nothing)
            return self.last[1:]

    def residual(self, z: Array) -> Array | None:
        """Residual (r,) at z (q,); None if infeasible or without a Riccati solution."""
        try:
            return super().residual(z)
        except WeightsError as error:
            self.refused.append(str(error))
            return None

    def changes(self, here: Point, z: Array) -> tuple[Array, Array]:
        """Derivatives of K (q, m, n) and of S scaled to trace m (q, m, m) by z (q,)."""
        slopes = regulator_slopes(here.problem, self.structure, self.unknowns(z), self.solved[1])
        count = self.structure.count
        dK, dS = np.zeros((len(z), self.m, self.n)), np.zeros((len(z), self.m, self.m))
        for whole, part in zip((dK, dS), slopes, strict=True):
            whole[: self.ends[0]] = part[:count][self.moving]
            whole[self.ends[2] :] = self.units[:, None, None] * part[count:]
        return dK, scaled_changes(here.S, dS)

    def deviations(self, z: Array, noise: float) -> tuple[Array, Array]:
        """Directions of the free unknowns and their standard errors, nuisance eliminated (a,)."""
        _, values, rows = np.linalg.svd(self.without_nuisance(z), full_matrices=False)
        return rows, noise / np.maximum(values, 1e-300)


@dataclass(frozen=True)
class StructuredEnd:
    """End of a search."""

    cost_weights: Array  # Unknowns of the structure (count,); minus infinity: cost weight zero
    K: Array  # (m, n)
    S: Array  # (m, m)
    problem: Problem  # At the fitted initial states and parameters
    misfit: float  # 2-norm of the residual
    evaluations: int  # Simulations with derivatives
    settled: bool  # Whether the search converged


def search_from(problem: Problem, structure: Structure, cost_weights: Array) -> StructuredEnd:
    """One search from given unknowns `cost_weights` (count,)."""
    space = WeightCoordinates(problem, structure, cost_weights)
    beside = len(problem.logarithms)
    shared = np.concatenate([np.full(int(space.ends[0]), 1 / _SPREAD), np.ones(beside)])
    stop = _stop(space, _MOST)
    z, spent, settled = descend(space, space.start, stop, shared=shared, own=1.0)
    here = _Place(problem, structure, space.unknowns(z), space.unpack(z).problem)
    end = _with_zeros(_polished(here, spent, settled), here, _MOST)
    if end.misfit <= _EXACT * recorded_size(problem):
        return end
    return _without_pull(_without_zeros(end, here, _MOST), structure, _MOST)


@dataclass(frozen=True)
class _Place:
    """Point of a search: unknowns, and a problem at initial states and parameters."""

    posed: Problem
    structure: Structure
    cost_weights: Array
    there: Problem

    def space(self) -> tuple[WeightCoordinates, Array]:
        """Coordinates that start at these weights, prior at the posed problem; and z of `there`."""
        space = WeightCoordinates(self.posed, self.structure, self.cost_weights)
        return space, space.placed(self.there)


def _polished(place: _Place, spent: int, settled: bool) -> StructuredEnd:
    """Refit without the prior along identified combinations of weights."""
    space, z = place.space()
    noise = _misfit(space, z) / np.sqrt(space.problem.recorded_numbers)
    rows, deviations = space.deviations(z, noise)
    beside = len(space.problem.logarithms)
    along = scipy.linalg.block_diag(rows.T, np.eye(beside))
    shared = np.concatenate([(deviations >= _FREE) / _SPREAD, np.ones(beside)])
    z, more, _ = descend(space, z, _stop(space, _EVALUATIONS), shared=shared, own=1.0, along=along)
    here = space.unpack(z)
    return StructuredEnd(
        frozen(space.unknowns(z)),
        frozen(here.K),
        frozen(here.S),
        here.problem,
        _misfit(space, z),
        spent + more,
        settled,
    )


def _stop(space: WeightCoordinates, budget: int) -> Stop:
    return Stop(_FINE, (_ROUNDING * recorded_size(space.problem)) ** 2, max(budget, 1))


def _with_zeros(end: StructuredEnd, place: _Place, budget: int) -> StructuredEnd:
    """Set cost weights to zero if the misfit does not grow."""
    tried: set[int] = set()
    while end.evaluations < budget:
        here = replace(place, cost_weights=np.array(end.cost_weights), there=end.problem)
        index = _widest(here, end.misfit, tried)
        if index is None:
            break
        tried.add(index)
        cost_weights = np.array(end.cost_weights)
        cost_weights[index] = -np.inf
        try:
            without = _polished(
                replace(here, cost_weights=cost_weights), end.evaluations, end.settled
            )
        except WeightsError:  # no Riccati solution without that cost weight
            continue
        if without.misfit <= end.misfit * (1 + _NOISY_TOLERANCE):
            end = without
    return end


def _without_zeros(end: StructuredEnd, place: _Place, budget: int) -> StructuredEnd:
    """Restore zero cost weights whose restoration reduces the misfit."""
    for index in np.flatnonzero(np.isneginf(end.cost_weights) & np.isfinite(place.cost_weights)):
        if end.evaluations >= budget:
            break
        cost_weights = np.array(end.cost_weights)
        cost_weights[index] = _seen_from(end, place, int(index))
        here = replace(place, cost_weights=cost_weights, there=end.problem)
        try:
            found = _polished(here, end.evaluations, end.settled)
        except WeightsError:  # no Riccati solution
            continue
        if found.misfit < end.misfit * (1 - _NOISY_TOLERANCE):
            end = found
    return end


def _seen_from(end: StructuredEnd, place: _Place, index: int) -> float:
    """Log cost weight that moves the outputs by one noise SD, all else fixed."""
    solution = solve_lqr(end.problem.plant, place.structure.weights(np.array(end.cost_weights)))
    dK, dS = regulator_slopes(end.problem, place.structure, np.array(end.cost_weights), solution)
    found = evaluate(end.problem, np.array(solution.K), np.array(solution.S))
    size = len(found.residual)
    column = found.dK.reshape(size, -1) @ dK[index].ravel()
    column += found.dS.reshape(size, -1) @ scaled_changes(np.array(solution.S), dS)[index].ravel()
    return float(np.log(end.misfit / np.sqrt(size) / max(np.linalg.norm(column), 1e-300)))


def _without_pull(end: StructuredEnd, structure: Structure, budget: int) -> StructuredEnd:
    """Recentre the prior at the solution until it no longer affects the misfit."""
    samples = end.problem.recorded_numbers
    for _ in range(_ROUNDS):
        if end.evaluations >= budget:
            break
        here = _Place(end.problem, structure, np.array(end.cost_weights), end.problem)
        found = _polished(here, end.evaluations, end.settled)
        fell = samples * (1 - (found.misfit / end.misfit) ** 2)
        if fell > 0:
            end = found
        if fell < _PULL:
            break
    return end


def _widest(place: _Place, misfit: float, tried: set[int]) -> int | None:
    """Cost weight of a state with the largest standard error; None if none is left to try."""
    structure = place.structure
    space, z = place.space()
    if structure.coupled or np.count_nonzero(space.moving[: len(structure.labels)]) < 2:
        return None
    rows, along = space.deviations(z, misfit / np.sqrt(space.problem.recorded_numbers))
    own = np.full(structure.count, -np.inf)
    own[space.moving] = np.sqrt((rows**2).T @ np.minimum(along, _ENDLESS) ** 2)
    own[len(structure.labels) :] = -np.inf
    own[list(tried)] = -np.inf
    index = int(np.argmax(own))
    return index if own[index] > _NEARLY_ZERO else None


def _misfit(space: WeightCoordinates, z: Array) -> float:
    return float(np.linalg.norm(space.at(z).residual))
