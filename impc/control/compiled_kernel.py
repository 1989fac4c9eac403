"""Compiled code: the constrained controller and its closed loop, with derivatives.

    u = -K x + v_0,    x+ = A x + B u + E d

v is zero while the gain keeps every bound, and else the answer of the least-distance problem
(`compiled_dual`); each answer is checked before it is given out. The letters and the checks are
those of docs/theory.md, section 4; `closed_loop` has the equations of the derivatives. Where the
body that moves is not linear, its machine code is called (`compiled_body`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from impc.arrays import Buffer
from impc.control.compiled_body import BodyTape, move_body
from impc.control.compiled_dual import (
    DEPENDENT,
    INCONSISTENT,
    UNFINISHED,
    accept_row,
    append_row,
    refine,
    solve_dual,
    substitute,
    substitute_all,
)
from impc.jit import njit

if TYPE_CHECKING:
    from impc.control.constraint_rows import RowDirections, Rows

#: Of `closed_loop.Status`, by which what is compiled says how a sample ended.
FREE, ACTIVE, SOFTENED, INFEASIBLE, UNSOLVED, DIVERGED = 0, 1, 2, 3, 4, 5
#: No entry of plant and estimate together goes beyond this: neither a state nor what is expected.
LARGEST = 1e100
# A row is kept when it is exceeded by less than this share of its bound: a hundred times the
# rounding of T x + M v, so that the quadratic program is never entered for rounding alone.
_KEPT = 1e-13
# Share of its bound within which a row is about to become active, or to become free.
_WEAK = 1e-8
# The answer must keep every row, and say the first input, to this share of the bound, whatever the
# multipliers are, or it is not given out.
_CHECKED = 1e-9
# Rounding of a row at the answer, relative to the sum of the magnitudes of its terms.
_ROW_ROUNDING = 1e-14
# Rounding of v, relative to the same.
_SUM_ROUNDING = 1e-15


class LoopMatrices(NamedTuple):
    """Plant, gain and inverse metric; or derivatives (those of S itself) along p directions."""

    A: Buffer  # (n, n), (n, m) and (n, d); derivatives have a last axis more, (n, n, p) and so on
    B: Buffer
    E: Buffer
    K: Buffer  # (m, n), derivatives (m, n, p)
    S: Buffer  # S^-1 (m, m); derivatives are those of S, (m, m, p)


class Workspace(NamedTuple):
    """Arrays that one sample after the other uses."""

    # Of the rows (r,), the violation of each that counts as kept (r,), the free rows (a + 1,)
    slack: Buffer
    kept: Buffer
    free: Buffer
    factor: Buffer  # As in `solve_dual`, (a + 1, a + 1) and (a + 1, N m)
    basis: Buffer
    v: Buffer  # Inputs ahead beside the gain's, and what rounding makes of them (N m,)
    rounding: Buffer
    dv0: Buffer  # Derivatives of the first of them (m, p)
    T: Buffer  # Columns of the rows, one after the other: (n, r) and (N m, r)
    M: Buffer
    # How many rows are free at the last sample (1,). The problem of the next one begins with them,
    # for its plan is much like that of the one before.
    active: Buffer


@njit(cache=True)
def workspace(rows: Rows, m: int, p: int) -> Workspace:
    """Arrays that `law` works in, for `m` inputs and `p` directions of given `rows`."""
    count, width = rows.M.shape
    room = min(count, width) + 1
    # One column of T and M after the other: sums over columns then run over all rows at once.
    return Workspace(
        np.empty(count),
        _KEPT * rows.b,
        np.empty(room, dtype=np.int64),
        np.empty((room, room)),
        np.empty((room, width)),
        np.zeros(width),
        np.empty(width),
        np.zeros((m, p)),
        np.ascontiguousarray(rows.T.T),
        np.ascontiguousarray(rows.M.T),
        np.zeros(1, dtype=np.int64),
    )


@njit(cache=True, inline="always")
def dot(a: Buffer, b: Buffer) -> float:
    """a'b, of two arrays of one length (k,)."""
    total = 0.0
    for i in range(len(a)):
        total += a[i] * b[i]
    return total


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
        size = 0.0
        for i in range(x.shape[1]):
            if not abs(x[t + 1, i]) <= size:  # nor where it is no number
                size = abs(x[t + 1, i])
        if not size < divergence:
            status[t] = DIVERGED
            _hold(x, dx, t)
            return weakly_active, -1
    return weakly_active, -1


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


