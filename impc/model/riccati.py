"""The linear quadratic regulator, (3.3) and (3.4), and its exact derivatives.

    discrete:    P = F'PF + Q + K'RK,        K = S^-1 B'PA,  S = R + B'PB,  F = A - BK
    continuous:  0 = F'P + PF + Q + K'RK,    K = R^-1 B'P,   S = R

At the optimum the Riccati equation is stationary in K, so its differential keeps K fixed:

    dP = F'dP F + dQ + K'dR K,      dK = S^-1 (B'dP F - dR K)        (discrete)

A row of dK/d(Q, R) follows from the adjoint of this pair: one Lyapunov equation per entry of K
instead of one per entry of Q. With another terminal weight each stage of the horizon has its own
gain, from the same equations backwards: P_k from P_{k+1}, and dP_k from dP_{k+1}.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import ArrayLike

from impc.arrays import Array, Frozen, frozen, symmetric_matrix
from impc.checking import checked
from impc.errors import WeightsError
from impc.model.plant import Plant
from impc.model.weights import Weights, require_semidefinite

# Smallest eigenvalue ratio of a metric; below it the inverse has no correct digit.
_SINGULAR = 1e-14


@dataclass(frozen=True)
class LqrSolution(Frozen):
    """A plant, its weights, and their regulator."""

    plant: Plant
    weights: Weights
    P: Array  # (n, n), Riccati solution, the terminal weight
    K: Array  # (m, n), gain of u = -Kx
    S: Array  # (m, m), metric R + B'PB of deviations from the gain
    F: Array  # (n, n), closed loop A - BK


@dataclass(frozen=True)
class FiniteHorizonLqr(Frozen):
    """Regulator of a finite horizon with a terminal weight: one gain per stage."""

    plant: Plant
    weights: Weights
    P: Array  # (N + 1, n, n), cost-to-go of each stage; the last is the terminal weight
    K: Array  # (N, m, n), gains
    S: Array  # (N, m, m), metrics R + B'P_{k+1}B


@dataclass(frozen=True)
class Gradients(Frozen):
    """Derivatives of the entries of a matrix (a, b) with respect to the weights."""

    Q: Array  # (a, b, n, n), symmetric in the last two: d entry = sum(Q[a, b] * dQ)
    R: Array  # (a, b, m, m), symmetric in the last two


@checked
def solve_lqr(plant: Plant, weights: Weights) -> LqrSolution:
    """Solve the Riccati equation of the plant and the weights.

    Parameters
    ----------
    plant : Plant
        Discrete or continuous, stabilisable.
    weights : Weights
        Q (n, n) and R (m, m).

    Returns
    -------
    LqrSolution
        Riccati solution `P`, gain `K`, metric `S` and closed loop `F`.

    Raises
    ------
    InputError
        If the sizes differ.
    WeightsError
        If no stabilising solution exists: Q does not penalise a mode on or beyond the stability
        limit.

    Examples
    --------
    >>> import impc
    >>> from plants import yalmip_example
    >>> found = impc.solve_lqr(impc.Plant(yalmip_example()), impc.Weights([[1, 0], [0, 1]], 1))
    >>> found.K.round(4)
    array([[ 1.4938, -0.8811]])
    """
    solver = (
        scipy.linalg.solve_discrete_are if plant.discrete else scipy.linalg.solve_continuous_are
    )
    try:
        P = np.asarray(solver(plant.A, plant.B, weights.Q, weights.R))
    except (np.linalg.LinAlgError, ValueError) as error:  # ValueError: failed reordering
        raise _no_solution(str(error).split(".")[0].lower()) from None
    P = (P + P.T) / 2
    if plant.discrete:
        S = weights.R + plant.B.T @ P @ plant.B
        K = scipy.linalg.solve(S, plant.B.T @ P @ plant.A, assume_a="pos")
    else:
        S = weights.R
        K = scipy.linalg.solve(S, plant.B.T @ P, assume_a="pos")
    F = plant.A - plant.B @ K
    if not is_stable(F, discrete=plant.discrete):
        raise _no_solution("the resulting closed loop is not stable")
    return LqrSolution(plant, weights, frozen(P), frozen(K), frozen(S), frozen(F))


def terminal_matrix(plant: Plant, given: ArrayLike) -> Array:
    """Terminal weight P (n, n) from user input: a matrix, or 0 for none."""
    none = np.ndim(given) == 0 and np.all(np.asarray(given) == 0)
    P = symmetric_matrix("terminal_weight", np.zeros(2 * (plant.n,)) if none else given, plant.n)
    require_semidefinite("terminal_weight", P)
    return P


def solve_finite_horizon(
    plant: Plant, weights: Weights, terminal: Array, horizon: int
) -> FiniteHorizonLqr:
    """Backward Riccati recursion from a `terminal` weight (n, n) at stage N."""
    A, B, P, K, S = plant.A, plant.B, [terminal], [], []
    for _ in range(horizon):
        S.append(weights.R + B.T @ P[-1] @ B)
        eigenvalues = np.linalg.eigvalsh(S[-1])
        if not eigenvalues[0] > _SINGULAR * eigenvalues[-1]:
            problem = "have a stage metric R + B'PB that is singular in double precision"
            raise WeightsError("Q, R", problem, "use more similar weights for the inputs")
        K.append(np.linalg.solve(S[-1], B.T @ P[-1] @ A))
        F = A - B @ K[-1]
        before = F.T @ P[-1] @ F + weights.Q + K[-1].T @ weights.R @ K[-1]
        P.append((before + before.T) / 2)
    return FiniteHorizonLqr(plant, weights, *(frozen(part[::-1]) for part in (P, K, S)))


def finite_horizon_changes(
    found: FiniteHorizonLqr, dQ: Array, dR: Array, dP: Array
) -> tuple[Array, Array]:
    """Derivatives of gains (N, k, m, n) and metrics (N, k, m, m) along k directions."""
    A, B, dK, dS = found.plant.A, found.plant.B, [], []
    for K, S in zip(found.K[::-1], found.S[::-1], strict=True):
        F = A - B @ K
        dS.append(dR + B.T @ dP @ B)
        dK.append(np.linalg.solve(S, B.T @ dP @ F - dR @ K))
        dP = F.T @ dP @ F + dQ + K.T @ dR @ K
    return np.array(dK[::-1]), np.array(dS[::-1])


def is_stable(F: Array, *, discrete: bool) -> bool:
    """Whether all eigenvalues of F (n, n) decay: |z| < 1 when `discrete`, else Re s < 0."""
    if not np.all(np.isfinite(F)):  # a step of a search that went to infinity
        return False
    eigenvalues = np.linalg.eigvals(F)
    if discrete:
        return bool(np.max(np.abs(eigenvalues)) < 1)
    return bool(np.max(eigenvalues.real) < 0)


def stabilises(plant: Plant, gain: Array) -> bool:
    """Whether u = -Kx with the `gain` K (m, n) gives a stable loop (docs/why/theory.md, 2)."""
    return is_stable(plant.A - plant.B @ gain, discrete=plant.discrete)


def lyapunov_series(F: Array, right: Array) -> Array:
    """Solve X = F X F' + right for a stack of right sides by Smith's doubling (Smith 1968).

    X = sum F^k right F'^k; each doubling squares F, so that the number of products grows with the
    logarithm of the time constant. The relative truncation error is below the unit round-off.
    `F` (n, n); `right` (p, n, n); returns (p, n, n).
    """
    if not is_stable(F, discrete=True):
        raise _no_solution("the closed loop is not stable")
    power, total = np.array(F), np.array(right)
    for _ in range(60):  # 2^60 samples: more than any loop that is stable in double precision needs
        update = power @ total @ power.T
        total += update
        if np.max(np.abs(update), initial=0.0) <= 1e-17 * np.max(np.abs(total), initial=0.0):
            return total
        power = power @ power
    raise _no_solution("the closed loop is not stable to working precision")


def gain_gradients(solution: LqrSolution) -> Gradients:
    """Exact derivatives of the gain K with respect to Q (m, n, n, n) and R (m, n, m, m)."""
    B, K, F, S = solution.plant.B, solution.K, solution.F, solution.S
    m, n = K.shape
    # <G, dK> = <B S^-1 G F', dP> - <S^-1 G K', dR> for the unit matrix G of each entry.
    units = np.eye(m * n).reshape(m * n, m, n)
    inner = scipy.linalg.solve(S, units.transpose(1, 0, 2).reshape(m, -1), assume_a="pos")
    inner = inner.reshape(m, m * n, n).transpose(1, 0, 2)
    source = B @ inner @ F.T if solution.plant.discrete else B @ inner
    gradients = _adjoint(solution, source, -inner @ K.T)
    return Gradients(gradients.Q.reshape(m, n, n, n), gradients.R.reshape(m, n, m, m))


def metric_gradients(solution: LqrSolution) -> Gradients:
    """Exact derivatives of the metric S = R + B'PB of a discrete plant: shapes (m, m, ...)."""
    B, m, n = solution.plant.B, solution.plant.m, solution.plant.n
    units = np.eye(m * m).reshape(m * m, m, m)
    gradients = _adjoint(solution, B @ units @ B.T, units)
    return Gradients(gradients.Q.reshape(m, m, n, n), gradients.R.reshape(m, m, m, m))


