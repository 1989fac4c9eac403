"""Compiled loop of `closed_loop`: see there for the mathematics."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from impc.arrays import Buffer
from impc.least_distance import CONVERGED, INCONSISTENT, solve_dual, substitute
from impc.prediction import RowDirections, Rows

__all__ = ["LoopMatrices", "run"]

# A row is kept when it is exceeded by less than this share of its bound: a hundred times the
# rounding of T x + M v, so that the quadratic program is never entered for rounding alone.
_KEPT = 1e-13
_WEAK = 1e-8

_FREE, _ACTIVE, _SOFTENED, _INFEASIBLE, _UNSOLVED, _DIVERGED = 0, 1, 2, 3, 4, 5


class LoopMatrices(NamedTuple):
    """Plant, gain and inverse metric; or derivatives (those of S itself) along p directions."""

    A: Buffer
    B: Buffer
    E: Buffer
    K: Buffer
    S: Buffer


@njit(cache=True)
def run(
    loop: LoopMatrices,
    dloop: LoopMatrices,
    rows: Rows,
    drows: RowDirections,
    disturbance: Buffer,
    divergence: float,
    x: Buffer,
    u: Buffer,
    dx: Buffer,
    du: Buffer,
    status: Buffer,
) -> tuple[int, int]:
    """Fill x, u, dx, du and status; return the count of weak samples and the inconsistent row."""
    count = len(rows.b)
    lam, slack = np.zeros(count), np.empty(count)
    room = min(count, rows.W.shape[1]) + 1
    free, factor = np.empty(room, dtype=np.int64), np.empty((room, room))
    basis = np.empty((room, rows.W.shape[1]))
    kept = _KEPT * rows.b
    v, dv0 = np.zeros(rows.M.shape[1]), np.zeros(du.shape[1:])
    plant_moves = bool(np.any(dloop.A) or np.any(dloop.B) or np.any(dloop.E))
    weakly_active, horizon_inputs = 0, u.shape[1]
    for t in range(len(u)):
        needs_qp, soft, near = False, False, False
        for r in range(count):
            slack[r] = rows.b[r] - _dot(rows.T[r], x[t])
            needs_qp |= slack[r] < -kept[r]
            near |= abs(slack[r]) < _WEAK * rows.b[r]
        v[:horizon_inputs] = 0.0
        dv0[:] = 0.0
        if needs_qp:
            code, active = solve_dual(
                rows.W, rows.gram, slack, rows.limit, kept, lam, free, factor, basis
            )
            if code != CONVERGED:
                status[t] = _INFEASIBLE if code == INCONSISTENT else _UNSOLVED
                _hold(x, dx, t)
                return weakly_active, active if code == INCONSISTENT else -1
            _recover(rows, lam, v)
            soft, near = _classify(rows, slack, lam, v, horizon_inputs)
            if dx.shape[2]:
                _differentiate(
                    loop, dloop, rows, drows, lam, free, factor, active, v, x[t], dx[t], dv0
                )
        status[t] = _SOFTENED if soft else (_ACTIVE if needs_qp else _FREE)
        weakly_active += near
        _apply(loop, dloop, v, dv0, x[t], dx[t], u[t], du[t])
        _advance(loop, dloop, plant_moves, disturbance[t], x, dx, u[t], du[t], t)
        size = np.max(np.abs(x[t + 1]))
        if not size < divergence:
            status[t] = _DIVERGED
            _hold(x, dx, t)
            return weakly_active, -1
    return weakly_active, -1


@njit(cache=True, inline="always")
def _dot(a: Buffer, b: Buffer) -> float:
    total = 0.0
    for i in range(len(a)):
        total += a[i] * b[i]
    return total


@njit(cache=True)
def _hold(x: Buffer, dx: Buffer, t: int) -> None:
    """Repeat the last state, so that what was not reached is finite."""
    x[t + 1 :] = x[t]
    dx[t + 1 :] = 0.0


@njit(cache=True)
def _recover(rows: Rows, lam: Buffer, v: Buffer) -> None:
    """v = -N' lam."""
    v[:] = 0.0
    for r in range(len(lam)):
        if lam[r] != 0.0:
            for i in range(len(v)):
                v[i] -= lam[r] * rows.N[r, i]


