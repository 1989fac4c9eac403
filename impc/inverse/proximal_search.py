"""Weights that trade fit for conditioning: problems (3.5), (3.7), (3.16) and (3.6).

    minimise over (Q, R)   w_fit phi(r(K, S)) + w_cond kappa(blkdiag(Q, R)),

where K and S are the gain and metric of (Q, R), r is a residual and phi is the 2-norm or its
square. The four problems differ in r only.

kappa is nonsmooth where an extreme eigenvalue is repeated, and the 2-norm at a perfect fit; both
often coincide with the solution. Each step therefore keeps these terms and linearises the rest.
With X = blkdiag(Q, R) scaled to a least eigenvalue of 1, kappa = lambda_max(X) is convex, and the
step solves the semidefinite program

    minimise  w_fit phi(r + J dX) + w_cond alpha
    subject to  I <= X + dX <= alpha I,   ||L^-1 dX L^-T||_F <= radius,   X = L L',

a prox-linear (Gauss-Newton) step in the coordinates of the current Cholesky factor, so that the
trust region does not depend on the units of the states (docs/why/theory.md).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.linalg

from impc.arrays import Array, Frozen, frozen
from impc.checking import checked
from impc.errors import SolverError, WeightsError
from impc.inverse.proximal_step import StepProgram, block_basis, solve_step
from impc.model.plant import Plant
from impc.model.riccati import LqrSolution, gain_gradients, metric_gradients, solve_lqr
from impc.model.weights import Weights, condition_number, normalised

_STATIONARY = 1e-5
# In units of the current weights: a step of 1 can double a direction or make it singular.
_LARGEST_RADIUS = 2.0
# Smaller radii are below rounding.
_LEAST_RADIUS = 1e-10


@dataclass(frozen=True)
class Residual(Frozen):
    """Residual with its derivative."""

    values: Array  # (r,)
    # Derivative (r, k) along changes of K (k, m, n) and of S (k, m, m)
    along: Callable[[Array, Array], Array]
    usable: bool = True  # Whether it could be computed; if not, the step is shortened


@dataclass(frozen=True)
class Objective:
    """Objective of `conditioned_fit`."""

    residual: Callable[[LqrSolution], Residual]  # residual of a regulator
    fit_weight: float  # w_fit, then w_cond including the constant c of (3.5)
    condition_weight: float
    # Whether phi is the squared norm. The norm is an exact penalty: for small w_cond it does not
    # trade fit for conditioning; the square always does.
    squared: bool


@dataclass(frozen=True)
class ConditionedFit:
    """Result of `conditioned_fit`."""

    weights: Weights  # Scaled to R[0, 0] = 1
    solution: LqrSolution  # Riccati solution of the weights
    misfit: float  # 2-norm of the residual
    condition: float  # kappa(blkdiag(Q, R))
    objective: float  # Objective at these weights
    iterations: int  # Number of steps, then of residuals
    evaluations: int
    # Predicted decrease of the last step, relative to the objective and the step size
    stationarity: float
    converged: bool  # Whether `stationarity` is at most 1e-5


def conditioned_fit(
    plant: Plant,
    objective: Objective,
    start: Weights,
    *,
    max_iterations: int = 200,
    tolerance: float = 1e-11,
) -> ConditionedFit:
    """Minimise the objective, starting at the given weights."""
    here = _first(plant, objective, start)
    radius, evaluations, iteration, stationarity = 0.5, 1, 0, np.inf
    while iteration < max_iterations:
        iteration += 1
        program = _linearise(here, objective)
        step, predicted, radius = _step(program, radius)
        decrease = here.objective - predicted
        stationarity = max(decrease, 0.0) / max(here.objective * min(radius, 1.0), 1e-300)
        if decrease <= tolerance * here.objective:
            break
        there = _try(plant, objective, here, step)
        evaluations += 1
        ratio = -1.0
        if there is not None and there.residual.usable:
            ratio = (here.objective - there.objective) / decrease
        if ratio > 1e-4 and there is not None:
            here = there
        radius = _next_radius(radius, ratio, step)
        if radius < _LEAST_RADIUS:
            break
    return ConditionedFit(
        normalised(here.weights),
        here.solution,
        float(np.linalg.norm(here.residual.values)),
        condition_number(here.weights),
        here.objective,
        iteration,
        evaluations,
        stationarity,
        stationarity <= _STATIONARY,
    )


def _step(program: StepProgram, radius: float) -> tuple[Array, float, float]:
    """`solve_step`, with a smaller radius if the program fails; and that radius."""
    while True:
        try:
            return *solve_step(program, radius), radius
        except SolverError:
            radius /= 4
            if radius < _LEAST_RADIUS:
                raise


def weight_jacobian(solution: LqrSolution, residual: Residual, basis: Array) -> Array:
    """Derivative of the residual along directions of blkdiag(Q, R), shape (r, k)."""
    n = solution.plant.n
    dQ, dR = basis[:, :n, :n], basis[:, n:, n:]
    both = [gain_gradients(solution)]
    if solution.plant.discrete:
        both.append(metric_gradients(solution))
    changes = [
        np.tensordot(dQ, found.Q, ((1, 2), (2, 3))) + np.tensordot(dR, found.R, ((1, 2), (2, 3)))
        for found in both
    ]
    # In continuous time the metric is R.
    return residual.along(changes[0], changes[1] if len(changes) > 1 else dR)


@dataclass(frozen=True)
class _Point:
    weights: Weights  # scaled to a least eigenvalue of 1
    solution: LqrSolution
    residual: Residual
    objective: float


def _point(plant: Plant, objective: Objective, weights: Weights) -> _Point:
    least = float(np.linalg.eigvalsh(weights.block)[0])
    scaled = Weights(weights.Q / least, weights.R / least)
    solution = solve_lqr(plant, scaled)
    residual = objective.residual(solution)
    size = float(np.linalg.norm(residual.values))
    fit = size**2 if objective.squared else size
    value = objective.fit_weight * fit + objective.condition_weight * condition_number(scaled)
    return _Point(scaled, solution, residual, value)


def _first(plant: Plant, objective: Objective, start: Weights) -> _Point:
    here = _point(plant, objective, start)
    if not here.residual.usable:
        raise SolverError(
            "start",
            "the closed loop cannot be simulated with these weights",
            "pass other starting weights",
        )
    return here


def _next_radius(radius: float, ratio: float, step: Array) -> float:
    """New trust-region radius for a ratio of actual to predicted decrease."""
    if ratio > 0.75:
        return min(2 * radius, _LARGEST_RADIUS)
    if ratio < 0.25:
        return 0.25 * min(radius, float(np.linalg.norm(step)))
    return radius


def _linearise(here: _Point, objective: Objective) -> StepProgram:
    """Program of the step in coordinates D of dX = L D L'."""
    n = here.solution.plant.n
    X = here.weights.block
    L: Array = np.asarray(np.linalg.cholesky(X), dtype=np.float64)
    basis = block_basis(n, len(X) - n)
    J = weight_jacobian(here.solution, here.residual, L @ basis @ L.T)
    # A tall residual enters as its triangular factor: same norm, few rows.
    factor, triangle = np.linalg.qr(J) if len(J) > J.shape[1] else (np.eye(len(J)), J)
    shown = factor.T @ here.residual.values
    hidden = float(np.linalg.norm(here.residual.values - factor @ shown))
    return StepProgram(
        X=X,
        L=L,
        n=n,
        basis=basis,
        jacobian=triangle,
        residual=shown,
        rest=hidden,
        fit_weight=objective.fit_weight,
        condition_weight=objective.condition_weight,
        squared=objective.squared,
    )


