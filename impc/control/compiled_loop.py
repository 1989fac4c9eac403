"""Compiled code: the closed loop over samples, with derivatives along any directions.

    x+ = A x + B u + E d

with the input u of `compiled_kernel.law`; nonlinear bodies: `compiled_body`.

numba counts the users of each array whenever it is taken out of a tuple or passed to a function,
with a locked addition. In loops that pass dozens of arrays at each sample this is a third of the
time (`python -m experiments.benchmarks`), so the loop borrows its arrays: they have no counter.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numba.core import cgutils, types
from numba.extending import intrinsic

from impc.arrays import Buffer
from impc.control.compiled_body import move_body
from impc.control.compiled_kernel import add, copy, deviate, dot, law, return_to
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


def _borrowed(_context: Any, value: Any) -> Any:
    """Return an array, or a tuple of arrays and tuples, without counters.

    The caller must keep the arrays: those that Python passes to a compiled function live until it
    returns.
    """

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        return _without_owner(context, builder, signature.args[0], given[0])

    return value(value), generate


def _without_owner(context: Any, builder: Any, kind: Any, value: Any) -> Any:
    """Value of the type `kind` in which no array has an owner."""
    if isinstance(kind, types.BaseTuple):
        kinds: list[Any] = list(kind)  # type: ignore[call-overload]
        parts = [
            _without_owner(context, builder, each, builder.extract_value(value, place))
            for place, each in enumerate(kinds)
        ]
        return context.make_tuple(builder, kind, parts)
    if isinstance(kind, types.Array):
        array = context.make_array(kind)(context, builder, value)
        array.meminfo = _null(array.meminfo.type)
        array.parent = _null(array.parent.type)
        return array._getvalue()
    return value


_make: Any = intrinsic
_null: Any = cgutils.get_null_value
_borrow: Callable[[Any], Any] = _make(_borrowed)


@njit(nogil=True)  # held-out trials are fitted in parallel threads
def run(
    loop: LoopMatrices,
    dloop: LoopMatrices,
    rows: Rows,
    drows: RowDirections,
    body: BodyTape,
    pushes: Buffer,
    disturbance: Buffer,
    pushed: Buffer,
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

    `disturbance` (steps, d), `pushed` (steps, d, q) its derivatives along the last q directions;
    `pushes` (steps, n, p), or empty, what else moves the next state; `unit` (m,).
    """
    loop, dloop, rows, drows, body = _borrow((loop, dloop, rows, drows, body))
    pushes, disturbance, aim, unit, work = _borrow((pushes, disturbance, aim, unit, work))
    pushed = _borrow(pushed)
    x, u, dx, du, seen, dy, status, lam = _borrow(trace)
    plant_moves = bool(np.any(dloop.A) or np.any(dloop.B) or np.any(dloop.E))
    weakly_active = 0
    away, daway = np.empty(x.shape[1]), np.empty(dx.shape[1:])
    last = first + 1 if len(work.given_up) else len(u)
    for t in range(first, last):
        at, moved, ahead = dx[t % len(dx)], du[t % len(du)], dx[(t + 1) % len(dx)]
        _observe(seen, at, dy[t])
        if status[t] > SOFTENED:
            copy(x[t], away)
            for i in range(len(at)):
                copy(at[i], daway[i])
            deviate(aim, rows, drows, work, t, away, daway)
            status[t], near, row = law(
                loop, dloop, rows, drows, unit, work, away, daway, lam, gain_only, u[t], moved
            )
            if status[t] > SOFTENED:
                return weakly_active, row
            return_to(aim, t, u[t], moved)
            weakly_active += near
        if body.address:
            move_body(body, x[t], u[t], disturbance[t], at, moved, x[t + 1], ahead)
            _push(body.slopes, x.shape[1] + u.shape[1], pushed[t], ahead)
        else:
            _advance(loop, disturbance[t], x[t], at, u[t], moved, x[t + 1], ahead)
            _push(loop.E, 0, pushed[t], ahead)
        if plant_moves:
            _move_plant(dloop, disturbance[t], x[t], u[t], ahead)
        if len(pushes):
            for i in range(len(ahead)):
                add(1.0, pushes[t, i], ahead[i])
        if local:
            for i in range(len(ahead)):
                copy(dx[0, i], ahead[i])
        if not _largest(x[t + 1]) < divergence:
            status[t] = DIVERGED
            return weakly_active, -1
    _observe(seen, dx[last % len(dx)], dy[last])
    return weakly_active, -1


@njit(inline="always")
def _largest(x: Buffer) -> float:
    """Largest magnitude of an entry, or NaN."""
    size = 0.0
    for i in range(len(x)):
        if not abs(x[i]) <= size:  # also true for NaN
            size = abs(x[i])
    return size


@njit(inline="always")
def _observe(seen: Buffer, dx: Buffer, dy: Buffer) -> None:
    """Compute dy = seen dx."""
    for i in range(len(seen)):
        dy[i] = 0.0
        for j in range(len(dx)):
            if seen[i, j] != 0.0:
                add(seen[i, j], dx[j], dy[i])


@njit(inline="always")
def _advance(
    loop: LoopMatrices,
    disturbance: Buffer,
    x: Buffer,
    dx: Buffer,
    u: Buffer,
    du: Buffer,
    following: Buffer,
    dfollowing: Buffer,
) -> None:
    """Compute x+ = A x + B u + E d, `following`, and its derivative for a fixed plant."""
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


@njit(inline="always")
def _move_plant(
    dloop: LoopMatrices, disturbance: Buffer, x: Buffer, u: Buffer, dfollowing: Buffer
) -> None:
    """Add dA x + dB u + dE d to the derivative of the next state."""
    for i in range(len(x)):
        for j in range(len(x)):
            add(x[j], dloop.A[i, j], dfollowing[i])
        for j in range(len(u)):
            add(u[j], dloop.B[i, j], dfollowing[i])
        for j in range(len(disturbance)):
            add(disturbance[j], dloop.E[i, j], dfollowing[i])


@njit(inline="always")
def _push(slopes: Buffer, column: int, pushed: Buffer, dfollowing: Buffer) -> None:
    """Add slopes[:, column :] pushed, `pushed` (d, q), to the last q derivatives."""
    first = dfollowing.shape[1] - pushed.shape[1]
    for i in range(len(dfollowing)):
        for j in range(len(pushed)):
            add(slopes[i, column + j], pushed[j], dfollowing[i, first:])