@njit(cache=True, inline="always")
def law(
    loop: LoopMatrices,
    dloop: LoopMatrices,
    rows: Rows,
    drows: RowDirections,
    unit: Buffer,
    work: Workspace,
    x: Buffer,
    dx: Buffer,
    lam: Buffer,
    gain_only: bool,
    u: Buffer,
    du: Buffer,
) -> tuple[int, bool, int]:
    """Write the input of one state, with its derivatives.

    `x` (n,); `dx` (n, p); `u` (m,); `du` (m, p).
    """
    v = work.v
    needs_qp, near = _look(work.T, rows.b, work.kept, x, work.slack)
    v[: len(u)] = 0.0
    work.dv0[:] = 0.0
    begin, work.active[0] = work.active[0], 0
    if needs_qp:
        if gain_only:
            return UNSOLVED, False, -1
        status, near, row = _solve(loop, dloop, rows, drows, unit, work, x, dx, lam, begin)
        if status > SOFTENED:
            return status, near, row
    else:
        status = FREE
    _apply(loop, dloop, v, work.dv0, x, dx, u, du)
    return status, near, -1


@njit(cache=True, inline="always")
def _look(T: Buffer, b: Buffer, kept: Buffer, x: Buffer, slack: Buffer) -> tuple[bool, bool]:
    """Write the slack of the gain; whether a row is broken, and whether one is about to be."""
    broken, near = False, False
    _fill_slack(T, b, x, slack)
    for r in range(len(slack)):
        broken |= not slack[r] >= -kept[r]
        near |= abs(slack[r]) < _WEAK * b[r]
    return broken, near


@njit(cache=True, inline="always")
def _fill_slack(T: Buffer, b: Buffer, x: Buffer, slack: Buffer) -> None:
    """slack = b - T'x, with T one column of the rows after the other."""
    slack[:] = 0.0
    for i in range(len(x)):
        for r in range(len(slack)):
            slack[r] += T[i, r] * x[i]
    for r in range(len(slack)):
        slack[r] = b[r] - slack[r]


@njit(cache=True)
def _solve(
    loop: LoopMatrices,
    dloop: LoopMatrices,
    rows: Rows,
    drows: RowDirections,
    unit: Buffer,
    work: Workspace,
    x: Buffer,
    dx: Buffer,
    lam: Buffer,
    begin: int,
) -> tuple[int, bool, int]:
    """Write v and dv0 of one sample; return its status, whether its rows are weak, and a row."""
    code, active = solve_dual(
        rows.W,
        rows.gram,
        work.slack,
        rows.limit,
        work.kept,
        lam,
        work.free,
        work.factor,
        work.basis,
        begin,
    )
    if code == INCONSISTENT:
        return INFEASIBLE, False, active
    if code == UNFINISHED:
        return UNSOLVED, False, -1
    work.active[0] = active
    status, near = answer(loop, dloop, rows, drows, unit, work, x, dx, lam, active)
    return status, near, -1


