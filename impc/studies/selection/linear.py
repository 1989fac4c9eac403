"""Linear models x' = A(theta) x + B(theta) r, y = C(theta) x, with exact sensitivities.

The input is held between samples, so that

    x+ = Ad x + Bd r,      [Ad Bd; 0 I] = exp( [A B; 0 0] dt )

is exact for all poles. Derivatives of the exponential are Fréchet derivatives along those of A and
B, which CasADi computes; with X_i = dx / dtheta_i

    X_i+ = Ad X_i + (dAd/dtheta_i) x + (dBd/dtheta_i) r.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
import scipy

from impc.arrays import Array, IntArray
from impc.jit import njit

if TYPE_CHECKING:
    from collections.abc import Callable


def linear_functions(
    matrices: ca.Function, dt: float
) -> tuple[
    Callable[[Array, Array], Array], Callable[[Array, Array, IntArray], tuple[Array, Array]]
]:
    """Functions `simulate` and `jacobian` of a `ParametricModel` from rest; `dt` in s."""
    symbol = ca.SX.sym("theta", matrices.size1_in(0))
    jacobians = [ca.jacobian(ca.vec(part), symbol) for part in matrices(symbol)]
    derivative = ca.Function("derivative", [symbol], jacobians)

    def jacobian(theta: Array, given: Array, free: IntArray) -> tuple[Array, Array]:
        given = np.ascontiguousarray(given)
        A, B, C = (item.full() for item in matrices(theta))
        dA, dB, dC = (
            # CasADi stacks columns; the first axis becomes the parameter.
            item.full()[:, free].T.reshape(len(free), *part.T.shape).transpose(0, 2, 1)
            for item, part in zip(derivative(theta), (A, B, C), strict=True)
        )
        exponential, change = _exponentials(_joined(A, B) * dt, _joined(dA, dB) * dt)
        x, X = _with_derivatives(*_split(exponential, A), *_split(change, A), given)
        on_state, on_output = np.einsum("pn,skn->spk", C, X), np.einsum("kpn,sn->spk", dC, x)
        return np.asarray(x @ C.T), np.asarray(on_state + on_output)

    def simulate(theta: Array, given: Array) -> Array:
        given = np.ascontiguousarray(given)
        A, B, C = (item.full() for item in matrices(theta))
        held = scipy.linalg.expm(_joined(A, B) * dt)
        none = np.zeros((0, *held.shape))
        x, _ = _with_derivatives(*_split(held, A), *_split(none, A), given)
        return np.asarray(x @ C.T)

    return simulate, jacobian


def _joined(A: Array, B: Array) -> Array:
    """[A B; 0 0], with the leading axes of A and B."""
    wide = np.concatenate([A, B], axis=-1)
    return np.pad(wide, [(0, 0)] * (wide.ndim - 2) + [(0, B.shape[-1]), (0, 0)])


def _split(held: Array, A: Array) -> tuple[Array, Array]:
    """Blocks [A B] of held matrices (..., N, N), contiguous."""
    n = len(A)
    return np.ascontiguousarray(held[..., :n, :n]), np.ascontiguousarray(held[..., :n, n:])


def _exponentials(M: Array, along: Array) -> tuple[Array, Array]:
    """exp(M) and its Fréchet derivatives (k, N, N) along k directions.

    The corner of exp [[M, L], [0, M]] is the derivative along L (Higham 2008, chapter 3); L is
    scaled to the norm of M, so that it does not affect the number of squarings.
    """
    count, size = along.shape[:2]
    length = np.linalg.norm(along, axis=(1, 2), keepdims=True) / max(np.linalg.norm(M), 1e-300)
    length[length == 0] = 1.0
    blocks = np.tile(np.kron(np.eye(2), M), (count, 1, 1))
    blocks[:, :size, size:] = along / length
    found = np.asarray(scipy.linalg.expm(blocks))
    first = found[0, :size, :size] if count else np.asarray(scipy.linalg.expm(M))
    return first, found[:, :size, size:] * length


@njit(nogil=True)
def _with_derivatives(A: Any, B: Any, dA: Any, dB: Any, given: Any) -> Any:
    samples, n, d, count = len(given), A.shape[0], B.shape[1], len(dA)
    x = np.zeros((samples, n))
    X = np.zeros((samples, count, n))
    for k in range(samples - 1):
        for i in range(n):
            total = 0.0
            for j in range(n):
                total += A[i, j] * x[k, j]
            for j in range(d):
                total += B[i, j] * given[k, j]
            x[k + 1, i] = total
        for p in range(count):
            for i in range(n):
                total = 0.0
                for j in range(n):
                    total += A[i, j] * X[k, p, j] + dA[p, i, j] * x[k, j]
                for j in range(d):
                    total += dB[p, i, j] * given[k, j]
                X[k + 1, p, i] = total
    return x, X
