"""Compiled code: the inputs ahead from the multipliers of their rows, checked, with derivatives.

The multipliers are those of `compiled_dual`, or of rows that another solver has found to be tight.
What is asked of an answer is in docs/theory.md, section 4; `closed_loop` has the equations of the
derivative.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Buffer
from impc.control.compiled_arrays import ACTIVE, SOFTENED, UNSOLVED, LoopMatrices, Workspace
from impc.control.compiled_dual import substitute, substitute_all
from impc.control.compiled_products import dot
from impc.jit import njit

if TYPE_CHECKING:
    from impc.control.constraint_rows import RowDirections, Rows

__all__ = ["COMPILED_WITH", "WEAK", "answer"]

#: First digits of the SHA-256 of each file whose functions are called: numba's cache does not look.
COMPILED_WITH = {
    "compiled_arrays": "f9299fe715d0d2a3",
    "compiled_dual": "c3376c1c32aa9492",
    "compiled_products": "50101205237e0db3",
}
#: Share of its bound within which a row is about to become active, or to become free.
WEAK = 1e-8
# The answer must keep every row, and tell the first input, to this share of the bound, whatever the
# multipliers are, or it is not given out.
_CHECKED = 1e-9
# Rounding of a row at the answer, relative to the sum of the magnitudes of its terms.
_ROW_ROUNDING = 1e-14
# Rounding of v, relative to the same.
_SUM_ROUNDING = 1e-15


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
    """Write v and dv0 of `work` from the multipliers of one sample, where they tell the input.

    `unit` (m,); `x` (n,); `dx` (n, p); `lam` (r,).
    """
    _recover(rows, lam, work)
    soft, near, told = _check(loop.K, rows, lam, work, active, x, unit)
    if not told:
        _tighten(rows, work, active)
        soft, near, told = _check(loop.K, rows, lam, work, active, x, unit)
    if not told:
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

    The price of a soft row is a million and more: what is left of v has lost as many digits.
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
    """Whether a soft row was given up, a row is tight without a multiplier, the answer is told.

    It is told when every row is kept, and every multiplier has its sign, to a share of the bound
    that no multiplier enters, and when that and rounding move the first v by no more: by the
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
            soft |= left < -WEAK * bound
            broken = left > _CHECKED * bound
        else:
            broken = not left > -_CHECKED * bound or pulled < -_CHECKED * bound
        if broken:
            return soft, near, False
        # A multiplier moves v by lam N: weak when that is nothing beside the row's bound.
        near |= abs(left) < WEAK * bound and pulled < WEAK * bound
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
                q[i, c] += dloop.S[i % m, j, c] * v[i - i % m + j]
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
    """Add dM' lam to q, and what the price of soft rows does."""
    for r in range(len(lam)):
        if lam[r] != 0.0:
            for i in range(_reach(rows, r, m)):
                for c in range(q.shape[1]):
                    q[i, c] += lam[r] * drows.M[r, i, c]
            if lam[r] == rows.limit[r]:
                # The price of a soft row is penalty / b: it moves with the bound.
                for i in range(len(q)):
                    for c in range(q.shape[1]):
                        q[i, c] -= rows.M[r, i] * lam[r] / rows.b[r] * drows.b[r, c]
