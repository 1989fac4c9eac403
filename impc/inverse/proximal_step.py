"""Semidefinite program of one prox-linear step (docs/why/theory.md).

In the coordinates d of dX = L D L', D = sum d_i basis_i, with an epigraph variable f of the norm,

    minimise    w_fit f (or w_fit f^2) + w_cond kappa a
    subject to  ||(residual + jacobian d, rest)|| <= f,   ||d|| <= radius,
                D + I - L^-1 L^-T >= 0                  (X + dX >= I, in coordinates of L)
                a I - (X + L D L') / kappa >= 0         (X + dX <= kappa a I).

Each matrix inequality is scaled so that its entries are of order one for every kappa, and the norm
so that those of residual and jacobian are.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy.linalg

from impc.arrays import Array, Frozen, frozen
from impc.inverse.semidefinite import Cone, matrix_inequality, norm_bound, solve_semidefinite


@dataclass(frozen=True)
class StepProgram(Frozen):
    """Data of the step program."""

    # blkdiag(Q, R) (n + m, n + m), scaled to a least eigenvalue of 1, and its Cholesky factor
    X: Array
    L: Array
    n: int  # Size of Q
    basis: Array  # (k, n + m, n + m), of `block_basis`
    jacobian: Array  # (r, k)
    residual: Array  # (r,)
    rest: float  # Norm of the residual component that no step changes
    fit_weight: float  # w_fit and w_cond
    condition_weight: float
    squared: bool  # Whether the fit term is squared


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
    return frozen(members)


def solve_step(program: StepProgram, radius: float) -> tuple[Array, float]:
    """Step d (k,) of norm at most `radius`, and the objective predicted by the model."""
    count, kappa = len(program.basis), float(scipy.linalg.eigvalsh(program.X)[-1])
    sizes = [*np.ravel(program.jacobian), *program.residual, program.rest]
    unit = float(np.linalg.norm(sizes)) or 1.0  # of f
    cost_weight, effort = program.condition_weight * kappa, program.fit_weight
    effort *= unit**2 if program.squared else unit
    scale = max(cost_weight, effort)
    linear, squares = np.zeros(count + 2), np.zeros(count + 2)
    linear[count] = cost_weight / scale
    (squares if program.squared else linear)[-1] = effort / scale
    cones = [*_inequalities(program, kappa), _ball(count, radius), _epigraph(program, unit)]
    step = solve_semidefinite(linear, cones, squares=squares).y[:count]
    return step, _predict(program, step)


def _predict(program: StepProgram, step: Array) -> float:
    """Objective of the model, recomputed from the step."""
    inner = np.eye(len(program.X)) + np.tensordot(step, program.basis, 1)
    moved = program.L @ inner @ program.L.T
    eigenvalues = scipy.linalg.eigvalsh((moved + moved.T) / 2)
    if eigenvalues[0] <= 0:
        return float("inf")
    size = float(np.hypot(np.linalg.norm(program.residual + program.jacobian @ step), program.rest))
    fit = size**2 if program.squared else size
    condition = float(eigenvalues[-1] / eigenvalues[0])
    return program.fit_weight * fit + program.condition_weight * condition


def _inequalities(program: StepProgram, kappa: float) -> list[Cone]:
    """The two matrix inequalities, one cone for each diagonal block."""
    total = len(program.X)
    inverse = scipy.linalg.solve_triangular(program.L, np.eye(total), lower=True)
    floor = np.eye(total) - inverse @ inverse.T
    ceiling = -program.L @ program.basis @ program.L.T / kappa
    unused = np.zeros((1, total, total))
    below = np.concatenate([program.basis, unused, unused])
    above = np.concatenate([ceiling, np.eye(total)[None], unused])
    cones = []
    for block in (slice(0, program.n), slice(program.n, total)):
        cones.append(matrix_inequality(floor[block, block], below[:, block, block]))
        upper = -program.X[block, block] / kappa
        cones.append(matrix_inequality(upper, above[:, block, block]))
    return cones


def _ball(count: int, radius: float) -> Cone:
    return norm_bound(np.eye(count + 2, count), np.zeros(count + 2), constant=radius)


def _epigraph(program: StepProgram, unit: float) -> Cone:
    count, size = len(program.basis), len(program.residual)
    vectors, bound = np.zeros((count + 2, size + 1)), np.zeros(count + 2)
    vectors[:count, :size] = program.jacobian.T / unit
    bound[-1] = 1.0
    return norm_bound(vectors, bound, offset=np.append(program.residual, program.rest) / unit)
