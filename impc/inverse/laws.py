"""Unknowns of the controller: a gain with its metric, cost weights, or none.

Gain and metric: z = (G^-1 K T | factor of S without its first entry). T T' is the state covariance
under the first gain with white noise at the inputs, and G scales the inputs to that noise
(`natural_coordinates`; 1 with one input), so that a unit step moves the command by one SD of that
noise. S = L F F'L' with the first S = LL' and F lower triangular. Gain and metric are independent:
without active bounds S has no effect. For every optimal regulator ||K T|| <= (tr(B'PB)/R)^(1/2),
because white noise costs tr(B'PB) per sample, which includes R u^2.

Cost weights: z = logarithms of the free cost weights of a structure over those of the start.
"""

from __future__ import annotations

import numpy as np

from impc.arrays import Array, BoolArray
from impc.control.controller import Controller
from impc.control.terminal_set import TerminalSet
from impc.inverse.prediction import Correction
from impc.inverse.problem import Problem, controller_for, require_riccati, weights_controller
from impc.inverse.residuals import scaled_changes, stable_controller
from impc.inverse.solution_set import natural_coordinates
from impc.model.plant import Plant
from impc.model.plant_family import plant_differential
from impc.model.riccati import LqrSolution, regulator_changes, solve_lqr
from impc.model.structure import Structure


class FixedLaw:
    """A given gain (m, n) and metric (m, m)."""

    start = np.zeros(0)

    def __init__(self, gain: Array, metric: Array) -> None:
        self.given = gain, metric

    def reference(self, _problem: Problem) -> Array:
        """The gain."""
        return self.given[0]

    def pair(self, _problem: Problem, _part: Array) -> tuple[Array, Array]:
        """Gain and metric."""
        return self.given

    def controller(
        self,
        problem: Problem,
        _part: Array,
        near: TerminalSet | None,
        _correction: Correction | None,
    ) -> Controller:
        """Controller of the gain."""
        return controller_for(problem, *self.given, near)

    def columns(self, problem: Problem, _part: Array) -> dict[str, Array]:
        """Parameters move neither gain nor metric."""
        return {"K": np.zeros((*self.given[0].shape, len(problem.logarithms)))}

    def cost_weights(self, _part: Array) -> None:
        """None: the controller is given."""


class GainLaw:
    """Combinations of `gains` (k, m, n), by default all, and a metric, about a gain.

    The gain must stabilise, or the coordinates be those of the plant instead of `whitened` ones.
    """

    def __init__(
        self,
        problem: Problem,
        gain: Array,
        metric: Array,
        gains: Array | None = None,
        *,
        whitened: bool = True,
    ) -> None:
        require_riccati(problem)
        m, n = gain.shape
        self.given = gain, metric
        plain = np.eye(n), np.eye(m)
        self.T, self.G = natural_coordinates(problem.plant, gain) if whitened else plain
        if gains is None:
            gains = self.G @ np.eye(m * n).reshape(-1, m, n) @ np.linalg.inv(self.T)
        self.gains = gains
        self.first = np.linalg.cholesky(metric * (m / np.trace(metric)))
        self.tril = np.tril_indices(m)
        self.start = self.at_gain(gain)

    def at_gain(self, gain: Array) -> Array:
        """Unknowns (count,) of another gain (m, n), or of its projection, with the first metric."""
        along = np.tensordot(self.natural(self.gains), self.natural(gain), 2)
        return np.concatenate([along, np.eye(len(gain))[self.tril][1:]])

    def natural(self, gains: Array) -> Array:
        """G^-1 K T (..., m, n) of gains K (..., m, n)."""
        return np.asarray(np.linalg.solve(self.G, gains @ self.T))

    def along(self, gains: Array, metrics: Array) -> Array:
        """Changes (k, count) of the start by those of all gains (k, m, n), metrics (k, m, m)."""
        m = len(self.first)
        factor = np.linalg.inv(self.first)
        moved = factor @ (m / np.trace(self.given[1]) * metrics) @ factor.T
        moved = moved - moved[:, :1, :1] * np.eye(m)  # the scale of a metric has no effect
        moved = moved / (1 + np.eye(m))
        steps = moved[:, self.tril[0], self.tril[1]][:, 1:]
        return np.hstack([self.natural(gains).reshape(len(gains), -1), steps])

    def reference(self, _problem: Problem) -> Array:
        """The gain that defines the whitened coordinates."""
        return self.given[0]

    def pair(self, _problem: Problem, part: Array) -> tuple[Array, Array]:
        """Gain (m, n) and metric (m, m) at `part` (count,)."""
        along, factor = np.split(part, [len(self.gains)])
        lower = self._factor(factor)
        return np.asarray(np.tensordot(along, self.gains, 1)), np.asarray(lower @ lower.T)

    def controller(
        self,
        problem: Problem,
        part: Array,
        near: TerminalSet | None,
        correction: Correction | None,
    ) -> Controller:
        """Controller of gain and metric; raises for an unstable gain with bounds."""
        return stable_controller(problem, *self.pair(problem, part), near, correction)

    def columns(self, problem: Problem, part: Array) -> dict[str, Array]:
        """Derivatives of K and of S scaled to trace m; parameters move neither."""
        count, (m, n) = len(self.gains), self.given[0].shape
        dK = np.zeros((m, n, len(part) + len(problem.logarithms)))
        dS = np.zeros((m, m, dK.shape[2]))
        dK[..., :count] = np.moveaxis(self.gains, 0, -1)
        if m > 1:
            lower = self._factor(part[count:])
            moved = scaled_changes(lower @ lower.T, _factor_changes(self.first, lower))
            dS[..., count : len(part)] = np.moveaxis(moved, 0, -1)
        return {"K": dK, "S": dS}

    def cost_weights(self, _part: Array) -> None:
        """None: a gain can have many weights, or none."""

    def _factor(self, entries: Array) -> Array:
        factor = np.zeros_like(self.first)
        factor[self.tril] = np.concatenate([[1.0], entries])
        return np.asarray(self.first @ factor, dtype=np.float64)


