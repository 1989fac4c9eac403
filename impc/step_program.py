"""The semidefinite program of one prox-linear step, handed to Clarabel as it is.

cvxpy would read better, but spends ten times as long on writing this program down as Clarabel does
on solving it, at every step. In the coordinates d of dX = L D L', D = sum d_i basis_i,

    minimise    w_fit phi(residual + jacobian d) + w_cond kappa a
    subject to  D + I - X^-1 >= 0                       (X + dX >= I, seen through L)
                a I - (X + L D L') / kappa >= 0         (X + dX <= kappa a I)
                ||d|| <= radius.

Both matrix inequalities have entries of order one whatever kappa is, because each is written in
the coordinates in which it is well scaled.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import clarabel
import numpy as np
import scipy.linalg
import scipy.sparse

from impc.arrays import Array
from impc.errors import SolverError

__all__ = ["StepProgram", "block_basis", "solve_step"]


@dataclass(frozen=True)
class StepProgram:
    """Data of the program in the module's text; `rest` is what no step can change of the residual."""

    X: Array
    L: Array
    n: int
    basis: Array
    jacobian: Array
    residual: Array
    rest: float
    fit_weight: float
    condition_weight: float
    squared: bool


@lru_cache(maxsize=16)
def block_basis(n: int, m: int) -> Array:
    """Orthonormal basis of the symmetric matrices blkdiag(n x n, m x m): (k, n + m, n + m)."""
    members = []
    for first, size in ((0, n), (n, m)):
        for column in range(size):
            for row in range(column + 1):
                member = np.zeros((n + m, n + m))
                value = 1.0 if row == column else np.sqrt(0.5)
                member[first + row, first + column] = value
                member[first + column, first + row] = value
                members.append(member)
    return np.array(members)


def solve_step(program: StepProgram, radius: float) -> tuple[Array, float]:
    """Solve for the step d (k,) and the objective that it predicts.

    Raises
    ------
    SolverError
        When Clarabel returns no usable point; d = 0 is always feasible, so this is numerical.
    """
    count, kappa = len(program.basis), float(scipy.linalg.eigvalsh(program.X)[-1])
    norm_form = not program.squared
    width = count + 1 + norm_form  # d, a, and the epigraph of the norm
    blocks: list[tuple[Array, Array, object]] = [
        *_semidefinite(program, kappa, width),
        _ball(count, width, radius),
    ]
    if norm_form:
        blocks.append(_norm(program, count, width))
    quadratic = np.zeros((width, width))
    linear = np.zeros(width)
    linear[count] = program.condition_weight * kappa
    if norm_form:
        linear[-1] = program.fit_weight
    else:
        weight = 2 * program.fit_weight
        quadratic[:count, :count] = weight * program.jacobian.T @ program.jacobian
        linear[:count] = weight * program.jacobian.T @ program.residual
    scale = max(float(np.max(np.abs(linear))), 1e-300)
    solution = clarabel.DefaultSolver(
        scipy.sparse.csc_matrix(np.triu(quadratic) / scale),
        linear / scale,
        scipy.sparse.csc_matrix(np.vstack([block[0] for block in blocks])),
        np.concatenate([block[1] for block in blocks]),
        [block[2] for block in blocks],
        _settings(),
    ).solve()
    step = np.asarray(solution.x)[:count]
    if not np.all(np.isfinite(step)):
        raise SolverError("step program", f"Clarabel: {solution.status}", "start elsewhere")
    predicted = _predict(program, step)
    return step, predicted


def _predict(program: StepProgram, step: Array) -> float:
    """The model's objective at the step, from the step itself and not from the solver's word."""
    moved = (
        program.L @ (np.eye(len(program.X)) + np.tensordot(step, program.basis, 1)) @ program.L.T
    )
    eigenvalues = scipy.linalg.eigvalsh((moved + moved.T) / 2)
    size = float(np.hypot(np.linalg.norm(program.residual + program.jacobian @ step), program.rest))
    fit = size**2 if program.squared else size
    if eigenvalues[0] <= 0:
        return float("inf")
    return program.fit_weight * fit + program.condition_weight * float(
        eigenvalues[-1] / eigenvalues[0]
    )


def _semidefinite(
    program: StepProgram, kappa: float, width: int
) -> list[tuple[Array, Array, object]]:
    """The two matrix inequalities, one cone for each diagonal block."""
    inverse = scipy.linalg.solve_triangular(program.L, np.eye(len(program.L)), lower=True)
    lower = inverse @ inverse.T
    upper = program.L @ program.basis @ program.L.T / kappa
    total = len(program.X)
    count = len(program.basis)
    cones = []
    for block in (slice(0, program.n), slice(program.n, total)):
        eye = np.eye(block.stop - block.start)
        below = np.zeros((len(_triangle(eye)), width))
        below[:, :count] = -np.array([_triangle(item[block, block]) for item in program.basis]).T
        cone = clarabel.PSDTriangleConeT(len(eye))
        cones.append((below, _triangle(eye - lower[block, block]), cone))
        above = np.zeros_like(below)
        above[:, :count] = np.array([_triangle(item[block, block]) for item in upper]).T
        above[:, count] = -_triangle(eye)
        cones.append((above, _triangle(-program.X[block, block] / kappa), cone))
    return cones


def _ball(count: int, width: int, radius: float) -> tuple[Array, Array, object]:
    rows = np.zeros((count + 1, width))
    rows[1:, :count] = -np.eye(count)
    right = np.zeros(count + 1)
    right[0] = radius
    return rows, right, clarabel.SecondOrderConeT(count + 1)


def _norm(program: StepProgram, count: int, width: int) -> tuple[Array, Array, object]:
    size = len(program.residual) + 2
    rows, right = np.zeros((size, width)), np.zeros(size)
    rows[0, -1] = -1.0
    rows[1:-1, :count] = -program.jacobian
    right[1:-1] = program.residual
    right[-1] = program.rest
    return rows, right, clarabel.SecondOrderConeT(size)


def _triangle(matrix: Array) -> Array:
    """Upper triangle by columns, off-diagonals times sqrt(2): Clarabel's order."""
    rows, columns = np.tril_indices(len(matrix))
    return np.asarray(np.where(rows == columns, 1.0, np.sqrt(2.0)) * matrix[columns, rows])


def _settings() -> object:
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    # Tighter than the default 1e-8: the step's error is the error of the answer at a kink.
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-11
    settings.max_threads = 1
    return settings
