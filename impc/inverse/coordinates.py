"""Scaled coordinates of a gain search, in which a unit step is a large step.

    z = (G^-1 K T | factor of S without its first entry | x0 of each trial | parameters)

T T' is the state covariance under the first gain with white noise at the inputs, and G scales the
inputs to that noise (`natural_coordinates`; 1 with one input), so that a unit step moves the
command by one SD of that noise. S = L F F'L' with the first S = LL' and F lower triangular. Gain
and metric are independent: without active bounds S has no effect. For every optimal regulator ||K
T|| <= (tr(B'PB)/R)^(1/2), because white noise costs tr(B'PB) per sample, which includes R u^2.

Initial states are scaled by the states of the trials (`start_unit`), offsets by their outputs, free
parameters by a third of themselves, and parameters with a stated uncertainty by that. The latter
have a prior at their nominal value that is never weakened (docs/why/theory.md).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import scipy.linalg

from impc.arrays import Array
from impc.inverse.least_squares import Prior, Rows, minimise, triangular_rows
from impc.inverse.problem import noise_of_residual, recorded_size, simulated
from impc.inverse.residuals import evaluate, residual_or_reason, scaled_changes
from impc.inverse.solution_set import floored_covariance, natural_coordinates

if TYPE_CHECKING:
    from impc.control.terminal_set import TerminalSet
    from impc.inverse.least_squares import Stop
    from impc.inverse.prediction import Correction
    from impc.inverse.problem import Problem
    from impc.inverse.residuals import Evaluation

_START_FLOOR = 1e-8
# Relative size below which columns are rounding.
_EXPLAINED = 1e-12


@dataclass(frozen=True)
class Point:
    """Values at a point of a search."""

    K: Array  # Gain (m, n)
    S: Array  # Metric (m, m)
    problem: Problem  # At the initial states and parameters of the point


@dataclass(frozen=True)
class Compressed:
    """Residual and derivative, compressed trial by trial by QR factorisations."""

    rows: Rows  # Shared: gain, metric, parameters; own: initial states and offsets
    # Number of shared columns before those of the initial states
    split: int

    @property
    def residual(self) -> Array:
        """Compressed residual (r,)."""
        return np.ravel(self.rows.residual)

    @cached_property
    def jacobian(self) -> Array:
        """Compressed derivative by the q coordinates (r, q)."""
        shared, own = self.rows.shared, self.rows.own
        trials, height, n = own.shape
        starts = np.zeros((trials, height, trials, n))
        starts[np.arange(trials), :, np.arange(trials)] = own
        flat = shared.reshape(trials * height, -1)
        middle = starts.reshape(trials * height, -1)
        return np.hstack([flat[:, : self.split], middle, flat[:, self.split :]])


class Coordinates:
    """Coordinates of one search, and the residual in them."""

    def __init__(
        self,
        problem: Problem,
        gain: Array,
        metric: Array,
        gains: Array | None = None,
        correction: Correction | None = None,
    ) -> None:
        self.problem, self.correction = problem, correction
        #: Gain and metric of the origin.
        self.given = gain, metric
        plant = problem.plant
        self.m, self.n, self.trials = plant.m, plant.n, len(problem.recordings)
        self.T, self.G = natural_coordinates(plant, gain)
        self.own_unit, self.own = own_unit(problem, gain), problem.own_unknowns
        self.units, self.stated = problem.parameter_units, problem.stated
        self.first = np.linalg.cholesky(metric * (plant.m / np.trace(metric)))
        if gains is None:
            entries = np.eye(self.m * self.n).reshape(-1, self.m, self.n)
            gains = self.G @ entries @ np.linalg.inv(self.T)
        self.gains = gains
        self.tril = np.tril_indices(self.m)
        self.refused: list[str] = []
        self.last: tuple[bytes, Evaluation, Compressed] | None = None
        self.near: TerminalSet | None = None
        sizes = (
            len(gains),
            len(self.tril[0]) - 1,
            self.trials * self.own,
            len(problem.logarithms),
        )
        self.ends = np.cumsum(sizes)
        self.start = self.at_gain(gain)

    def at_gain(self, gain: Array) -> Array:
        """z (q,) of the origin with another gain (m, n), or its projection on the basis."""
        shapes = np.diff(np.concatenate([[0], self.ends]))
        nuisance = np.zeros(int(shapes[2] + shapes[3]))
        along = np.tensordot(self.natural(self.gains), self.natural(gain), 2)
        return np.concatenate([along, np.eye(self.m)[self.tril][1:], nuisance])

    @property
    def centre(self) -> Array:
        """Prior mean of z (q,): the origin; nominal values of stated uncertainties."""
        found = self.start.copy()
        nominal = -self.problem.logarithms / self.units
        found[int(self.ends[2]) :] = np.where(self.stated, nominal, 0.0)
        return found

    def unpack(self, z: Array) -> Point:
        """Gain, metric and problem at z (q,)."""
        along, factor, starts, parameters = np.split(z, self.ends[:-1])
        gain = np.asarray(np.tensordot(along, self.gains, 1))
        return Point(gain, self._metric(factor), self.problem_at(starts, parameters))

    def problem_at(self, starts: Array, parameters: Array) -> Problem:
        """Problem at other coordinates of initial states and offsets, and of `parameters` (k,)."""
        problem = self.problem
        moved = starts.reshape(self.trials, self.own) @ self.own_unit.T
        return with_own(problem, moved, problem.logarithms + self.units * parameters)

    def at(self, z: Array) -> Compressed:
        """Residual and derivative at z (q,), compressed."""
        return self.evaluated(z)[1]

    def residual(self, z: Array) -> Array | None:
        """Residual (r,) at z (q,) without derivatives; None if infeasible."""
        here = self.unpack(z)
        residual, reason = residual_or_reason(
            here.problem, here.K, here.S, correction=self.correction
        )
        if reason:
            self.refused.append(reason)
        return None if reason else residual

    def pulled(self, z: Array, change: Array) -> Array:
        """J'c (q,) of a change c (r,) of the residual, J the derivative at z (q,)."""
        found, _ = self.evaluated(z)
        dK, dS = self.changes(self.unpack(z), z)
        on_gain, on_metric = np.tensordot(change, found.dK, 1), np.tensordot(change, found.dS, 1)
        pulled = np.tensordot(dK, on_gain, 2) + np.tensordot(dS, on_metric, 2)
        first, last, row = int(self.ends[1]), int(self.ends[2]), 0
        sizes = self.problem.trial_sizes if self.own else []
        for size, place in zip(sizes, range(first, last, self.own or 1), strict=True):
            mine = slice(row, row + size)
            row = mine.stop
            pulled[place : place + self.own] += change[mine] @ found.own[mine] @ self.own_unit
        pulled[last:] += self.units * (change @ found.dparameters)
        return pulled

    def evaluated(self, z: Array, known: Evaluation | None = None) -> tuple[Evaluation, Compressed]:
        """Residual and derivative at z (q,), full and compressed; reuses `known` if given."""
        key = z.tobytes()
        if self.last is None or self.last[0] != key:
            self.last = None  # free memory first: with hundreds of trials two would not fit
            here = self.unpack(z)
            found = known or evaluate(here.problem, here.K, here.S, self.near, self.correction)
            self.near = found.terminal or self.near
            if found.reason:
                self.refused.append(found.reason)
            self.last = key, found, self._compress(found, *self.changes(here, z))
        return self.last[1:]

    def without_nuisance(self, z: Array) -> Array:
        """Derivative at z (q,) by gain and metric, after projection on the other unknowns."""
        rows = self.at(z).rows
        left, values, _ = np.linalg.svd(rows.own, full_matrices=False)
        largest = np.max(values, initial=0.0)
        basis = left * (values > _EXPLAINED * largest)[:, None, :]
        shared = rows.shared - basis @ (np.swapaxes(basis, 1, 2) @ rows.shared)
        kept, nuisance = np.split(shared.reshape(-1, shared.shape[2]), [int(self.ends[1])], axis=1)
        noise = noise_of_residual(self.problem, self.at(z).residual)
        held = noise * np.eye(len(self.stated))[self.stated]
        kept = np.vstack([kept, np.zeros((len(held), kept.shape[1]))])
        nuisance = np.vstack([nuisance, held])
        if nuisance.shape[1] == 0:
            return kept
        size = np.sqrt(np.sum(rows.shared[..., int(self.ends[1]) :] ** 2, axis=(0, 1)))
        rest, values, _ = np.linalg.svd(nuisance, full_matrices=False)
        rest = rest[:, values > _EXPLAINED * max(largest, np.max(size))]
        return np.asarray(kept - rest @ (rest.T @ kept))

    def natural(self, gains: Array) -> Array:
        """G^-1 K T (..., m, n) of gains K (..., m, n)."""
        return np.asarray(np.linalg.solve(self.G, gains @ self.T))

    def _factor(self, entries: Array) -> Array:
        factor = np.zeros((self.m, self.m))
        factor[self.tril] = np.concatenate([[1.0], entries])
        return np.asarray(self.first @ factor, dtype=np.float64)

    def _metric(self, entries: Array) -> Array:
        factor = self._factor(entries)
        return np.asarray(factor @ factor.T)

    def changes(self, here: Point, z: Array) -> tuple[Array, Array]:
        """Derivatives of K (q, m, n), and of S scaled to trace m (q, m, m), by z (q,)."""
        lower = self._factor(z[self.ends[0] : self.ends[1]])
        dK, dS = np.zeros((len(z), self.m, self.n)), np.zeros((len(z), self.m, self.m))
        dK[: self.ends[0]] = self.gains
        dS[self.ends[0] : self.ends[1]] = _factor_changes(self.first, lower)
        return dK, scaled_changes(here.S, dS)

    def _compress(self, found: Evaluation, dK: Array, dS: Array) -> Compressed:
        """Factorise derivative and residual together, trial by trial, then apply the chain rule."""
        # Initial states move neither K nor S, but are most of the columns.
        first, last = int(self.ends[1]), int(self.ends[2])
        shared = np.delete(np.arange(len(dK)), slice(first, last))
        along = found.dK.reshape(-1, self.m * self.n) @ dK[shared].reshape(len(shared), -1).T
        if self.m > 1:
            along += found.dS.reshape(-1, self.m**2) @ dS[shared].reshape(len(shared), -1).T
        rows, row = [], 0
        sizes = self.problem.trial_sizes
        if not self.own:  # one block: no trial-specific columns
            sizes = [sum(sizes)]
        for size in sizes:
            mine = slice(row, row + size)
            row = mine.stop
            blocks = [along[mine, :first]]
            blocks += [found.own[mine] @ self.own_unit] if self.own else []
            parameters = found.dparameters[mine] * self.units + along[mine, first:]
            blocks += [parameters, found.residual[mine, None]]
            triangle = triangular_rows(blocks)
            full = np.zeros((triangle.shape[1], triangle.shape[1]))
            full[: len(triangle)] = triangle
            rows.append(full)
        table = np.stack(rows)
        own = slice(first, first + self.own)
        rest = np.delete(table[..., :-1], own, axis=2)
        return Compressed(Rows(table[..., -1], rest, table[..., own]), first)


