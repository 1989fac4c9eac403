"""The unknowns of a search for a gain, in coordinates in which a step of one is a large step.

    z = (G^-1 K T | factor of S but its first entry | x0 of each trial | parameters)

T T' is the covariance of the states that the first gain gives when white noise enters at the
inputs, and G gives the inputs the size of that noise (`natural_coordinates`; with one input it is
1), so that a step of length one moves the command by one unit of that noise, whatever the units of
states and inputs. S = L F F'L' with the first S = LL' and F lower triangular, for the same reason.
On the seat, at four torque limits, a trust region in these coordinates reached
the gain from 7 of 11 starts, in raw entries from 5, and in raw entries with columns scaled by the
Jacobian from 4 (docs/fitting.md; experiments/benchmarks/search.py). No optimal regulator has a
K T of norm above (tr(B'PB)/R)^(1/2), because white noise costs it tr(B'PB) a sample, of which
R u^2 is a part.

Initial states are measured in those of the trials themselves (`start_unit`), and a parameter in
thirds of itself.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Array
from impc.control.closed_loop import simulate
from impc.inverse.arrow import ArrowRows, triangular_rows
from impc.inverse.consistent_pairs import consistent_gains, scaled_changes
from impc.inverse.problem import controller_for, scenarios
from impc.inverse.regulator_span import regulators_alone
from impc.inverse.residuals import evaluate
from impc.inverse.solution_set import floored_covariance, natural_coordinates
from impc.model.plant_family import plant_differential

if TYPE_CHECKING:
    from impc.control.terminal_set import TerminalSet
    from impc.inverse.problem import Problem
    from impc.inverse.residuals import Evaluation
    from impc.model.structure import Structure

__all__ = ["PARAMETER_UNIT", "Compressed", "Coordinates", "Point", "WithPrior", "start_unit"]

#: A parameter's coordinate counts thirds of itself.
PARAMETER_UNIT = 1 / 3
_START_FLOOR = 1e-8
# Columns below that, of the largest, are rounding.
_EXPLAINED = 1e-12


@dataclass(frozen=True)
class Point:
    """What a point of a search stands for.

    Attributes
    ----------
    K : Array
        Gain (m, n).
    S : Array
        Metric (m, m).
    problem : Problem
        At the initial states and the parameters.
    """

    K: Array
    S: Array
    problem: Problem


@dataclass(frozen=True)
class Compressed:
    """Residual and derivative in bases of the derivative's QR factorisations, trial by trial.

    A search uses their norms and inner products only, which are those of the full ones; a
    recording of thousands of samples becomes a few dozen rows.

    Attributes
    ----------
    rows : ArrowRows
        Gain, metric and parameters are shared, initial states the trial's own.
    split : int
        How many of the shared columns stand before those of initial states; the rest after.
    """

    rows: ArrowRows
    split: int

    @property
    def residual(self) -> Array:
        """(r,)."""
        return np.ravel(self.rows.residual)

    @cached_property
    def jacobian(self) -> Array:
        """With respect to the q coordinates (r, q)."""
        shared, own = self.rows.shared, self.rows.own
        trials, height, n = own.shape
        starts = np.zeros((trials, height, trials, n))
        starts[np.arange(trials), :, np.arange(trials)] = own
        flat = shared.reshape(trials * height, -1)
        middle = starts.reshape(trials * height, -1)
        return np.hstack([flat[:, : self.split], middle, flat[:, self.split :]])


class Coordinates:
    """The coordinates of one search, and the residual in them.

    Caches the last evaluation, because the residual and its derivative come from one pass.

    Parameters
    ----------
    problem : Problem
    gain, metric : Array
        K (m, n) and S (m, m) where the search begins.
    structure : Structure, optional
        With one input: the search keeps to the span of gains that weights over its features have,
        and begins at the gain of that span next to the one given; any gain by default.
    """

    def __init__(
        self, problem: Problem, gain: Array, metric: Array, structure: Structure | None = None
    ) -> None:
        self.problem = problem
        #: Gain and metric as they were given, before the gain was moved to the span.
        self.given = gain, metric
        plant = problem.plant
        self.m, self.n, self.trials = plant.m, plant.n, len(problem.recordings)
        self.T, self.G = natural_coordinates(plant, gain)
        self.start_unit = start_unit(problem, gain)
        self.first = np.linalg.cholesky(metric * (plant.m / np.trace(metric)))
        self.gains = consistent_gains(plant, self.first @ self.first.T, self.T, self.G)
        if structure is not None:
            self.gains = regulators_alone(self.gains, plant, structure, self.T)
        self.tril = np.tril_indices(self.m)
        self.refused: list[str] = []
        self.last: tuple[bytes, Evaluation, Compressed] | None = None
        self.near: TerminalSet | None = None
        sizes = (
            len(self.gains.gains),
            len(self.tril[0]) - 1,
            self.trials * self.n if problem.unknown_start else 0,
            len(problem.logarithms),
        )
        self.ends = np.cumsum(sizes)
        self.start = self._pack(gain)

    def unpack(self, z: Array) -> Point:
        """The values at z (q,)."""
        along, factor, starts, parameters = np.split(z, self.ends[:-1])
        problem = self.problem_at(starts, parameters)
        product = np.tensordot(along, self.gains.products(problem.plant), 1)
        metric = self._metric(factor)
        gain = np.linalg.solve(metric, product)
        return Point(np.asarray(gain, dtype=np.float64), metric, problem)

    def problem_at(self, starts: Array, parameters: Array) -> Problem:
        """The problem at coordinates of its other unknowns.

        Parameters
        ----------
        starts : Array
            Of initial states (trials * n,); (0,) when they are known.
        parameters : Array
            (k,).
        """
        given = np.array([trial.x0 for trial in self.problem.recordings])
        if len(starts):
            given = given + starts.reshape(self.trials, self.n) @ self.start_unit.T
        return self.problem.at(given, self.problem.logarithms + PARAMETER_UNIT * parameters)

    def at(self, z: Array) -> Compressed:
        """Residual and derivative at z (q,)."""
        return self.evaluated(z)[1]

    def evaluated(self, z: Array, known: Evaluation | None = None) -> tuple[Evaluation, Compressed]:
        """The same at z (q,), as it was computed and compressed; `known` from another search."""
        key = z.tobytes()
        if self.last is None or self.last[0] != key:
            self.last = None  # of hundreds of trials there is no room for two
            here = self.unpack(z)
            found = known or evaluate(here.problem, here.K, here.S, self.near)
            self.near = found.terminal or self.near
            if found.reason:
                self.refused.append(found.reason)
            self.last = key, found, self._compress(found, *self.changes(here, z))
        return self.last[1:]

    def with_prior(self, weight: float) -> WithPrior:
        """The residual followed by weight * (z - start); nothing follows for a weight of 0."""
        return WithPrior(self, weight)

    def without_nuisance(self, z: Array) -> Array:
        """Derivative at z (q,) with respect to gain and metric that the rest leaves.

        Returns
        -------
        Array
            (r, g), g coordinates of gain and metric: orthogonal to the columns of initial states
            and parameters.
        """
        rows = self.at(z).rows
        left, values, _ = np.linalg.svd(rows.own, full_matrices=False)
        largest = np.max(values, initial=0.0)
        basis = left * (values > _EXPLAINED * largest)[:, None, :]
        shared = rows.shared - basis @ (np.swapaxes(basis, 1, 2) @ rows.shared)
        kept, nuisance = np.split(shared.reshape(-1, shared.shape[2]), [int(self.ends[1])], axis=1)
        if nuisance.shape[1] == 0:
            return kept
        size = np.sqrt(np.sum(rows.shared[..., int(self.ends[1]) :] ** 2, axis=(0, 1)))
        rest, values, _ = np.linalg.svd(nuisance, full_matrices=False)
        rest = rest[:, values > _EXPLAINED * max(largest, np.max(size))]
        return np.asarray(kept - rest @ (rest.T @ kept))

    def _pack(self, gain: Array) -> Array:
        shapes = np.diff(np.concatenate([[0], self.ends]))
        nuisance = np.zeros(int(shapes[2] + shapes[3]))
        along = np.tensordot(self.natural(self.gains.gains), self.natural(gain), 2)
        return np.concatenate([along, np.eye(self.m)[self.tril][1:], nuisance])

    def natural(self, gains: Array) -> Array:
        """G^-1 K T, (..., m, n), of gains (..., m, n)."""
        return np.asarray(np.linalg.solve(self.G, gains @ self.T))

    def _factor(self, entries: Array) -> Array:
        factor = np.zeros((self.m, self.m))
        factor[self.tril] = np.concatenate([[1.0], entries])
        return np.asarray(self.first @ factor, dtype=np.float64)

    def _metric(self, entries: Array) -> Array:
        factor = self._factor(entries)
        return np.asarray(factor @ factor.T)

    def changes(self, here: Point, z: Array) -> tuple[Array, Array]:
        """Change of K (q, m, n), and of S scaled to trace m (q, m, m), with each of z (q,)."""
        along, factor, _, _ = np.split(z, self.ends[:-1])
        lower, metric = self._factor(factor), []
        for row, column in list(zip(*self.tril, strict=True))[1:]:
            change = np.outer(self.first[:, row], lower[:, column])
            metric.append(change + change.T)
        dS = np.zeros((len(z), self.m, self.m))
        dS[self.ends[0] : self.ends[1]] = np.array(metric).reshape(-1, self.m, self.m)
        products = -dS @ here.K
        products[: self.ends[0]] += self.gains.products(here.problem.plant)
        family = here.problem.family
        if family is not None and self.m > 1:
            differential = plant_differential(family, here.problem.logarithms)
            drift = self.gains.drift(here.problem.plant, along, differential)
            products[self.ends[2] :] += PARAMETER_UNIT * drift
        dK = np.asarray(np.linalg.solve(here.S, products), dtype=np.float64)
        return dK, scaled_changes(here.S, dS)

    def _compress(self, found: Evaluation, dK: Array, dS: Array) -> Compressed:
        """Factor derivative and residual together, trial by trial, then apply the chain rule."""
        # Initial states move neither K nor S: with hundreds of trials they are most of the columns.
        first, last = int(self.ends[1]), int(self.ends[2])
        shared = np.delete(np.arange(len(dK)), slice(first, last))
        along = found.dK.reshape(-1, self.m * self.n) @ dK[shared].reshape(len(shared), -1).T
        if self.m > 1:
            along += found.dS.reshape(-1, self.m**2) @ dS[shared].reshape(len(shared), -1).T
        rows, row = [], 0
        sizes = [trial.outputs.size for trial in self.problem.recordings]
        if not self.problem.unknown_start:  # no column belongs to one trial: all are one block
            sizes = [sum(sizes)]
        for size in sizes:
            mine = slice(row, row + size)
            row = mine.stop
            blocks = [along[mine, :first]]
            blocks += [found.dx0[mine] @ self.start_unit] if found.dx0.shape[1] else []
            parameters = found.dparameters[mine] * PARAMETER_UNIT + along[mine, first:]
            blocks += [parameters, found.residual[mine, None]]
            triangle = triangular_rows(blocks)
            full = np.zeros((triangle.shape[1], triangle.shape[1]))
            full[: len(triangle)] = triangle
            rows.append(full)
        table = np.stack(rows)
        own = slice(first, first + found.dx0.shape[1])
        rest = np.delete(table[..., :-1], own, axis=2)
        return Compressed(ArrowRows(table[..., -1], rest, table[..., own]), first)


@dataclass(frozen=True)
class WithPrior:
    """Residual and derivative with the rows of a prior about the start.

    Attributes
    ----------
    space : Coordinates
    weight : float
        What a step of one away from the start counts in the residual.
    """

    space: Coordinates
    weight: float

    def residual(self, z: Array) -> Array:
        """Rows of the recordings at z (q,), then of the prior: (r + q,), or (r,) without it."""
        data = self.space.at(z).residual
        if self.weight == 0:
            return data
        return np.concatenate([data, self.weight * (z - self.space.start)])

    def derivative(self, z: Array) -> Array:
        """Derivative of `residual` at z (q,): (r + q, q), or (r, q) without a prior."""
        data = self.space.at(z).jacobian
        if self.weight == 0:
            return data
        return np.vstack([data, self.weight * np.eye(len(z))])


def start_unit(problem: Problem, gain: Array) -> Array:
    """Unit of initial states, (n, n), at a `gain` (m, n).

    They are thought of as any other state of their trials.

    A factor of the second moments that the states have when the gain's controller is driven as the
    recordings were. Where nothing drives it, white noise at the inputs of the size of the outputs.
    """
    plant = problem.plant
    controller = controller_for(problem, gain, np.eye(plant.m))
    runs = [simulate(controller, drive) for drive in scenarios(problem)]
    x = np.concatenate([run.x[: run.reached + 1] for run in runs])
    second = x.T @ x / len(x)
    if np.all(np.isfinite(second)) and np.all(np.diag(second) > 0):
        return np.asarray(np.linalg.cholesky(floored_covariance(second, _START_FLOOR)))
    T, _ = natural_coordinates(plant, gain)
    scaled = np.concatenate([trial.outputs / problem.output_scale for trial in problem.recordings])
    natural = float(np.linalg.norm(plant.C @ T / problem.output_scale[:, None]))
    size = float(np.sqrt(np.sum(np.mean(scaled**2, axis=0))))
    return size / natural * T if size > 0 and natural > 0 else T
