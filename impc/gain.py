"""State-feedback gain behind recorded outputs, with or without bounds.

Without bounds this is the first line of Table 3.1; with them it is the reduced form of inverse
MPC: the recordings determine K, and for several inputs the metric S while bounds are active, and
nothing else (docs/theory.md).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import scipy.linalg
import scipy.optimize

from impc.arrays import Array, frozen
from impc.errors import SolverError
from impc.gain_fibre import natural_coordinates
from impc.inverse_problem import evaluate
from impc.lqr import is_stable, solve_lqr
from impc.weights import stage_weights

if TYPE_CHECKING:
    from impc.inverse_problem import Evaluation, InverseProblem
    from impc.terminal_set import TerminalSet
    from impc.weights import Weights

__all__ = ["GainFit", "bryson_starts", "bryson_weights", "fit_gain"]

_EXPLAINED = 1e-9
_BLOCK = 4096
_PRICES = 10.0 ** np.arange(-6, 4)


@dataclass(frozen=True)
class GainFit:
    """A gain fitted to recordings.

    Attributes
    ----------
    K : Array
        (m, n).
    S : Array
        Metric (m, m); the one it started from where the recordings do not determine it.
    misfit : float
        2-norm of the output residual.
    explained : bool
        Whether the gain stabilises and the misfit is at most 1e-9 of the recorded outputs.
    stabilises : bool
        Whether A - BK is stable. Without a terminal set the search may end where it is not.
    singular_values : Array
        Of the residual's derivative with respect to K and S, largest first.
    metric_determined : bool
        Whether the recordings determine S: every singular value of its part, after K has taken
        what it can, is above 1e-8 of the largest.
    evaluations : int
        Simulations with derivatives.
    refused : tuple of str
        Reasons of the trial gains that were stepped back from.
    """

    K: Array
    S: Array
    misfit: float
    explained: bool
    stabilises: bool
    singular_values: Array
    metric_determined: bool
    evaluations: int
    refused: tuple[str, ...]


def fit_gain(
    problem: InverseProblem,
    *starts: tuple[Array, Array],
    attempts: int = 3,
    max_evaluations: int = 80,
) -> GainFit:
    """Fit K, and S for several inputs, by trust-region least squares with exact derivatives.

    The misfit has local minima, and beyond some of them the gain no longer stabilises the plant
    although the recording ends before that shows. So the search is made from the few most
    promising of the given starts and of a family of regulators, until one explains the recordings.

    Parameters
    ----------
    problem : InverseProblem
    starts : pairs of Array
        Gains (m, n) and metrics (m, m) to start from, besides the regulators of `bryson_starts`.
    attempts : int
        Number of searches at most. They end at a misfit of 1e-9 of the recorded outputs.
    max_evaluations : int
        Budget of simulations with derivatives of each search.

    Raises
    ------
    SolverError
        When the recordings cannot be simulated from any start.
    """
    ranked, evaluations, refused = _rank(problem, [*starts, *bryson_starts(problem)])
    if not ranked:
        raise SolverError(
            "gain", f"no start can be simulated: {refused[0]}", "give a start of your own"
        )
    best: GainFit | None = None
    for K, S in ranked[:attempts]:
        found = _search(problem, K, S, max_evaluations)
        evaluations += found.evaluations
        refused += found.refused
        if best is None or _preference(found) < _preference(best):
            best = found
        if found.explained:
            break
    assert best is not None  # attempts >= 1 and something was ranked
    return replace(best, evaluations=evaluations, refused=tuple(refused))


def bryson_weights(problem: InverseProblem) -> list[Weights]:
    """Weights that price each recorded output by its size (Bryson's rule), over a range of efforts.

    Q = C'diag(1/mean(y^2))C plus 1e-8 of its mean diagonal, R = rho I for rho from 1e-6 to 1e3.
    """
    plant = problem.plant
    recorded = np.concatenate([trial.outputs for trial in problem.recordings])
    power = np.maximum(np.mean(recorded**2, axis=0), 1e-300)
    Q = plant.C.T @ np.diag(1 / power) @ plant.C
    Q += 1e-8 * np.trace(Q) / plant.n * np.eye(plant.n)
    return [stage_weights(Q, rho * np.eye(plant.m)) for rho in _PRICES]


def bryson_starts(problem: InverseProblem) -> list[tuple[Array, Array]]:
    """Gains and metrics of the regulators of `bryson_weights`."""
    solutions = [solve_lqr(problem.plant, weights) for weights in bryson_weights(problem)]
    return [(np.array(item.K), np.array(item.S)) for item in solutions]


def _rank(
    problem: InverseProblem, starts: list[tuple[Array, Array]]
) -> tuple[list[tuple[Array, Array]], int, list[str]]:
    """The usable starts by their misfit, the evaluations spent, and why the others are not."""
    usable, refused = [], []
    plant = problem.plant
    for K, S in starts:
        found = evaluate(problem, K, S)
        if not is_stable(plant.A - plant.B @ K, discrete=True):
            refused.append("the gain does not stabilise the plant")
        elif found.reason:
            refused.append(found.reason)
        else:
            usable.append((float(np.linalg.norm(found.residual)), K, S))
    usable.sort(key=lambda item: item[0])
    return [(K, S) for _, K, S in usable], len(starts), refused


def _search(problem: InverseProblem, gain: Array, metric: Array, budget: int) -> GainFit:
    space = _Coordinates(problem, gain, metric)
    found = scipy.optimize.least_squares(
        space.residual,
        space.pack(gain),
        jac=space.derivative,
        ftol=1e-12,
        xtol=1e-12,
        gtol=1e-15,
        max_nfev=budget,
    )
    K, S = space.unpack(found.x)
    jacobian = space.at(found.x).jacobian
    plant = problem.plant
    stabilises = is_stable(plant.A - plant.B @ K, discrete=True)
    size = np.linalg.norm([np.linalg.norm(trial.outputs) for trial in problem.recordings])
    misfit = float(np.linalg.norm(found.fun))
    return GainFit(
        frozen(K),
        frozen(S),
        misfit,
        bool(stabilises and misfit <= _EXPLAINED * size),
        stabilises,
        frozen(np.linalg.svd(jacobian, compute_uv=False)),
        space.metric_determined(jacobian),
        int(found.nfev),
        tuple(space.refused),
    )


def _preference(found: GainFit) -> tuple[bool, float]:
    """Smaller is better. A gain that does not stabilise cannot be that of any weights."""
    return not found.stabilises, found.misfit


@dataclass(frozen=True)
class _Compressed:
    """Residual and derivative in the basis of the derivative's QR factorisation.

    The search uses their norms and inner products only, which are those of the full ones; a
    recording of thousands of samples becomes a dozen rows.
    """

    residual: Array
    jacobian: Array


def _compress(evaluation: Evaluation, chain: Array) -> _Compressed:
    """Factor derivative and residual together, block by block, then apply the chain rule.

    Blocks of a few thousand rows stay in the processor's cache: a recording ten times as long
    takes ten times the time, not fifteen.
    """
    _, m, n = evaluation.dK.shape
    parts = [evaluation.dK.reshape(-1, m * n)]
    if m > 1:
        parts.append(evaluation.dS.reshape(-1, m * m))
    width = sum(part.shape[1] for part in parts) + 1
    triangle = np.zeros((0, width))
    for first in range(0, len(evaluation.residual), _BLOCK):
        rows = slice(first, first + _BLOCK)
        block = np.column_stack([*(part[rows] for part in parts), evaluation.residual[rows]])
        (upper,) = scipy.linalg.qr(np.vstack([triangle, block]), mode="r", check_finite=False)
        triangle = np.asarray(upper[:width], dtype=np.float64)
    return _Compressed(triangle[:, -1], triangle[:, :-1] @ chain)


class _Coordinates:
    """Unknowns of the search: the entries of K T, then those of the Cholesky factor of S but one.

    T T' is the covariance of the states that the first gain gives when white noise enters at the
    inputs, so that a step of length one moves the command by one unit of that noise, whatever the
    units of the states. On the seat, at four torque limits, a trust region in these coordinates
    reached the gain from 7 of 11 starts, in raw entries from 5, and in raw entries with columns
    scaled by the Jacobian from 4 (experiments/benchmarks/search.py).

    Caches the last evaluation, because the residual and its derivative come from one pass.
    """

    def __init__(self, problem: InverseProblem, gain: Array, metric: Array) -> None:
        self.problem = problem
        self.T, _ = natural_coordinates(problem.plant, gain)
        self.factor = np.linalg.cholesky(metric / metric[0, 0])
        self.tril = np.tril_indices(problem.plant.m)
        self.refused: list[str] = []
        self.last: tuple[bytes, _Compressed] | None = None
        self.near: TerminalSet | None = None

    def pack(self, gain: Array) -> Array:
        return np.concatenate([np.ravel(gain @ self.T), self.factor[self.tril][1:]])

    def unpack(self, z: Array) -> tuple[Array, Array]:
        m, n = self.problem.plant.m, self.problem.plant.n
        factor = np.zeros((m, m))
        factor[self.tril] = np.concatenate([[1.0], z[m * n :]])
        gain = np.linalg.solve(self.T.T, z[: m * n].reshape(m, n).T).T
        return np.asarray(gain, dtype=np.float64), factor @ factor.T

    def residual(self, z: Array) -> Array:
        return self.at(z).residual

    def derivative(self, z: Array) -> Array:
        return self.at(z).jacobian

    def at(self, z: Array) -> _Compressed:
        key = z.tobytes()
        if self.last is None or self.last[0] != key:
            evaluation = evaluate(self.problem, *self.unpack(z), self.near)
            self.near = evaluation.terminal or self.near
            if evaluation.reason:
                self.refused.append(evaluation.reason)
            self.last = (key, _compress(evaluation, self.chain(z)))
        return self.last[1]

    def chain(self, z: Array) -> Array:
        """d (K, S) / d z, entries row by row: (m n + m m, k), or (n, n) for one input."""
        m, n = self.problem.plant.m, self.problem.plant.n
        on_gain = np.kron(np.eye(m), np.linalg.inv(self.T).T)
        if m == 1:
            return np.asarray(on_gain, dtype=np.float64)
        factor = np.zeros((m, m))
        factor[self.tril] = np.concatenate([[1.0], z[m * n :]])
        metric = factor @ factor.T
        scale = m / np.trace(metric)
        columns = []
        for row, column in list(zip(*self.tril, strict=True))[1:]:
            moved = np.zeros((m, m))
            moved[row] = factor[:, column]
            moved = moved + moved.T
            # The controller scales the metric to a mean diagonal of 1.
            columns.append(scale * (moved - metric * np.trace(moved) / np.trace(metric)).ravel())
        return np.asarray(scipy.linalg.block_diag(on_gain, np.column_stack(columns)))

    def metric_determined(self, jacobian: Array) -> bool:
        size = self.problem.plant.m * self.problem.plant.n
        if jacobian.shape[1] == size:
            return False
        basis, _ = np.linalg.qr(jacobian[:, :size])
        rest = jacobian[:, size:] - basis @ (basis.T @ jacobian[:, size:])
        values = np.linalg.svd(rest, compute_uv=False)
        return bool(values[-1] > 1e-8 * np.linalg.norm(jacobian, 2))
