"""The controller's program stage by stage, where nothing but the inputs is bounded.

The rows in v = u + Kx lose their digits when no plan comes near the gain: v then grows as the plant
runs away, and u = v - Kx cancels. Here the inputs themselves are the unknowns, those at a bound are
*exactly* there, and the others follow from a Riccati recursion over the stages:

    V_k(x) = min over the free inputs of  v_k'S v_k / 2 + V_{k+1}(A x + B u),    V_N = 0,

with V_k(x) = x'P_k x / 2 + q_k'x + const. With u = c - Lx, L zero for an input at its bound,
D = K - L and F = A - BL,

    P_k = D'S D + F'P_{k+1} F,      q_k = D'S c + F'(P_{k+1} B c + q_{k+1}):

sums without a difference in them, so that what the plant does not amplify is not amplified by
rounding either. Which inputs stand at a bound is found by a primal active-set method (Nocedal and
Wright, Numerical Optimization, section 16.5): every plan on the way keeps the bounds.
What is checked: docs/theory.md, section 4.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from impc.arrays import Array, Buffer
from impc.jit import njit

if TYPE_CHECKING:
    from impc.control.compiled_arrays import LoopMatrices

__all__ = ["Plan", "differentiate_plan", "solve_saturated"]

# Rounding of a gradient, relative to the sum of the magnitudes of its terms.
_ROUNDING = 1e-14
# What the first input may be uncertain by, relative to its bound.
_TOLERANCE = 1e-8


class Plan(NamedTuple):
    """Inputs over the horizon with what their derivative needs."""

    u: Array  # Inputs (N, m) and states (N + 1, n)
    x: Array
    at: Array  # -1 and 1 for an input at its lower and upper bound, 0 for a free one, (N, m)
    L: Array  # Of the recursion: (N, m, n), (N + 1, n, n), (N + 1, n)
    P: Array
    q: Array
    H: Array  # Second derivative by the inputs of each stage, S + B'P_{k+1} B, (N, m, m)
    told: bool  # Whether the first input is told from rounding; the rest is of no use otherwise


def solve_saturated(
    loop: LoopMatrices,
    S: Array,
    low: Array,
    high: Array,
    N: int,
    x: Array,
    last: Plan | None = None,
) -> Plan:
    """Return the best plan from a state under bounds on the inputs alone.

    `S` (m, m); `low, high` (m,); `x` (n,).
    """
    u, at = np.zeros((N, len(S))), np.zeros((N, len(S)), dtype=np.int8)
    if last is None:
        _saturate(loop.A, loop.B, loop.K, low, high, x, u, at)
    else:
        u[:-1], at[:-1] = last.u[1:], last.at[1:]
    gains = loop.A, loop.B, loop.K, S
    u, ahead, held, L, P, q, H, gradient, noise, solved = _solve(*gains, low, high, x, u, at)
    told = False
    if solved:
        # Beside `_solve` and not in it: inside, all of it would be compiled a second time.
        doubt = _doubt(*gains, x, u, held, H, gradient, noise)
        told = _told(*doubt, _open_curvature(*gains, N), low, high, u, held, H, gradient, noise)
    return Plan(u, ahead, held, L, P, q, H, told)


@njit(cache=True, nogil=True)
def _solve(
    A: Buffer, B: Buffer, K: Buffer, S: Buffer, low: Buffer, high: Buffer, x0: Buffer, u: Buffer,
    at: Buffer,
) -> tuple[
    Buffer, Buffer, Buffer, Buffer, Buffer, Buffer, Buffer, Buffer, Buffer, bool
]:  # fmt: skip
    """The plan without `told`; the gradient and its rounding; whether a plan was found."""
    N, m, n = len(u), K.shape[0], K.shape[1]
    x = np.zeros((N + 1, n))
    L, P, q = np.zeros((N, m, n)), np.zeros((N + 1, n, n)), np.zeros((N + 1, n))
    H, gradient, noise = np.zeros((N, m, m)), np.zeros((N, m)), np.zeros((N, m))
    wanted = np.zeros((N, m))
    for _ in range(20 * N * m + 100):
        if not _backward(A, B, K, S, u, at, L, P, q, H, wanted):
            break
        _forward(A, B, K, S, x0, at, L, P, q, H, u, wanted, x, gradient, noise)
        step, k, j = _blocked(u, wanted, low, high)
        if step < 1.0:
            u += step * (wanted - u)
            at[k, j] = 1 if wanted[k, j] > u[k, j] else -1
            u[k, j] = high[j] if at[k, j] > 0 else low[j]
            continue
        u[:] = wanted
        k, j = _released(at, gradient, noise)
        if k < 0:
            return u, x, at, L, P, q, H, gradient, noise, True
        at[k, j] = 0
    return u, x, at, L, P, q, H, gradient, noise, False


@njit(cache=True)
def _saturate(
    A: Buffer, B: Buffer, K: Buffer, low: Buffer, high: Buffer, x0: Buffer, u: Buffer, at: Buffer
) -> None:
    """Begin with the gain, cut at the bounds."""
    x = x0.copy()
    for k in range(len(u)):
        u[k] = -(K @ x)
        for j in range(u.shape[1]):
            if u[k, j] > high[j]:
                u[k, j], at[k, j] = high[j], 1
            elif u[k, j] < low[j]:
                u[k, j], at[k, j] = low[j], -1
        x = A @ x + B @ u[k]


@njit(cache=True)
def _backward(
    A: Buffer, B: Buffer, K: Buffer, S: Buffer, u: Buffer, at: Buffer,
    L: Buffer, P: Buffer, q: Buffer, H: Buffer, c: Buffer,
) -> bool:  # fmt: skip
    """Write the recursion for the inputs at their bounds; c is the constant part of the inputs.

    False when numbers overflow, or free inputs of a stage cannot be told from each other.
    """
    N, m = u.shape
    for k in range(N - 1, -1, -1):
        PB = P[k + 1] @ B
        H[k] = S + B.T @ PB
        G = S @ K + PB.T @ A
        constant = B.T @ q[k + 1]
        free = np.flatnonzero(at[k] == 0)
        L[k] = 0.0
        for j in range(m):
            c[k, j] = u[k, j] if at[k, j] != 0 else 0.0
        if len(free):
            right = np.empty((m, K.shape[1] + 1))
            right[:, :-1] = G
            right[:, -1] = H[k] @ c[k] + constant
            if not _solve_part(H[k], free, right):
                return False
            for a in free:
                L[k, a] = right[a, :-1]
                c[k, a] = -right[a, -1]
        D, F = K - L[k], A - B @ L[k]
        SD = S @ D
        q[k] = SD.T @ c[k] + F.T @ (PB @ c[k] + q[k + 1])
        full = D.T @ SD + F.T @ (P[k + 1] @ F)
        P[k] = (full + full.T) / 2
    return bool(np.all(np.isfinite(P[0])))


@njit(cache=True)
def _solve_part(H: Buffer, free: Buffer, right: Buffer) -> bool:
    """Solve with the free rows and columns of H in place; False when they hide each other."""
    left = H.copy()
    for a in free:
        pivot = left[a, a]
        if not pivot > _ROUNDING * H[a, a]:  # or not a number
            return False
        left[a] /= pivot
        right[a] /= pivot
        for b in free:
            if b != a:
                share = left[b, a]
                left[b] -= share * left[a]
                right[b] -= share * right[a]
    return True


@njit(cache=True)
def _forward(
    A: Buffer, B: Buffer, K: Buffer, S: Buffer, x0: Buffer, at: Buffer, L: Buffer, P: Buffer,
    q: Buffer, H: Buffer, u: Buffer, c: Buffer, x: Buffer, gradient: Buffer, noise: Buffer,
) -> None:  # fmt: skip
    """Turn c into the inputs, and write the change of each input that its gradient asks for.

    `noise` is what rounding makes of that change.
    """
    N, m = u.shape
    x[0] = x0
    for k in range(N):
        for j in range(m):
            if at[k, j] == 0:
                c[k, j] -= np.dot(L[k, j], x[k])
        x[k + 1] = A @ x[k] + B @ c[k]
        v = c[k] + K @ x[k]
        costate = P[k + 1] @ x[k + 1] + q[k + 1]
        pull = S @ v + B.T @ costate
        large = np.abs(S) @ (np.abs(c[k]) + np.abs(K) @ np.abs(x[k])) + np.abs(B).T @ (
            np.abs(P[k + 1]) @ np.abs(x[k + 1]) + np.abs(q[k + 1])
        )
        for j in range(m):
            gradient[k, j] = -pull[j] / H[k, j, j]
            noise[k, j] = _ROUNDING * large[j] / H[k, j, j]


@njit(cache=True)
def _blocked(u: Buffer, wanted: Buffer, low: Buffer, high: Buffer) -> tuple[float, int, int]:
    """Share of the step to the wanted plan that keeps the bounds, and the input that blocks it."""
    best, row, column = 1.0, -1, -1
    for k in range(u.shape[0]):
        for j in range(u.shape[1]):
            for side in (low[j], high[j]):
                beyond = wanted[k, j] - side if side > 0 else side - wanted[k, j]
                if beyond <= 0.0:
                    continue
                step = (side - u[k, j]) / (wanted[k, j] - u[k, j])
                if step < best:
                    best, row, column = max(step, 0.0), k, j
    return best, row, column


@njit(cache=True)
def _released(at: Buffer, gradient: Buffer, noise: Buffer) -> tuple[int, int]:
    """The input at a bound that gains most by leaving it, or -1."""
    best, row, column = 0.0, -1, -1
    for k in range(at.shape[0]):
        for j in range(at.shape[1]):
            gain = -at[k, j] * gradient[k, j]
            if at[k, j] != 0 and gain > noise[k, j] and gain > best:
                best, row, column = gain, k, j
    return row, column


@njit(cache=True)
def _told(
    energy: float, curvature: Buffer, alone: Buffer, low: Buffer, high: Buffer, u: Buffer,
    at: Buffer, H: Buffer, gradient: Buffer, noise: Buffer,
) -> bool:  # fmt: skip
    """Whether rounding leaves every first input where it is, by `_doubt` and `_open_curvature`."""
    for j in range(u.shape[1]):
        pull, rounding = at[0, j] * gradient[0, j] * H[0, j, j], noise[0, j] * H[0, j, j]
        held = pull > rounding + np.sqrt(alone[j, j] * energy)
        unit = min(-low[j], high[j])
        unit = unit if np.isfinite(unit) else abs(u[0, j])
        if not (held or np.sqrt(energy * curvature[j]) <= _TOLERANCE * unit):
            return False
    return True


@njit(cache=True, nogil=True)
def _doubt(
    A: Buffer, B: Buffer, K: Buffer, S: Buffer, x0: Buffer, u: Buffer, at: Buffer, H: Buffer,
    gradient: Buffer, noise: Buffer,
) -> tuple[float, Buffer]:  # fmt: skip
    """Twice the cost by which the best plan may be better, and 1 / curvature of each first input.

    Inputs whose multiplier rounding hides are freed without a bound: no choice of those that stay
    at their bounds can be better than that (docs/theory.md, section 4).
    """
    N, m, n = len(u), K.shape[0], K.shape[1]
    loose = at.copy()
    for k in range(N):
        for j in range(m):
            if at[k, j] != 0 and not at[k, j] * gradient[k, j] > noise[k, j]:
                loose[k, j] = 0
    x, L = np.zeros((N + 1, n)), np.zeros((N, m, n))
    P, q, free_H = np.zeros((N + 1, n, n)), np.zeros((N + 1, n)), np.zeros((N, m, m))
    best, left, unknown = np.zeros((N, m)), np.zeros((N, m)), np.zeros((N, m))
    if not _backward(A, B, K, S, u, loose, L, P, q, free_H, best):
        return np.inf, np.ones(m)
    _forward(A, B, K, S, x0, loose, L, P, q, free_H, u, best, x, left, unknown)
    energy = 0.0
    for k in range(N):
        for j in range(m):
            if at[k, j] == 0:
                energy += H[k, j, j] * noise[k, j] ** 2
            elif loose[k, j] == 0:
                pull = (abs(gradient[k, j]) + noise[k, j]) * H[k, j, j]
                energy += pull * abs(best[k, j] - u[k, j])
    inverse = np.eye(m)
    if not _solve_part(free_H[0], np.arange(m), inverse):
        return np.inf, np.ones(m)
    return energy, np.diag(inverse)


@njit(cache=True)
def _open_curvature(A: Buffer, B: Buffer, K: Buffer, S: Buffer, N: int) -> Buffer:
    """Second derivative of the cost by the first input alone, (m, m)."""
    step = K.T @ S @ K
    P = np.zeros(A.shape)
    for _ in range(N - 1):
        P = step + A.T @ P @ A
    return S + B.T @ P @ B


def differentiate_plan(
    plan: Plan, loop: LoopMatrices, dloop: LoopMatrices, S: Array, dbound: Array, dx: Array
) -> Array:
    """Return the derivative of the first input along p directions, the bounds that hold kept.

    The stationarity of the free inputs and the recursion of the states are differentiated; what
    that gives is the same program with other constants, and has the same L and P (docs/theory.md,
    section 4).

    `S` (m, m); `dbound` (N, m, p); `dx` (n, p); returns (m, p).
    """
    A, B, K = loop.A, loop.B, loop.K
    s = np.zeros(dx.shape)
    for k in range(len(plan.u) - 1, -1, -1):
        x, u, L, P = plan.x[k], plan.u[k], plan.L[k], plan.P[k + 1]
        v, costate = u + K @ x, P @ plan.x[k + 1] + plan.q[k + 1]
        moved = _times(dloop.A, x) + _times(dloop.B, u)
        pull = S @ _times(dloop.K, x) + _times(dloop.S, v)
        turned = _times(np.swapaxes(dloop.B, 0, 1), costate)
        e = np.where(plan.at[k, :, None] != 0, dbound[k], 0.0)
        free = plan.at[k] == 0
        wrong = pull + turned + B.T @ (P @ moved + s) + plan.H[k] @ e
        e[free] = -np.linalg.solve(plan.H[k][np.ix_(free, free)], wrong[free])
        s = (
            (K - L).T @ (S @ e + pull)
            + (A - B @ L).T @ (P @ (B @ e + moved) + s)
            + _times(np.swapaxes(dloop.K, 0, 1), S @ v)
            + _times(np.swapaxes(dloop.A, 0, 1), costate)
            - L.T @ turned
        )
    first: Array = e - plan.L[0] @ dx
    return first


def _times(direction: Array, vector: Array) -> Array:
    """Each of p matrices, the last axis, times a vector."""
    return np.tensordot(direction, vector, ((1,), (0,)))