def descend(
    space: Coordinates,
    z: Array,
    stop: Stop,
    *,
    shared: Array | float = 0.0,
    own: float = 0.0,
    along: Array | None = None,
) -> tuple[Array, int, bool]:
    """Least squares from z (q,) with a normal prior about the origin of the coordinates."""
    model = _Along(space, z, along)
    centre = model.apart(space.centre)
    weights = np.array(np.broadcast_to(shared, model.columns.shape[1]), dtype=np.float64)
    if len(weights):
        weights[len(weights) - len(space.stated) :][space.stated] = 1.0
    prior = Prior(*centre, weights, own)
    u, v, spent, converged = minimise(model, prior, model.begin, stop)
    return model.placed(u, v), spent, converged


class _Along:
    """Residual along given combinations of the shared coordinates, from a point."""

    def __init__(self, space: Coordinates, z: Array, along: Array | None) -> None:
        self.space, self.z = space, z
        self.first, self.last = int(space.ends[1]), int(space.ends[2])
        self.columns = np.eye(len(z) - self.last + self.first) if along is None else along
        self.shape = (space.trials, space.own) if space.own else (1, 0)
        self.begin = self.apart(z)
        self.count = space.problem.recorded_numbers
        self.here = z

    def apart(self, z: Array) -> tuple[Array, Array]:
        shared = np.delete(z, slice(self.first, self.last))
        return self.columns.T @ shared, z[self.first : self.last].reshape(self.shape)

    def placed(self, u: Array, v: Array) -> Array:
        moved = np.delete(self.z, slice(self.first, self.last))
        moved = moved + self.columns @ (u - self.begin[0])
        return np.concatenate([moved[: self.first], np.ravel(v), moved[self.first :]])

    def rows(self, u: Array, v: Array) -> Rows | None:
        self.here = self.placed(u, v)
        found, compressed = self.space.evaluated(self.here)
        whole = compressed.rows
        if found.reason:
            return None
        # With active bounds the second derivative is unreliable. With several inputs geodesic
        # acceleration solved 20 of 30 random exact problems (half of the outputs), straight steps
        # 14.
        curved = self.space.m > 1 or found.active == 0
        return Rows(whole.residual, whole.shared @ self.columns, whole.own, curved)

    def square(self, u: Array, v: Array) -> float:
        residual = self.space.residual(self.placed(u, v))
        return np.inf if residual is None else float(residual @ residual)

    def bend(self, du: Array, dv: Array, share: float) -> tuple[Array, Array] | None:
        here = self.apart(self.here)
        there = self.space.residual(self.placed(here[0] + share * du, here[1] + share * dv))
        if there is None:
            return None
        found = self.space.evaluated(self.here)[0]
        pulled = self.space.pulled(self.here, there - found.residual)
        shared = np.delete(pulled, slice(self.first, self.last))
        return self.columns.T @ shared, pulled[self.first : self.last].reshape(self.shape)