@njit(cache=True)
def _classify(rows: Rows, slack: Buffer, lam: Buffer, v: Buffer, inputs: int) -> tuple[bool, bool]:
    """Whether a soft row was given up, and whether a row is tight without a multiplier."""
    soft, near = False, False
    for r in range(len(lam)):
        left = slack[r] - _dot(rows.M[r], v)
        if lam[r] == rows.limit[r]:
            soft |= left < -_WEAK * rows.b[r]
        # A multiplier moves v by lam N: weak when that is nothing beside the row's bound.
        if abs(left) < _WEAK * rows.b[r] and lam[r] * rows.gram[r, r] < _WEAK * rows.b[r]:
            near = True
    return soft, near


@njit(cache=True)
def _differentiate(
    loop: LoopMatrices,
    dloop: LoopMatrices,
    rows: Rows,
    drows: RowDirections,
    lam: Buffer,
    free: Buffer,
    factor: Buffer,
    active: int,
    v: Buffer,
    x: Buffer,
    dx: Buffer,
    dv0: Buffer,
) -> None:
    """Write the derivative of the first v; the module `closed_loop` has the equations."""
    width, p = len(v), dx.shape[1]
    m, n = dv0.shape[0], len(x)
    q = np.zeros((width, p))
    for i in range(width):
        stage = i - i % m
        for j in range(m):
            weight = v[stage + j]
            for c in range(p):
                q[i, c] += dloop.S[i % m, j, c] * weight
    for r in range(len(lam)):
        if lam[r] != 0.0:
            for i in range(width):
                for c in range(p):
                    q[i, c] += lam[r] * drows.M[r, i, c]
            if lam[r] == rows.limit[r]:
                # The price of a soft row is penalty / b: it moves with the bound.
                for i in range(width):
                    for c in range(p):
                        q[i, c] -= rows.M[r, i] * lam[r] / rows.b[r] * drows.b[r, c]
    dlam = np.zeros((active, p))
    for a in range(active):
        r = free[a]
        for c in range(p):
            dlam[a, c] = -drows.b[r, c]
        for i in range(n):
            for c in range(p):
                dlam[a, c] += drows.T[r, i, c] * x[i] + rows.T[r, i] * dx[i, c]
        for i in range(width):
            for c in range(p):
                dlam[a, c] += drows.M[r, i, c] * v[i] - rows.N[r, i] * q[i, c]
    column = np.empty(active)
    for c in range(p):
        column[:] = dlam[:, c]
        substitute(factor, active, column)
        dlam[:, c] = column
    for i in range(m):
        for j in range(m):
            for c in range(p):
                dv0[i, c] -= loop.S[i, j] * q[j, c]
        for a in range(active):
            for c in range(p):
                dv0[i, c] -= rows.N[free[a], i] * dlam[a, c]


@njit(cache=True)
def _apply(
    loop: LoopMatrices,
    dloop: LoopMatrices,
    v: Buffer,
    dv0: Buffer,
    x: Buffer,
    dx: Buffer,
    u: Buffer,
    du: Buffer,
) -> None:
    """u = -K x + v_0 and its derivative."""
    p = dx.shape[1]
    for i in range(len(u)):
        u[i] = v[i] - _dot(loop.K[i], x)
        for c in range(p):
            du[i, c] = dv0[i, c]
        for j in range(len(x)):
            for c in range(p):
                du[i, c] -= loop.K[i, j] * dx[j, c] + dloop.K[i, j, c] * x[j]


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
        x[t + 1, i] = _dot(loop.A[i], x[t]) + _dot(loop.B[i], u) + _dot(loop.E[i], disturbance)
        for j in range(n):
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