def _try(plant: Plant, objective: Objective, here: _Point, step: Array) -> _Point | None:
    """Point after a step; None if it has no Riccati solution."""
    n = plant.n
    X = here.weights.block
    L = np.linalg.cholesky(X)
    moved = X + L @ np.tensordot(step, block_basis(n, len(X) - n), 1) @ L.T
    moved = (moved + moved.T) / 2
    if scipy.linalg.eigvalsh(moved)[0] <= 0:
        return None
    try:
        return _point(plant, objective, Weights(frozen(moved[:n, :n]), frozen(moved[n:, n:])))
    except WeightsError:
        return None


#: Weight of the condition number in (3.7); a distance as large as the gain has weight 1.
AUXILIARY_CONDITION_WEIGHT = 1e-3
# Largest condition number of starting weights, which need a Cholesky factor.
_LARGEST_START_CONDITION = 1e6
# Limits of `weights_near`: steps, and relative decrease of the objective.
_STEPS, _NEAR = 60, 1e-4


@checked(gain="m n", condition_weight=0, tolerance=0)
def auxiliary_weights(
    plant: Plant,
    gain: Array,
    start: Weights | None,
    *,
    condition_weight: float = AUXILIARY_CONDITION_WEIGHT,
    tolerance: float = 1e-11,
) -> ConditionedFit:
    """Auxiliary problem (3.7): well-conditioned weights with a gain near `gain` (m, n).

    minimise  ||K(Q, R) - gain||_2 + condition_weight kappa(blkdiag(Q, R))
    """

    def distance(solution: LqrSolution) -> Residual:
        beyond = (solution.K - gain).ravel()
        return Residual(beyond, lambda dK, _: dK.reshape(-1, gain.size).T)

    begin = Weights(np.eye(plant.n), np.eye(plant.m)) if start is None else start
    objective = Objective(distance, 1.0, condition_weight, squared=False)
    return conditioned_fit(plant, objective, definite(begin), tolerance=tolerance)


def weights_near(
    plant: Plant, form: Array, gain: Array, start: Weights, condition_share: float
) -> ConditionedFit:
    """Weights with the nearest gain in a quadratic form, e.g. that of recordings near a fit.

        minimise  1 + |form vec(K(Q, R) - gain)|^2 + condition_share kappa(blkdiag(Q, R))

    `form` (r, mn); `gain` (m, n).
    """
    rows = np.vstack([form, np.zeros(gain.size)])

    def distance(solution: LqrSolution) -> Residual:
        beyond = np.append(form @ (solution.K - gain).ravel(), 1.0)
        return Residual(beyond, lambda dK, _: rows @ dK.reshape(-1, gain.size).T)

    objective = Objective(distance, 1.0, condition_share, squared=True)
    return conditioned_fit(plant, objective, start, max_iterations=_STEPS, tolerance=_NEAR)


def definite(weights: Weights) -> Weights:
    """Raise the least eigenvalues of Q and R to a condition number of at most 1e6."""
    if condition_number(weights) <= _LARGEST_START_CONDITION:
        return normalised(weights)
    floor = float(np.linalg.eigvalsh(weights.block)[-1]) / _LARGEST_START_CONDITION
    lifted = []
    for matrix in (weights.Q, weights.R):
        values, vectors = np.linalg.eigh(matrix)
        lifted.append((vectors * np.maximum(values, floor)) @ vectors.T)
    return normalised(Weights(*lifted))