def regulator_changes(
    solution: LqrSolution, dQ: Array, dR: Array, dA: Array, dB: Array
) -> tuple[Array, Array]:
    """Derivatives of gain and metric of a discrete plant along k directions.

    With dF = dA - dB K and the gain fixed:  dP = F'dP F + dF'PF + F'P dF + dQ + K'dR K,
    S dK = dB'PF + B'dP F + B'P dF - dR K,  dS = dR + dB'PB + B'dP B + B'P dB.
    `dQ` (k, n, n); `dR` (k, m, m); `dA` (k, n, n); `dB` (k, n, m).
    """
    B, P, K, F = solution.plant.B, solution.P, solution.K, solution.F
    dF = dA - dB @ K
    turned = F.T @ P @ dF
    dP = lyapunov_series(F.T, turned + turned.transpose(0, 2, 1) + dQ + K.T @ dR @ K)
    beside = dB.transpose(0, 2, 1) @ P
    product = beside @ F + B.T @ dP @ F + B.T @ P @ dF - dR @ K
    dS = dR + beside @ B + B.T @ dP @ B + (beside @ B).transpose(0, 2, 1)
    return np.asarray(np.linalg.solve(solution.S, product)), np.asarray(dS)


def _adjoint(solution: LqrSolution, source: Array, direct: Array) -> Gradients:
    """Gradient of <source, dP> + <direct, dR>: the adjoint Lyapunov equation, symmetrised."""
    F, K = solution.F, solution.K
    source = (source + source.transpose(0, 2, 1)) / 2
    if solution.plant.discrete:
        dual = lyapunov_series(F, source)
    else:
        dual = np.array([scipy.linalg.solve_continuous_lyapunov(F, -item) for item in source])
    on_r = K @ dual @ K.T + direct
    return Gradients(dual, (on_r + on_r.transpose(0, 2, 1)) / 2)


def _no_solution(reason: str) -> WeightsError:
    return WeightsError(
        "Q, R",
        f"have no stabilising Riccati solution ({reason})",
        "penalise every mode that does not decay by itself",
    )