@njit(cache=True, nogil=True)
def answer_with(
    loop: LoopMatrices,
    dloop: LoopMatrices,
    rows: Rows,
    drows: RowDirections,
    unit: Buffer,
    tight: Buffer,
    given_up: Buffer,
    x: Buffer,
    dx: Buffer,
    u: Buffer,
    du: Buffer,
    lam: Buffer,
    v: Buffer,
) -> tuple[int, bool]:
    """Input of one sample and its derivative, where another solver has found the active set.

    `unit` (m,); `x` (n,); `dx` (n, p); `tight` (a,); `given_up` (r,); `u` (m,); `du` (m, p);
    `lam` (r,); `v` (N m,).
    """
    work, active = workspace(rows, du.shape[0], du.shape[1]), len(tight)
    if active >= len(work.free):
        return UNSOLVED, False
    _fill_slack(work.T, rows.b, x, work.slack)
    for i in range(active):
        work.free[i] = tight[i]
        new = append_row(rows.W, tight[i], i, work.factor, work.basis)
        if not new > DEPENDENT * np.sqrt(rows.gram[tight[i], tight[i]]):
            return UNSOLVED, False
        accept_row(i, new, work.factor, work.basis)
    for r in range(len(lam)):
        lam[r] = rows.limit[r] if given_up[r] else 0.0
    refine(rows.gram, work.slack, rows.limit, given_up, lam, work.free, active, work.factor)
    for i in range(active):
        if lam[tight[i]] > rows.limit[tight[i]]:
            return UNSOLVED, False
    status, near = answer(loop, dloop, rows, drows, unit, work, x, dx, lam, active)
    v[:] = work.v
    if status != UNSOLVED:
        _apply(loop, dloop, work.v, work.dv0, x, dx, u, du)
    return status, near


@njit(cache=True, inline="always")
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
        u[i] = v[i] - dot(loop.K[i], x)
        for c in range(p):
            du[i, c] = dv0[i, c]
        for j in range(len(x)):
            for c in range(p):
                du[i, c] -= loop.K[i, j] * dx[j, c] + dloop.K[i, j, c] * x[j]


@njit(cache=True)
def answer(
    loop: LoopMatrices,
    dloop: LoopMatrices,
    rows: Rows,
    drows: RowDirections,
    unit: Buffer,
    work: Workspace,
    x: Buffer,
    dx: Buffer,
    lam: Buffer,
    active: int,
) -> tuple[int, bool]:
    """Write v and dv0 of `work` from the multipliers of one sample, where they give the input.

    `unit` (m,); `x` (n,); `dx` (n, p); `lam` (r,).
    """
    _recover(rows, lam, work)
    soft, near, solved = _check(loop.K, rows, lam, work, active, x, unit)
    if not solved:
        _tighten(rows, work, active)
        soft, near, solved = _check(loop.K, rows, lam, work, active, x, unit)
    if not solved:
        return UNSOLVED, False
    if dx.shape[1]:
        _differentiate(loop, dloop, rows, drows, lam, work, active, x, dx)
    return (SOFTENED if soft else ACTIVE), near


@njit(cache=True)
def _recover(rows: Rows, lam: Buffer, work: Workspace) -> None:
    """v = -N' lam, and what rounding made of it."""
    v, rounding = work.v, work.rounding
    v[:] = 0.0
    rounding[:] = 0.0
    for r in range(len(lam)):
        if lam[r] != 0.0:
            for i in range(len(v)):
                part = lam[r] * rows.N[r, i]
                v[i] -= part
                rounding[i] += _SUM_ROUNDING * abs(part)


@njit(cache=True)
def _tighten(rows: Rows, work: Workspace, active: int) -> None:
    """Correct v so that the tight rows are tight.

    The cost weight of a soft row is a million and more: what is left of v has lost as many digits.
    """
    slack, free, v = work.slack, work.free, work.v
    column = np.empty(active)
    for a in range(active):
        column[a] = slack[free[a]] - dot(rows.M[free[a]], v)
    substitute(work.factor, active, column)
    for a in range(active):
        for i in range(len(v)):
            v[i] += column[a] * rows.N[free[a], i]


