"""Solve the upper level by prox-linear semidefinite steps and by a smooth surrogate.

The surrogate suits a general optimiser: L-BFGS on the Cholesky entries, the condition number
replaced by a ratio of p-norms of the eigenvalues (p = 8, 32, 128 in turn), and the 2-norm by
sqrt(||r||^2 + e^2) with e = 1e-2, 1e-4, 1e-6.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
import scipy.optimize

from experiments.certificates import cholesky_parameters, weights_from_parameters
from impc.arrays import Array
from impc.inverse.problem import Problem
from impc.inverse.proximal_search import weight_jacobian
from impc.inverse.residuals import misfit_or_reason
from impc.inverse.table31 import CONDITION_WEIGHT, closed_loop_residual, inverse_mpc
from impc.model.riccati import solve_lqr
from impc.model.weights import Weights, condition_number

__all__ = ["Route", "prox_linear", "smooth_surrogate"]


@dataclass(frozen=True)
class Route:
    """End of a search: weights, true objective, number of simulations, seconds."""

    weights: Weights
    objective: float
    simulations: int
    seconds: float


def prox_linear(problem: Problem, start: Weights) -> Route:
    """Prox-linear steps of the package, with the condition weight of the surrogate."""
    begin = time.perf_counter()
    fit = inverse_mpc(problem, start, condition_weight=CONDITION_WEIGHT)
    weights = fit.stage_weights
    objective = fit.misfit + CONDITION_WEIGHT * condition_number(weights)
    return Route(weights, objective, fit.evaluations, time.perf_counter() - begin)


def smooth_surrogate(problem: Problem, start: Weights) -> Route:
    """L-BFGS with continuation on the surrogate of the module docstring."""
    begin = time.perf_counter()
    plant = problem.plant
    parameters, simulations = cholesky_parameters(start), 0
    for power, softness in ((8, 1e-2), (32, 1e-4), (128, 1e-6)):
        found = scipy.optimize.minimize(
            _surrogate,
            parameters,
            args=(problem, power, softness),
            jac=True,
            method="L-BFGS-B",
            options={"maxiter": 300, "ftol": 1e-15, "gtol": 1e-10},
        )
        parameters, simulations = found.x, simulations + int(found.nfev)
    weights = weights_from_parameters(parameters, plant.n, plant.m)
    solution = solve_lqr(plant, weights)
    misfit, _ = misfit_or_reason(problem, solution.K, solution.S)
    objective = misfit + CONDITION_WEIGHT * condition_number(weights)
    return Route(weights, objective, simulations, time.perf_counter() - begin)


def _surrogate(
    parameters: Array, problem: Problem, power: int, softness: float
) -> tuple[float, Array]:
    plant = problem.plant
    n, m = plant.n, plant.m
    weights = weights_from_parameters(parameters, n, m)
    solution = solve_lqr(plant, weights)
    found, _ = closed_loop_residual(problem, solution)
    basis = _directions(parameters, n, m)
    jacobian = weight_jacobian(solution, found, basis)
    size = float(np.sqrt(found.values @ found.values + softness**2))
    values, vectors = np.linalg.eigh(weights.block)
    scaled = values / values[-1]
    largest = float(np.sum(scaled**power) ** (1 / power)) * values[-1]
    inverse = values[0] / values
    smallest = values[0] / float(np.sum(inverse**power) ** (1 / power))
    kappa = largest / smallest
    on_largest = largest * scaled**power / np.sum(scaled**power) / values
    on_smallest = smallest * inverse**power / np.sum(inverse**power) / values
    on_values = kappa * (on_largest / largest - on_smallest / smallest)
    on_block = (vectors * on_values) @ vectors.T
    gradient = jacobian.T @ found.values / size
    gradient += CONDITION_WEIGHT * np.tensordot(basis, on_block, 2)
    return size + CONDITION_WEIGHT * kappa, gradient


def _directions(parameters: Array, n: int, m: int) -> Array:
    """d blkdiag(LL', GG') / d parameters: (k, n + m, n + m)."""
    count = n * (n + 1) // 2
    factor = np.zeros((n + m, n + m))
    rows, columns = np.tril_indices(n)
    factor[rows, columns] = parameters[:count]
    low, left = np.tril_indices(m)
    factor[n + low, n + left] = np.concatenate([[1.0], parameters[count:]])
    places = [*zip(rows, columns, strict=True), *list(zip(n + low, n + left, strict=True))[1:]]
    directions = []
    for row, column in places:
        unit = np.zeros_like(factor)
        unit[row] = factor[:, column]
        directions.append(unit + unit.T)
    return np.array(directions)
