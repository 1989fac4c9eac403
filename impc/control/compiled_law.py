"""Compiled code: the input of one state, u = -K x + v_0, with its derivatives.

v is zero while the gain keeps every bound, and else the answer of the least-distance problem
(`compiled_dual`; docs/theory.md, section 4). The next sample's problem begins with the rows that
are tight at this one.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Buffer
from impc.control.compiled_answer import WEAK, answer
from impc.control.compiled_arrays import (
    FREE,
    INFEASIBLE,
    SOFTENED,
    UNSOLVED,
    LoopMatrices,
    Workspace,
    workspace,
)
from impc.control.compiled_dual import (
    DEPENDENT,
    INCONSISTENT,
    UNFINISHED,
    accept_row,
    append_row,
    refine,
    solve_dual,
)
from impc.control.compiled_products import dot
from impc.jit import njit

if TYPE_CHECKING:
    from impc.control.constraint_rows import RowDirections, Rows

__all__ = ["COMPILED_WITH", "answer_with", "law"]

#: First digits of the SHA-256 of each file whose functions are called: numba's cache does not look.
COMPILED_WITH = {
    "compiled_answer": "11ad4cd4c8ddf893",
    "compiled_arrays": "f9299fe715d0d2a3",
    "compiled_dual": "c3376c1c32aa9492",
    "compiled_products": "50101205237e0db3",
}


@njit(cache=True)
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


@njit(cache=True)
def _look(T: Buffer, b: Buffer, kept: Buffer, x: Buffer, slack: Buffer) -> tuple[bool, bool]:
    """Write the slack of the gain; whether a row is broken, and whether one is about to be."""
    broken, near = False, False
    _fill_slack(T, b, x, slack)
    for r in range(len(slack)):
        broken |= not slack[r] >= -kept[r]
        near |= abs(slack[r]) < WEAK * b[r]
    return broken, near


@njit(cache=True)
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
        u[i] = v[i] - dot(loop.K[i], x)
        for c in range(p):
            du[i, c] = dv0[i, c]
        for j in range(len(x)):
            for c in range(p):
                du[i, c] -= loop.K[i, j] * dx[j, c] + dloop.K[i, j, c] * x[j]