@njit(cache=True)
def _check(
    K: Buffer,
    rows: Rows,
    lam: Buffer,
    work: Workspace,
    active: int,
    x: Buffer,
    unit: Buffer,
) -> tuple[bool, bool, bool]:
    """Whether a soft row was given up, a row is tight without a multiplier, it is solved.

    It is identified when every row is kept, and every multiplier has its sign, to a share of the
    bound that no multiplier enters, and when that and rounding move the first v by no more: by the
    derivative of v along the right sides of the tight rows (docs/theory.md, section 4).
    """
    soft, near, m = False, False, len(unit)
    slack, free, factor, v = work.slack, work.free, work.factor, work.v
    wrong, lefts, sizes = np.empty(len(lam)), slack.copy(), rows.b.copy()
    for i in range(len(x)):
        for r in range(len(lam)):
            sizes[r] += abs(work.T[i, r] * x[i])
    for i in range(len(v)):
        for r in range(len(lam)):
            part = work.M[i, r] * v[i]
            lefts[r] -= part
            sizes[r] += abs(part)
    for r in range(len(lam)):
        left, bound = lefts[r], rows.b[r]
        wrong[r] = abs(left) + _ROW_ROUNDING * sizes[r]
        pulled = lam[r] * rows.gram[r, r]
        if lam[r] == rows.limit[r]:
            soft |= left < -_WEAK * bound
            broken = left > _CHECKED * bound
        else:
            broken = not left > -_CHECKED * bound or pulled < -_CHECKED * bound
        if broken:
            return soft, near, False
        # A multiplier moves v by lam N: weak when that is nothing beside the row's bound.
        near |= abs(left) < _WEAK * bound and pulled < _WEAK * bound
    column, moved = np.empty(active), np.empty(len(v))
    for i in range(m):
        for a in range(active):
            column[a] = rows.N[free[a], i]
        substitute(factor, active, column)
        error, size = 0.0, 0.0
        moved[:] = 0.0
        moved[i] = 1.0
        for a in range(active):
            error += abs(column[a]) * wrong[free[a]]
            for k in range(len(v)):
                moved[k] -= column[a] * rows.M[free[a], k]
        for k in range(len(v)):
            error += abs(moved[k]) * work.rounding[k]
        for j in range(len(x)):
            size += abs(K[i, j] * x[j])
        if not error <= _CHECKED * min(unit[i], abs(v[i]) + size):
            return soft, near, False
    return soft, near, True


@njit(cache=True)
def _differentiate(
    loop: LoopMatrices,
    dloop: LoopMatrices,
    rows: Rows,
    drows: RowDirections,
    lam: Buffer,
    work: Workspace,
    active: int,
    x: Buffer,
    dx: Buffer,
) -> None:
    """Write the derivative of the first v; the module `closed_loop` has the equations."""
    v, free, dv0 = work.v, work.free, work.dv0
    width, p = len(v), dx.shape[1]
    m, n = dv0.shape[0], len(x)
    q, dlam = np.zeros((width, p)), np.empty((active, p))
    for i in range(width):
        for j in range(m):
            for c in range(p):
                q[i, c] += dloop.S[i % len(dloop.S), j, c] * v[i - i % m + j]
    _add_pulls(rows, drows, lam, m, q)
    for a in range(active):
        r = free[a]
        for c in range(p):
            dlam[a, c] = -drows.b[r, c]
        for i in range(n):
            for c in range(p):
                dlam[a, c] += drows.T[r, i, c] * x[i] + rows.T[r, i] * dx[i, c]
        for i in range(_reach(rows, r, m)):
            for c in range(p):
                dlam[a, c] += drows.M[r, i, c] * v[i] - rows.N[r, i] * q[i, c]
    substitute_all(work.factor, active, dlam)
    for i in range(m):
        for j in range(m):
            for c in range(p):
                dv0[i, c] -= loop.S[i, j] * q[j, c]
        for a in range(active):
            for c in range(p):
                dv0[i, c] -= rows.N[free[a], i] * dlam[a, c]


@njit(cache=True, inline="always")
def _reach(rows: Rows, r: int, m: int) -> int:
    """Columns of M before those that row r, at its stage, cannot have."""
    return min(rows.M.shape[1], m * (rows.stage[r] + 1))  # type: ignore[no-any-return]


@njit(cache=True)
def _add_pulls(rows: Rows, drows: RowDirections, lam: Buffer, m: int, q: Buffer) -> None:
    """Add dM' lam to q, and what the cost weight of soft rows does."""
    for r in range(len(lam)):
        if lam[r] != 0.0:
            for i in range(_reach(rows, r, m)):
                for c in range(q.shape[1]):
                    q[i, c] += lam[r] * drows.M[r, i, c]
            if lam[r] == rows.limit[r]:
                # The cost weight of a soft row is penalty / b: it moves with the bound.
                for i in range(len(q)):
                    for c in range(q.shape[1]):
                        q[i, c] -= rows.M[r, i] * lam[r] / rows.b[r] * drows.b[r, c]
