"""State-feedback gain behind recorded outputs, with or without bounds.

Without bounds this is the first line of Table 3.1; with them it is the reduced form of inverse
MPC: the recordings determine K, and for several inputs the metric S while bounds are active, and
nothing else (docs/theory.md).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.optimize

from impc.arrays import Array, frozen
from impc.errors import SolverError
from impc.inverse_problem import evaluate
from impc.lqr import solve_lqr
from impc.weights import stage_weights

if TYPE_CHECKING:
    from impc.inverse_problem import Evaluation, InverseProblem

__all__ = ["GainFit", "fit_gain"]


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
    singular_values: Array
    metric_determined: bool
    evaluations: int
    refused: tuple[str, ...]


def fit_gain(
    problem: InverseProblem,
    gain: Array | None = None,
    metric: Array | None = None,
    *,
    max_evaluations: int = 200,
) -> GainFit:
    """Fit K, and S for several inputs, by trust-region least squares with exact derivatives.

    Parameters
    ----------
    problem : InverseProblem
    gain, metric : Array, optional
        Start; the regulator of identity weights by default.
    max_evaluations : int
        Budget of simulations with derivatives.

    Raises
    ------
    SolverError
        When the recording cannot even be simulated from the start.
    """
    solution = solve_lqr(problem.plant, stage_weights(np.eye(problem.plant.n), np.eye(problem.plant.m)))
    start_gain = solution.K if gain is None else gain
    start_metric = solution.S if metric is None else metric
    space = _Coordinates(problem, start_metric)
    first = space.at(space.pack(start_gain))
    if first.reason:
        raise SolverError(
            "gain", f"cannot start there: {first.reason}", "start from a stabilising gain"
        )
    found = scipy.optimize.least_squares(
        lambda z: space.at(z).residual,
        space.pack(start_gain),
        jac=lambda z: space.jacobian(z),
        x_scale="jac",
        ftol=1e-15,
        xtol=1e-15,
        gtol=1e-15,
        max_nfev=max_evaluations,
    )
    K, S = space.unpack(found.x)
    jacobian = space.jacobian(found.x)
    return GainFit(
        frozen(K),
        frozen(S),
        float(np.linalg.norm(found.fun)),
        frozen(np.linalg.svd(jacobian, compute_uv=False)),
        space.metric_determined(jacobian),
        int(found.nfev),
        tuple(space.refused),
    )


class _Coordinates:
    """Unknowns of the search: the entries of K, then those of the Cholesky factor of S but one.

    Caches the last evaluation, because the residual and its derivative come from one pass.
    """

    def __init__(self, problem: InverseProblem, metric: Array) -> None:
        self.problem = problem
        self.factor = np.linalg.cholesky(metric / metric[0, 0])
        self.tril = np.tril_indices(problem.plant.m)
        self.refused: list[str] = []
        self.last: tuple[bytes, Evaluation] | None = None

    def pack(self, gain: Array) -> Array:
        return np.concatenate([np.ravel(gain), self.factor[self.tril][1:]])

    def unpack(self, z: Array) -> tuple[Array, Array]:
        m, n = self.problem.plant.m, self.problem.plant.n
        factor = np.zeros((m, m))
        factor[self.tril] = np.concatenate([[1.0], z[m * n :]])
        return z[: m * n].reshape(m, n), factor @ factor.T

    def at(self, z: Array) -> Evaluation:
        key = z.tobytes()
        if self.last is None or self.last[0] != key:
            evaluation = evaluate(self.problem, *self.unpack(z))
            if evaluation.reason:
                self.refused.append(evaluation.reason)
            self.last = (key, evaluation)
        return self.last[1]

    def jacobian(self, z: Array) -> Array:
        m, n = self.problem.plant.m, self.problem.plant.n
        evaluation = self.at(z)
        dK = evaluation.dK.reshape(-1, m * n)
        if m == 1:
            return dK
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
            scaled = scale * (moved - metric * np.trace(moved) / np.trace(metric))
            columns.append(np.tensordot(evaluation.dS, scaled, 2))
        return np.hstack([dK, np.column_stack(columns)])

    def metric_determined(self, jacobian: Array) -> bool:
        size = self.problem.plant.m * self.problem.plant.n
        if jacobian.shape[1] == size:
            return False
        basis, _ = np.linalg.qr(jacobian[:, :size])
        rest = jacobian[:, size:] - basis @ (basis.T @ jacobian[:, size:])
        values = np.linalg.svd(rest, compute_uv=False)
        return bool(values[-1] > 1e-8 * np.linalg.norm(jacobian, 2))
