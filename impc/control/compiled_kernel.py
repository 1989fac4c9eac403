"""Compiled code: the constrained controller u = -K x + v_0, with derivatives.

v is zero while the gain satisfies all bounds, else the solution of the least-distance problem
(`compiled_dual`), which is checked before use. Notation and checks: docs/why/theory.md, section 4;
equations of the derivatives: `closed_loop`; the loop over samples: `compiled_loop`.
"""

from __future__ import annotations

import numpy as np

from impc.arrays import Buffer
from impc.control.compiled_dual import (
    CONVERGED,
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
from impc.control.compiled_values import (
    ACTIVE,
    FREE,
    INFEASIBLE,
    SOFTENED,
    TOO_SHORT,
    UNSOLVED,
    Aim,
    LoopMatrices,
    RowDirections,
    Rows,
    Workspace,
)
from impc.jit import inner, njit

#: Largest entry of plant and estimate, of states and of predictions.
LARGEST = 1e100
# Share of its bound within which a row is about to become active or inactive.
_WEAK = 1e-8
# A solution is accepted only if it satisfies every row, and determines the first input, to this
# share of the bound.
_CHECKED = 1e-9
# Rounding of a row at the solution, relative to the sum of the magnitudes of its terms.
_ROW_ROUNDING = 1e-14
# Rounding of v, relative to the same sum.
_SUM_ROUNDING = 1e-15


@njit(inline="always")
def dot(a: Buffer, b: Buffer) -> float:
    """Scalar product a'b (arrays of the same length)."""
    total = 0.0
    for i in range(len(a)):
        total += a[i] * b[i]
    return total


@njit(inline="always")
def copy(values: Buffer, to: Buffer) -> None:
    """Copy the first values to all of `to` (p,): `to[:] = ...` takes seconds to compile."""
    for c in range(len(to)):
        to[c] = values[c]


@njit(inline="always")
def add(share: float, changes: Buffer, total: Buffer) -> None:
    """Add share times `changes` (p,) to `total` (p,).

    Within a longer expression numba would take one number at a time: arrays might overlap.
    """
    for c in range(len(total)):
        total[c] += share * changes[c]


@njit(inline="always")
def deviate(
    aim: Aim, rows: Rows, drows: RowDirections, work: Workspace, t: int, x: Buffer, dx: Buffer
) -> None:
    """Convert a state `x` (n,) and `dx` (n, p) at sample t to deviations from the target."""
    if len(aim.x) == 0:
        return
    add(-1.0, aim.x[t], x)
    ahead = len(aim.taken) - len(aim.x)
    for r in range(len(work.right)):
        at, c = t + min(rows.stage[r], ahead), rows.family[r]
        work.right[r] = rows.b[r] - aim.taken[at, c] - aim.held[t, c]
        if len(aim.dx) and r < len(drows.b):
            for k in range(len(work.dright[r])):
                work.dright[r, k] = drows.b[r, k] - aim.dtaken[at, c, k] - aim.dheld[t, c, k]
    if len(aim.dx):
        for i in range(len(dx)):
            add(-1.0, aim.dx[t, i], dx[i])


@njit(inline="always")
def return_to(aim: Aim, t: int, u: Buffer, du: Buffer) -> None:
    """Add the target's command to `u` (m,) and `du` (m, p) of the deviation."""
    if len(aim.x):
        add(1.0, aim.u[t], u)
        if len(aim.dx):
            for i in range(len(du)):
                add(1.0, aim.du[t, i], du[i])


@njit(inline="always")
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
    """Write the input for one state, with its derivatives.

    `x` (n,); `dx` (n, p); `u` (m,); `du` (m, p).
    """
    v = work.v
    needs_qp, near = _look(work, rows.b, x)
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


@njit(inline="always")
def _look(work: Workspace, b: Buffer, x: Buffer) -> tuple[bool, bool]:
    """Write the slack of the gain; whether a row is violated, and whether one nearly is."""
    broken, near, slack, kept = False, False, work.slack, work.kept
    fill_slack(work, x)
    for r in range(len(slack)):
        broken |= not slack[r] >= -kept[r]
        near |= abs(slack[r]) < _WEAK * b[r]
    return broken, near


@njit(inline="always")
def fill_slack(work: Workspace, x: Buffer) -> None:
    """Compute slack = right - T x (T stored by columns)."""
    slack, T = work.slack, work.T
    slack[:] = 0.0
    for i in range(len(x)):
        for r in range(len(slack)):
            slack[r] += T[i, r] * x[i]
    for r in range(len(slack)):
        slack[r] = work.right[r] - slack[r]


@inner()
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
    """Write v and dv0 of one sample; return status, whether it is weakly active, and a row."""
    given = len(work.given_up) > 0
    if given:
        code, active = _given(rows, work, lam)
    else:
        code, active = solve_dual(
            rows.W,
            rows.reach,
            rows.gram,
            work.slack[: len(lam)],
            rows.limit,
            work.kept[: len(lam)],
            lam,
            work.free,
            work.factor,
            work.basis,
            work.worn,
            begin,
        )
    if code == INCONSISTENT:
        return INFEASIBLE, False, active
    if code == UNFINISHED:
        return UNSOLVED, False, -1
    work.active[0] = 0 if given else active
    status, near = answer(loop, dloop, rows, drows, unit, work, x, dx, lam, active)
    return status, near, -1


@njit(inline="always")
def _given(rows: Rows, work: Workspace, lam: Buffer) -> tuple[int, int]:
    """Multipliers `lam` (r,) of the active set in the workspace; status as of `solve_dual`."""
    tight, active = work.tight, len(work.tight)
    if active >= len(work.free):
        return UNFINISHED, 0
    for i in range(active):
        work.free[i] = tight[i]
        new = append_row(rows.W, rows.reach, work.free, tight[i], i, work.factor, work.basis)
        if not new > DEPENDENT * np.sqrt(rows.gram[tight[i], tight[i]]):
            return UNFINISHED, 0
        accept_row(i, new, work.factor, work.basis)
    for r in range(len(lam)):
        lam[r] = rows.limit[r] if work.given_up[r] else 0.0
    refine(rows.gram, work.slack, rows.limit, work.given_up, lam, work.free, active, work.factor)
    for i in range(active):
        if lam[tight[i]] > rows.limit[tight[i]]:
            return UNFINISHED, 0
    return CONVERGED, active


@njit(inline="always")
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
    """Compute u = -K x + v_0 and its derivative."""
    for i in range(len(u)):
        u[i] = v[i] - dot(loop.K[i], x)
        copy(dv0[i], du[i])
        for j in range(len(x)):
            add(-loop.K[i, j], dx[j], du[i])
            add(-x[j], dloop.K[i, j], du[i])


@njit(inline="always")
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
    """Write v and dv0 of `work` from the multipliers of one sample, if they are accurate.

    `unit` (m,); `x` (n,); `dx` (n, p); `lam` (r,).
    """
    _recover(rows, lam, work)
    for attempt in range(2):
        if attempt:
            _tighten(rows, work, active)
        soft, near, solved = _check(loop.K, rows, lam, work, active, x, unit)
        if solved:
            break
    if not solved:
        return UNSOLVED, False
    if len(lam) < len(work.slack) and not _keeps_later(work, len(lam), rows.b):
        return TOO_SHORT, False
    if dx.shape[1]:
        _differentiate(loop, dloop, rows, drows, lam, work, active, x, dx)
    return (SOFTENED if soft else ACTIVE), near


@njit(inline="always")
def _keeps_later(work: Workspace, head: int, b: Buffer) -> bool:
    """Whether v satisfies the rows behind the first `head`, none of them nearly active."""
    lefts = work.slack[head:].copy()
    for i in range(len(work.v)):
        if work.v[i] != 0.0:
            add(-work.v[i], work.M[i, head:], lefts)
    kept = True
    for r in range(len(lefts)):
        kept &= lefts[r] > _WEAK * b[head + r]
    return kept


@njit(inline="always")
def _recover(rows: Rows, lam: Buffer, work: Workspace) -> None:
    """Compute v = -N' lam and its rounding error."""
    v, rounding = work.v, work.rounding
    v[:] = 0.0
    rounding[:] = 0.0
    for r in range(len(lam)):
        if lam[r] != 0.0:
            N, pull = rows.N[r], lam[r]
            for i in range(rows.reach[r]):
                part = pull * N[i]
                v[i] -= part
                rounding[i] += _SUM_ROUNDING * abs(part)


@njit(inline="always")
def _tighten(rows: Rows, work: Workspace, active: int) -> None:
    """Correct v so that the tight rows are tight.

    The penalty of a soft row is 1e6 and more: v has lost as many digits.
    """
    slack, free, v = work.slack, work.free, work.v
    column = np.empty(active)
    for a in range(active):
        column[a] = slack[free[a]] - dot(rows.M[free[a]], v)
    substitute(work.factor, active, column)
    for a in range(active):
        for i in range(rows.reach[free[a]]):
            v[i] += column[a] * rows.N[free[a], i]


@njit(inline="always")
def _check(
    K: Buffer, rows: Rows, lam: Buffer, work: Workspace, active: int, x: Buffer, unit: Buffer
) -> tuple[bool, bool, bool]:
    """Return whether a soft row is violated, a row is weakly active, and v is accepted.

    It is accepted if every row is satisfied, every multiplier has its sign, and rounding moves the
    first v by no more than a share of the bound, according to the derivative of v with respect to
    the right sides of the tight rows (docs/why/theory.md, section 4).
    """
    soft, near, m = False, False, len(unit)
    slack, free, factor, v = work.slack, work.free, work.factor, work.v
    wrong, lefts, sizes = np.empty(len(lam)), slack[: len(lam)].copy(), rows.b[: len(lam)].copy()
    for i in range(len(x)):
        T, at = work.T[i], x[i]
        for r in range(len(lam)):
            sizes[r] += abs(T[r] * at)
    for i in range(len(v)):
        if v[i] == 0.0:  # beyond the last active stage
            continue
        first = work.first[i]
        M, left_i, size_i = work.M[i, first : len(lam)], lefts[first:], sizes[first:]
        move = v[i]
        for r in range(len(M)):
            part = M[r] * move
            left_i[r] -= part
            size_i[r] += abs(part)
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
        # A multiplier moves v by lam N: weak if that is negligible relative to the row's bound.
        near |= abs(left) < _WEAK * bound and pulled < _WEAK * bound
    columns, moved = np.empty((active, m)), np.empty(len(v))
    for a in range(active):
        copy(rows.N[free[a]], columns[a])
    substitute_all(factor, active, columns)
    for i in range(m):
        error, size = 0.0, 0.0
        moved[:] = 0.0
        moved[i] = 1.0
        for a in range(active):
            error += abs(columns[a, i]) * wrong[free[a]]
            line, share = rows.M[free[a]], columns[a, i]
            for k in range(rows.reach[free[a]]):
                moved[k] -= line[k] * share
        for k in range(len(v)):
            error += abs(moved[k]) * work.rounding[k]
        for j in range(len(x)):
            size += abs(K[i, j] * x[j])
        if not error <= _CHECKED * min(unit[i], abs(v[i]) + size):
            return soft, near, False
    return soft, near, True


@njit(inline="always")
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
    """Write the derivative of the first v (equations in `closed_loop`)."""
    v, free, dv0 = work.v, work.free, work.dv0
    width, p = len(v), dx.shape[1]
    m, n = dv0.shape[0], len(x)
    q, dlam = np.zeros((width, p)), np.empty((active, p))
    for i in range(width):
        for j in range(m):
            add(v[i - i % m + j], dloop.S[i % len(dloop.S), j], q[i])
    _add_pulls(rows, drows, lam, q)
    for a in range(active):
        r, change = free[a], dlam[a]
        change[:] = 0.0
        add(-1.0, work.dright[r], change)
        for i in range(n):
            add(x[i], drows.T[r, i], change)
            add(rows.T[r, i], dx[i], change)
        for i in range(rows.reach[r]):
            add(v[i], drows.M[r, i], change)
            add(-rows.N[r, i], q[i], change)
    substitute_all(work.factor, active, dlam)
    for i in range(m):
        for j in range(m):
            add(-loop.S[i, j], q[j], dv0[i])
        for a in range(active):
            add(-rows.N[free[a], i], dlam[a], dv0[i])


@njit(inline="always")
def _add_pulls(rows: Rows, drows: RowDirections, lam: Buffer, q: Buffer) -> None:
    """Add dM' lam to q, and the effect of the penalty of soft rows."""
    for r in range(len(lam)):
        if lam[r] != 0.0:
            for i in range(rows.reach[r]):
                add(lam[r], drows.M[r, i], q[i])
            if lam[r] == rows.limit[r]:
                # The penalty of a soft row is penalty / b: it depends on the bound.
                for i in range(rows.reach[r]):
                    add(-rows.M[r, i] * lam[r] / rows.b[r], drows.b[r], q[i])
