"""Compiled code: the closed loop over samples, with derivatives along any directions.

The loop is that of `closed_loop`, which has its mathematics (docs/theory.md). Where the body that
moves is not linear, its machine code is called (`compiled_body`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Buffer
from impc.borrowed import borrowed
from impc.control.compiled_arrays import DIVERGED, SOFTENED, LoopMatrices, Workspace
from impc.control.compiled_body import BodyTape, move_body
from impc.control.compiled_law import law
from impc.control.compiled_products import dot
from impc.jit import njit

if TYPE_CHECKING:
    from impc.control.constraint_rows import RowDirections, Rows

__all__ = ["COMPILED_WITH", "run"]

#: First digits of the SHA-256 of each file whose functions are called: numba's cache does not look.
COMPILED_WITH = {
    "borrowed": "f9ef79e3bd6dacdb",
    "compiled_arrays": "f9299fe715d0d2a3",
    "compiled_body": "009aae66ce7c6133",
    "compiled_law": "fb4d0617cbd31619",
    "compiled_products": "50101205237e0db3",
}


@njit(cache=True, nogil=True)  # trials left out are fitted side by side
def run(
    loop: LoopMatrices,
    dloop: LoopMatrices,
    rows: Rows,
    drows: RowDirections,
    body: BodyTape,
    pushes: Buffer,
    disturbance: Buffer,
    divergence: float,
    unit: Buffer,
    work: Workspace,
    first: int,
    x: Buffer,
    u: Buffer,
    dx: Buffer,
    du: Buffer,
    status: Buffer,
    lam: Buffer,
    gain_only: bool,
    local: bool,
) -> tuple[int, int]:
    """Simulate from x[first] and dx[first], with derivatives along p directions (p may be 0).

    `disturbance` (steps, d); `unit` (m,); `x` (steps + 1, n); `u` (steps, m); `dx` (steps +
    1, n, p); `du` (steps, m, p); `status` (steps,); `lam` (r,).
    """
    # The caller keeps all of these while this runs.
    loop, dloop, rows, drows, body = borrowed((loop, dloop, rows, drows, body))
    pushes, disturbance, unit, work = borrowed((pushes, disturbance, unit, work))
    x, u, dx, du, status, lam = borrowed((x, u, dx, du, status, lam))
    plant_moves = bool(np.any(dloop.A) or np.any(dloop.B) or np.any(dloop.E))
    weakly_active = 0
    for t in range(first, len(u)):
        if status[t] > SOFTENED:
            status[t], near, row = law(
                loop, dloop, rows, drows, unit, work, x[t], dx[t], lam, gain_only, u[t], du[t]
            )
            if status[t] > SOFTENED:
                _hold(x, dx, t)
                return weakly_active, row
            weakly_active += near
        if body.address:
            move_body(body, x[t], u[t], disturbance[t], dx[t], du[t], x[t + 1], dx[t + 1])
            if len(pushes):
                dx[t + 1] += pushes[t]
        else:
            _advance(loop, dloop, plant_moves, disturbance[t], x, dx, u[t], du[t], t)
        if local:
            dx[t + 1] = dx[0]
        size = np.max(np.abs(x[t + 1]))
        if not size < divergence:
            status[t] = DIVERGED
            _hold(x, dx, t)
            return weakly_active, -1
    return weakly_active, -1


@njit(cache=True)
def _advance(
    loop: LoopMatrices,
    dloop: LoopMatrices,
    plant_moves: bool,
    disturbance: Buffer,
    x: Buffer,
    dx: Buffer,
    u: Buffer,
    du: Buffer,
    t: int,
) -> None:
    """x+ = A x + B u + E d and its derivative."""
    n, p = x.shape[1], dx.shape[2]
    for i in range(n):
        x[t + 1, i] = dot(loop.A[i], x[t]) + dot(loop.B[i], u) + dot(loop.E[i], disturbance)
        for j in range(n):
            if loop.A[i, j] != 0.0:
                for c in range(p):
                    dx[t + 1, i, c] += loop.A[i, j] * dx[t, j, c]
        for j in range(len(u)):
            for c in range(p):
                dx[t + 1, i, c] += loop.B[i, j] * du[j, c]
        if plant_moves:
            for c in range(p):
                for j in range(n):
                    dx[t + 1, i, c] += dloop.A[i, j, c] * x[t, j]
                for j in range(len(u)):
                    dx[t + 1, i, c] += dloop.B[i, j, c] * u[j]
                for j in range(len(disturbance)):
                    dx[t + 1, i, c] += dloop.E[i, j, c] * disturbance[j]


@njit(cache=True)
def _hold(x: Buffer, dx: Buffer, t: int) -> None:
    """Repeat the last state, so that what was not reached is finite."""
    x[t + 1 :] = x[t]
    dx[t + 1 :] = 0.0