class WeightLaw:
    """Free cost weights of a structure; those of minus infinity stay zero."""

    def __init__(self, structure: Structure, cost_weights: Array) -> None:
        self.structure, self.given = structure, np.array(cost_weights)
        self.moving: BoolArray = np.isfinite(self.given)
        self.start = np.zeros(int(np.count_nonzero(self.moving)))
        self.solved: tuple[Plant, bytes, LqrSolution] | None = None

    def cost_weights(self, part: Array) -> Array:
        """Unknowns of the structure (count,) at `part`."""
        found = self.given.copy()
        found[self.moving] += part
        return found

    def regulator(self, problem: Problem, part: Array) -> LqrSolution:
        """Riccati solution; the last one is kept."""
        plant, key = problem.plant, part.tobytes()
        if self.solved is None or self.solved[0] is not plant or self.solved[1] != key:
            found = solve_lqr(plant, self.structure.weights(self.cost_weights(part)))
            self.solved = plant, key, found
        return self.solved[2]

    def reference(self, problem: Problem) -> Array:
        """The gain at the start."""
        return self.pair(problem, self.start)[0]

    def pair(self, problem: Problem, part: Array) -> tuple[Array, Array]:
        """Gain (m, n) and metric (m, m); with a given terminal weight those of the first stage."""
        if problem.terminal_weight is not None:
            found = weights_controller(problem, self.structure.weights(self.cost_weights(part)))
            return np.array(found.K), np.array(found.S)
        solution = self.regulator(problem, part)
        return np.array(solution.K), np.array(solution.S)

    def controller(
        self,
        problem: Problem,
        part: Array,
        near: TerminalSet | None,
        correction: Correction | None,
    ) -> Controller:
        """Controller of the weights."""
        if problem.terminal_weight is not None:
            return weights_controller(problem, self.structure.weights(self.cost_weights(part)))
        return stable_controller(problem, *self.pair(problem, part), near, correction)

    def columns(self, problem: Problem, part: Array) -> dict[str, Array]:
        """Derivatives of K and S by free cost weights and parameters; or of Q and R."""
        unknowns, count = self.cost_weights(part), self.structure.count
        kept = np.concatenate([self.moving, np.ones(len(problem.logarithms), bool)])
        if problem.terminal_weight is not None:
            names, slopes = "QR", self.structure.changes(unknowns)
        else:
            solution = self.regulator(problem, part)
            dK, dS = regulator_slopes(problem, self.structure, unknowns, solution)
            names, slopes = "KS", (dK, scaled_changes(np.array(solution.S), dS))
        assert len(slopes[0]) == count + len(problem.logarithms)  # a family excludes Q and R
        return {
            name: np.moveaxis(slope[kept], 0, -1) for name, slope in zip(names, slopes, strict=True)
        }


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


def _factor_changes(first: Array, lower: Array) -> Array:
    """Change (k, m, m) of L F F'L' by entries of F but the first, of L and of L F (m, m)."""
    found = []
    for row, column in list(zip(*np.tril_indices(len(first)), strict=True))[1:]:
        change = np.outer(first[:, row], lower[:, column])
        found.append(change + change.T)
    return np.array(found).reshape(-1, *first.shape)
