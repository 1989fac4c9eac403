"""Least squares over weights: a search that cannot leave them.

With several inputs most pairs (K, S) are those of no weights: S K A^-1 B = B'PB has to be symmetric
(docs/theory.md, section 2). A fitted pair misses that by its rounding, and where the recordings say
little of S by much. Here (Q, R) themselves move, as

    X = blkdiag(Q, R) = L L'   ->   L exp(D) L',

so that they stay positive definite, and each step is the least-squares one among the D of a
trust region (Levenberg and Marquardt). Its length does not depend on the units of
states and inputs, and what the recordings do not tell of the weights stays as it was.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.linalg

from impc.arrays import Array, frozen
from impc.checking import replace
from impc.errors import SolverError, WeightsError
from impc.inverse.problem import recorded_size
from impc.inverse.proximal_search import Residual, weight_jacobian
from impc.inverse.proximal_step import block_basis
from impc.inverse.residuals import evaluate
from impc.inverse.solution_set import split_blocks
from impc.model.riccati import solve_lqr
from impc.model.weights import normalised

if TYPE_CHECKING:
    from impc.inverse.problem import Problem
    from impc.model.riccati import LqrSolution
    from impc.model.weights import Weights

__all__ = ["WeightsSearch", "search_weights"]

# The search ends where a step promises less than this of the squared misfit, or with a misfit of
# this of the recordings: rounding in a simulation of 200 samples leaves 1e-15 to 1e-13.
_SETTLED, _EXACT = 1e-10, 1e-14
# Lengths of D: a step of 1 changes the weight of one combination of states e-fold.
_FIRST_RADIUS, _LARGEST_RADIUS, _LEAST_RADIUS = 1.0, 4.0, 1e-9
# Directions below this share of the largest singular value are left alone; weights of a larger
# condition number than that have no Cholesky factor.
_RANK, _SINGULAR = 1e-12, 1e13


@dataclass(frozen=True)
class WeightsSearch:
    """Result of `search_weights`.

    Attributes
    ----------
    weights : Weights
        Scaled to R[0, 0] = 1.
    solution : LqrSolution
        The regulator that they make.
    misfit : float
        2-norm of the output residual.
    evaluations : int
        Simulations with derivatives.
    """

    weights: Weights
    solution: LqrSolution
    misfit: float
    evaluations: int


def search_weights(problem: Problem, start: Weights, *, max_evaluations: int = 60) -> WeightsSearch:
    """Fit the weights to the recordings, at given initial states and plant.

    Parameters
    ----------
    problem : Problem
    start : Weights
        Positive definite.
    max_evaluations : int
        Simulations with derivatives, at most.

    Raises
    ------
    WeightsError, SolverError
        When the start has no stabilising solution, or the recordings cannot be simulated with it.
    """
    known = replace(problem, unknown_start=False, family=None, logarithms=frozen(np.zeros(0)))
    here = _point(known, start)
    if not here.residual.usable:
        raise SolverError(
            "start", "the closed loop cannot be simulated with these weights", "start elsewhere"
        )
    exact = _EXACT * recorded_size(known)
    radius, evaluations = _FIRST_RADIUS, 1
    while evaluations < max_evaluations and here.misfit > exact and radius > _LEAST_RADIUS:
        L, step, promised = _step(here, radius)
        if promised <= _SETTLED * here.misfit**2:
            break
        there = _try(known, L, step)
        evaluations += 1
        decrease = -1.0 if there is None else here.misfit**2 - there.misfit**2
        if decrease > promised / 2:
            radius = min(2 * radius, _LARGEST_RADIUS)
        elif decrease < promised / 4:
            radius = min(radius, float(np.linalg.norm(step))) / 4
        if there is not None and decrease > 0:
            here = there
    return WeightsSearch(normalised(here.weights), here.solution, here.misfit, evaluations)


@dataclass(frozen=True)
class _Point:
    weights: Weights
    solution: LqrSolution
    residual: Residual
    misfit: float


def _point(problem: Problem, weights: Weights) -> _Point:
    solution = solve_lqr(problem.plant, weights)
    found = evaluate(problem, solution.K, solution.S)
    residual = Residual(found.residual, found.dK, found.dS, usable=not found.reason)
    return _Point(weights, solution, residual, float(np.linalg.norm(found.residual)))


def _step(here: _Point, radius: float) -> tuple[Array, Array, float]:
    """L, D (n + m, n + m) and the decrease of the squared misfit that the linear model promises."""
    n, m = here.solution.plant.n, here.solution.plant.m
    L: Array = np.asarray(np.linalg.cholesky(here.weights.block), dtype=np.float64)
    basis = block_basis(n, m)
    jacobian = weight_jacobian(here.solution, here.residual, L @ basis @ L.T)
    left, values, right = np.linalg.svd(jacobian, full_matrices=False)
    kept = values > _RANK * values[0]
    values, seen = values[kept], (left.T @ here.residual.values)[kept]
    along = -_shortest(values, seen, radius)
    promised = float(np.sum(seen**2) - np.sum((seen + values * along) ** 2))
    return L, np.tensordot(right[kept].T @ along, basis, 1), promised


def _shortest(values: Array, seen: Array, radius: float) -> Array:
    """s / (s^2 + d) seen with the least d >= 0 that keeps it within the radius (bisection)."""
    if np.linalg.norm(seen / values) <= radius:
        return np.asarray(seen / values)
    low, high = 0.0, float(np.linalg.norm(values * seen)) / radius
    for _ in range(50):
        middle = (low + high) / 2
        inside = np.linalg.norm(values * seen / (values**2 + middle)) <= radius
        low, high = (low, middle) if inside else (middle, high)
    return np.asarray(values * seen / (values**2 + high))


def _try(problem: Problem, L: Array, step: Array) -> _Point | None:
    moved = L @ np.asarray(scipy.linalg.expm(step)) @ L.T
    if np.linalg.cond(moved) > _SINGULAR:
        return None
    try:
        point = _point(problem, split_blocks(moved, problem.plant.n))
    except WeightsError:  # a trial step too far: the search steps back from it
        return None
    return point if point.residual.usable else None