def metric_directions(metric: Array) -> Array:
    """Directions (k, m, m) of a metric (m, m) without its scale, in its own units."""
    first: Array = np.asarray(np.linalg.cholesky(metric), dtype=np.float64)
    return _factor_changes(first, first)


def _factor_changes(first: Array, lower: Array) -> Array:
    """Change (k, m, m) of L F F'L' by entries of F but the first, of L and of L F (m, m)."""
    found = []
    for row, column in list(zip(*np.tril_indices(len(first)), strict=True))[1:]:
        change = np.outer(first[:, row], lower[:, column])
        found.append(change + change.T)
    return np.array(found).reshape(-1, *first.shape)


def with_own(problem: Problem, moved: Array, logarithms: Array | None = None) -> Problem:
    """Problem with initial states and offsets shifted by `moved` (trials, own)."""
    starts, shifts = np.array(problem.starts), np.array(problem.shifts)
    size = problem.searched_states
    starts[:, :size] += moved[:, :size]
    shifts[:, _offset_places(problem)] += moved[:, size:]
    return problem.at(starts, problem.logarithms if logarithms is None else logarithms, shifts)


def own_values(problem: Problem) -> Array:
    """Searched initial states and offsets (trials, own)."""
    shifts = problem.shifts[:, _offset_places(problem)]
    return np.hstack([problem.starts[:, : problem.searched_states], shifts])


