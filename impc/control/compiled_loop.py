"""Compiled code: the closed loop over samples, with derivatives along any directions.

    x+ = A x + B u + E d

with the input u of `compiled_kernel.law`; nonlinear bodies: `compiled_body`.
"""

from __future__ import annotations

import numpy as np

from impc.arrays import Buffer
from impc.control.compiled_body import move_body
from impc.control.compiled_borrowed import borrowed
from impc.control.compiled_kernel import add, deviate, dot, law, return_to
from impc.control.compiled_values import (
    DIVERGED,
    SOFTENED,
    Aim,
    BodyTape,
    LoopMatrices,
    RowDirections,
    Rows,
    Trace,
    Workspace,
)
from impc.jit import njit


@njit(cache=True, nogil=True)  # held-out trials are fitted in parallel threads
def run(
    loop: LoopMatrices,
    dloop: LoopMatrices,
    rows: Rows,
    drows: RowDirections,
    body: BodyTape,
    pushes: Buffer,
    disturbance: Buffer,
    aim: Aim,
    divergence: float,
    unit: Buffer,
    work: Workspace,
    first: int,
    trace: Trace,
    gain_only: bool,
    local: bool,
) -> tuple[int, int]:
    """Simulate from sample `first`, with derivatives along p directions (p may be 0).

    `disturbance` (steps, d); `unit` (m,).
    """
    loop, dloop, rows, drows, body = borrowed((loop, dloop, rows, drows, body))
    pushes, disturbance, aim, unit, work = borrowed((pushes, disturbance, aim, unit, work))
    x, u, dx, du, seen, dy, status, lam = borrowed(trace)
    plant_moves = bool(np.any(dloop.A) or np.any(dloop.B) or np.any(dloop.E))
    weakly_active = 0
    away, daway = np.empty(x.shape[1]), np.empty(dx.shape[1:])
    for t in range(first, len(u)):
        at, moved, ahead = dx[t % len(dx)], du[t % len(du)], dx[(t + 1) % len(dx)]
        _observe(seen, at, dy[t])
        if status[t] > SOFTENED:
            away[:], daway[:] = x[t], at
            deviate(aim, rows, drows, work, t, away, daway)
            status[t], near, row = law(
                loop, dloop, rows, drows, unit, work, away, daway, lam, gain_only, u[t], moved
            )
            if status[t] > SOFTENED:
                _hold(x, dx, t)
                return weakly_active, row
            return_to(aim, t, u[t], moved)
            weakly_active += near
        if body.address:
            move_body(body, x[t], u[t], disturbance[t], at, moved, x[t + 1], ahead)
            if len(pushes):
                ahead += pushes[t]
        else:
            _advance(
                loop, dloop, plant_moves, disturbance[t], x[t], at, u[t], moved, x[t + 1], ahead
            )
        if local:
            ahead[:] = dx[0]
        if not _largest(x[t + 1]) < divergence:
            status[t] = DIVERGED
            _hold(x, dx, t)
            return weakly_active, -1
    _observe(seen, dx[len(u) % len(dx)], dy[len(u)])
    return weakly_active, -1


@njit(cache=True, inline="always")
def _largest(x: Buffer) -> float:
    """Largest magnitude of an entry, or NaN."""
    size = 0.0
    for i in range(len(x)):
        if not abs(x[i]) <= size:  # also true for NaN
            size = abs(x[i])
    return size


@njit(cache=True, inline="always")
def _observe(seen: Buffer, dx: Buffer, dy: Buffer) -> None:
    """Compute dy = seen dx."""
    for i in range(len(seen)):
        dy[i] = 0.0
        for j in range(len(dx)):
            if seen[i, j] != 0.0:
                add(seen[i, j], dx[j], dy[i])


@njit(cache=True, inline="always")
def _advance(
    loop: LoopMatrices,
    dloop: LoopMatrices,
    plant_moves: bool,
    disturbance: Buffer,
    x: Buffer,
    dx: Buffer,
    u: Buffer,
    du: Buffer,
    following: Buffer,
    dfollowing: Buffer,
) -> None:
    """Compute x+ = A x + B u + E d, `following`, and its derivative."""
    n = len(x)
    for i in range(n):
        following[i] = dot(loop.A[i], x) + dot(loop.B[i], u) + dot(loop.E[i], disturbance)
        ahead = dfollowing[i]
        ahead[:] = 0.0
        for j in range(n):
            if loop.A[i, j] != 0.0:
                add(loop.A[i, j], dx[j], ahead)
        for j in range(len(u)):
            add(loop.B[i, j], du[j], ahead)
        if plant_moves:
            for j in range(n):
                add(x[j], dloop.A[i, j], ahead)
            for j in range(len(u)):
                add(u[j], dloop.B[i, j], ahead)
            for j in range(len(disturbance)):
                add(disturbance[j], dloop.E[i, j], ahead)


@njit(cache=True)
def _hold(x: Buffer, dx: Buffer, t: int) -> None:
    """Repeat the last state, so that samples that are not reached are finite."""
    x[t + 1 :] = x[t]
    if len(dx) == len(x):
        dx[t + 1 :] = 0.0