def _offset_places(problem: Problem) -> list[int]:
    """Indices of the outputs with a searched offset."""
    return [problem.plant.outputs.index(name) for name in problem.offsets]


def own_unit(problem: Problem, gain: Array) -> Array:
    """Unit of the unknowns of one trial (own, own): `start_unit` and output scales."""
    size, shifts = problem.searched_states, np.diag(problem.output_scale[_offset_places(problem)])
    whole = start_unit(problem, gain) if size else np.zeros((0, 0))
    if size < len(whole):  # the other states are known
        whole = np.asarray(np.linalg.cholesky((whole @ whole.T)[:size, :size]), dtype=np.float64)
    return np.asarray(scipy.linalg.block_diag(whole, shifts))


def start_unit(problem: Problem, gain: Array) -> Array:
    """Unit of initial states (n, n): factor of the second moments of the states under `gain`.

    Without excitation, or if the loop diverges: white noise at the inputs of the size of the
    outputs.
    """
    plant = problem.plant
    runs = simulated(problem, gain, np.eye(plant.m))
    x = np.concatenate([run.x for run in runs])
    second = x.T @ x / len(x)
    complete = all(run.complete for run in runs)
    if complete and np.all(np.isfinite(second)) and np.all(np.diag(second) > 0):
        return np.asarray(np.linalg.cholesky(floored_covariance(second, _START_FLOOR)))
    T, _ = natural_coordinates(plant, gain)
    natural = float(np.linalg.norm(problem.scaled_outputs @ T))
    samples = sum(trial.samples for trial in problem.recordings)
    size = recorded_size(problem) / np.sqrt(samples)
    return size / natural * T if size > 0 and natural > 0 else T
