"""Compiled code: the least-distance problem, and the closed loop over samples around it.

One file, because numba's cache on disk looks at the file of a function and not at those that it
calls: with the two apart, a changed solver went on running as it was compiled before.

The least-distance problem (docs/theory.md, section 4), by a dual active-set method:

    minimise  v'S v / 2 + sum_r limit_r s_r     subject to  M v <= d + s,  s >= 0

(hard rows have limit = inf and no s). Its dual is a bounded least-squares problem in one
multiplier a row,

    minimise  lam' G lam / 2 + d' lam   subject to  0 <= lam <= limit,   G = M S^-1 M',

with v = -S^-1 M' lam; the gradient d + G lam is the slack of the rows. The method is that of
Goldfarb and Idnani (Math. Programming 27, 1983): start at v = 0, the answer without bounds, and
raise the multiplier of the most violated row while the rows already active stay tight. A
multiplier that would leave [0, limit] blocks the step; at its limit the row is given up softly. An
unblocked step along which the slack of the violated row does not change proves the rows
inconsistent.

The loop over samples is that of `closed_loop`, which has its mathematics. Where the body that moves
is not linear, its operations are run one after the other (`compiled_body`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from impc.arrays import Buffer
from impc.borrowed import borrowed
from impc.control.compiled_body import BodyTape, move_body
from impc.control.constraint_rows import RowDirections, Rows
from impc.jit import njit

__all__ = [
    "COMPILED_WITH",
    "CONVERGED",
    "DIVERGED",
    "INCONSISTENT",
    "LARGEST",
    "SOFTENED",
    "UNSOLVED",
    "LoopMatrices",
    "Workspace",
    "answer_with",
    "law",
    "run",
    "solve_dual",
    "substitute_all",
    "workspace",
]

#: First digits of the SHA-256 of each file whose functions are called: numba's cache does not look.
COMPILED_WITH = {"borrowed": "f9ef79e3bd6dacdb", "compiled_body": "7e4e5b9a21a8d467"}
#: What `solve_dual` says first: an answer, rows that exclude each other, none within its steps.
CONVERGED, INCONSISTENT, UNSOLVED = 0, 1, 2

# A row is dependent on the active ones when less than this share of its length is new. The part is
# computed by orthogonalising twice, which leaves rounding of 1e-16; genuine neighbours in the
# terminal sets of tests/ differ by 1e-5 and more.
_DEPENDENT = 1e-9
# The answer must keep every row, and tell the first input, to this share of the bound, whatever the
# multipliers are, or it is not given out.
_CHECKED = 1e-9
# Rounding of a row at the answer, relative to the sum of the magnitudes of its terms.
_ROW_ROUNDING = 1e-14
# Rounding of v, relative to the same.
_SUM_ROUNDING = 1e-15
# Rounding of a slack, relative to the largest term in it. It matters where soft rows are given up:
# their multipliers are the penalty, a million and more.
_ROUNDING = 1e-14


@njit(cache=True)
def substitute(factor: Buffer, count: int, right: Buffer) -> None:
    """Solve L L' x = right in place for the leading count x count lower factor L."""
    for i in range(count):
        total = right[i]
        for k in range(i):
            total -= factor[i, k] * right[k]
        right[i] = total / factor[i, i]
    for i in range(count - 1, -1, -1):
        total = right[i]
        for k in range(i + 1, count):
            total -= factor[k, i] * right[k]
        right[i] = total / factor[i, i]


@njit(cache=True)
def _append_row(whitened: Buffer, row: int, count: int, factor: Buffer, basis: Buffer) -> float:
    """Write the coefficients of a row in the basis of the active ones; return what is new of it.

    The new part itself goes to basis[count], not normalised. Working with the rows instead of their
    Gram matrix keeps twice as many digits of it.
    """
    width = whitened.shape[1]
    new = basis[count]
    new[:] = whitened[row]
    for i in range(count):
        factor[count, i] = 0.0
    for _ in range(2):
        for i in range(count):
            part = 0.0
            for k in range(width):
                part += basis[i, k] * new[k]
            factor[count, i] += part
            for k in range(width):
                new[k] -= part * basis[i, k]
    length = 0.0
    for k in range(width):
        length += new[k] ** 2
    return np.sqrt(length)  # type: ignore[no-any-return]


@njit(cache=True)
def _accept_row(count: int, length: float, factor: Buffer, basis: Buffer) -> None:
    factor[count, count] = length
    for k in range(basis.shape[1]):
        basis[count, k] /= length


@njit(cache=True)
def solve_dual(
    whitened: Buffer,
    gram: Buffer,
    d: Buffer,
    limit: Buffer,
    tolerance: Buffer,
    lam: Buffer,
    free: Buffer,
    factor: Buffer,
    basis: Buffer,
    begin: int,
) -> tuple[int, int]:
    """Solve the dual, from the free rows of a problem with the same rows and another slack.

    Parameters
    ----------
    whitened, gram : Buffer
        W = M L^-T with S = L L', (r, N m), and W W', (r, r).
    d, limit, tolerance : Buffer
        Slack of the rows at v = 0, upper limits, and the violation below which a row counts as
        kept, (r,) each.
    lam, free, factor, basis : Buffer
        Written: multipliers (r,), the rows with 0 < lam < limit in the order of the factor, and
        the lower factor of their Gram matrix. Sizes r, a + 1, (a + 1, a + 1) and (a + 1, N m) with
        a = min(r, N m).
    begin : int
        How many rows of `free` it begins with, whose factor is there; with 0, from lam = 0.

    Returns
    -------
    status, count : int
        CONVERGED and the number of free rows, an answer to be checked; INCONSISTENT and the row at
        which it was found, with the combination of rows that should prove it in `lam`; UNSOLVED.
    """
    rows = len(d)
    slack, change, lengths = d.copy(), np.empty(len(d)), np.empty(len(d))
    for r in range(rows):
        lengths[r] = np.sqrt(gram[r, r])
    at_limit = np.zeros(rows, dtype=np.bool_)
    is_free = np.zeros(rows, dtype=np.bool_)
    step = np.empty(len(free))
    lam[:] = 0.0
    count = _begun(whitened, d, limit, lam, free, factor, basis, begin)
    for i in range(count):
        is_free[free[i]] = True
        for r in range(rows):
            slack[r] += gram[free[i], r] * lam[free[i]]
    for _ in range(50 * (rows + 10)):
        row, worst = -1, 0.0
        noise = _ROUNDING * _largest_pull(lengths, lam)
        for r in range(rows):
            if is_free[r]:
                continue
            wrong = slack[r] if at_limit[r] else -slack[r]
            if wrong > tolerance[r] + noise * lengths[r]:
                # Distance of v to the row, so that the choice does not depend on its scale.
                distance = wrong / lengths[r] if lengths[r] > 0 else np.inf
                if distance > worst:
                    row, worst = r, distance
        if row < 0:
            _refine(gram, d, limit, at_limit, lam, free, count, factor)
            return CONVERGED, count
        sign = -1.0 if at_limit[row] else 1.0
        while True:
            new = _append_row(whitened, row, count, factor, basis)
            for i in range(count - 1, -1, -1):
                part = factor[count, i]
                for k in range(i + 1, count):
                    part -= factor[k, i] * step[k]
                step[i] = part / factor[i, i]
            length = np.inf
            if new > _DEPENDENT * lengths[row]:
                length = -sign * slack[row] / new**2
            blocked = -1
            room = lam[row] if sign < 0 else limit[row] - lam[row]
            if room <= length:
                length, blocked = room, count
            for i in range(count):
                rate = -sign * step[i]
                if rate < 0:
                    room = lam[free[i]] / -rate
                elif rate > 0:
                    room = (limit[free[i]] - lam[free[i]]) / rate
                else:
                    continue
                if room < length:
                    length, blocked = room, i
            if length == np.inf:
                lam[:] = 0.0
                lam[row] = 1.0
                for i in range(count):
                    lam[free[i]] = -step[i]
                return INCONSISTENT, row
            lam[row] += sign * length
            # Row after row of the symmetric matrix, because memory is read in that order.
            change[:] = gram[row]
            for i in range(count):
                for r in range(rows):
                    change[r] -= gram[free[i], r] * step[i]
            for r in range(rows):
                slack[r] += sign * length * change[r]
            for i in range(count):
                lam[free[i]] -= sign * length * step[i]
            if blocked < 0:
                _accept_row(count, new, factor, basis)
                free[count] = row
                is_free[row], at_limit[row] = True, False
                count += 1
                break
            if blocked == count:
                at_limit[row] = sign > 0
                lam[row] = limit[row] if sign > 0 else 0.0
                break
            leaving = free[blocked]
            is_free[leaving] = False
            at_limit[leaving] = -sign * step[blocked] > 0
            lam[leaving] = limit[leaving] if at_limit[leaving] else 0.0
            count = _remove(whitened, free, count, blocked, factor, basis)
    return UNSOLVED, count


@njit(cache=True)
def _begun(
    whitened: Buffer,
    d: Buffer,
    limit: Buffer,
    lam: Buffer,
    free: Buffer,
    factor: Buffer,
    basis: Buffer,
    count: int,
) -> int:
    """Write the multipliers with which some rows are tight; return how many rows are left.

    Rows whose multiplier is not positive are dropped, the most negative first: what is left is the
    answer to a problem that has these rows only, from which the dual method may go on.
    """
    right = np.empty(count)
    while count > 0:
        for i in range(count):
            right[i] = -d[free[i]]
        substitute(factor, count, right)
        place, worst = -1, np.inf
        for i in range(count):
            if not right[i] <= limit[free[i]]:  # nor where the slack is no number
                return 0
            if right[i] < worst:
                place, worst = i, right[i]
        if worst > 0.0:
            for i in range(count):
                lam[free[i]] = right[i]
            return count
        count = _remove(whitened, free, count, place, factor, basis)
    return 0


@njit(cache=True)
def _largest_pull(lengths: Buffer, lam: Buffer) -> float:
    """Largest multiplier times the length of its row."""
    largest = 0.0
    for r in range(len(lam)):
        largest = max(largest, abs(lam[r]) * lengths[r])
    return largest


@njit(cache=True)
def _remove(
    whitened: Buffer, free: Buffer, count: int, place: int, factor: Buffer, basis: Buffer
) -> int:
    """Drop the free row at `place` and factor the rows behind it again."""
    for i in range(place, count - 1):
        free[i] = free[i + 1]
        _accept_row(i, _append_row(whitened, free[i], i, factor, basis), factor, basis)
    return count - 1


@njit(cache=True)
def _refine(
    gram: Buffer,
    d: Buffer,
    limit: Buffer,
    at_limit: Buffer,
    lam: Buffer,
    free: Buffer,
    count: int,
    factor: Buffer,
) -> None:
    """Solve once more for the final active set, so that the steps leave no rounding behind."""
    right = np.empty(count)
    for i in range(count):
        total = -d[free[i]]
        for r in range(len(d)):
            if at_limit[r]:
                total -= gram[free[i], r] * limit[r]
        right[i] = total
    substitute(factor, count, right)
    for i in range(count):
        lam[free[i]] = right[i]


# A row is kept when it is exceeded by less than this share of its bound: a hundred times the
# rounding of T x + M v, so that the quadratic program is never entered for rounding alone.
_KEPT = 1e-13
_WEAK = 1e-8

#: Of `closed_loop.Status`, by which what is compiled says how a sample ended.
_FREE, _ACTIVE, SOFTENED, _INFEASIBLE, _UNSOLVED, DIVERGED = 0, 1, 2, 3, 4, 5
#: No entry of plant and estimate together goes beyond this: neither a state nor what is expected.
LARGEST = 1e100


class LoopMatrices(NamedTuple):
    """Plant, gain and inverse metric; or derivatives (those of S itself) along p directions.

    Attributes
    ----------
    A, B, E : Buffer
        (n, n), (n, m) and (n, d); derivatives have a last axis more, (n, n, p) and so on.
    K : Buffer
        (m, n), derivatives (m, n, p).
    S : Buffer
        S^-1 (m, m); derivatives are those of S, (m, m, p).
    """

    A: Buffer
    B: Buffer
    E: Buffer
    K: Buffer
    S: Buffer


class Workspace(NamedTuple):
    """Arrays that one sample after the other uses.

    Attributes
    ----------
    slack, kept, free : Buffer
        Of the rows (r,), the violation of each that counts as kept (r,), the free rows (a + 1,).
    factor, basis : Buffer
        As in `solve_dual`, (a + 1, a + 1) and (a + 1, N m).
    v, rounding : Buffer
        Inputs ahead beside the gain's, and what rounding makes of them (N m,).
    dv0 : Buffer
        Derivatives of the first of them (m, p).
    T, M : Buffer
        Columns of the rows, one after the other: (n, r) and (N m, r).
    active : Buffer
        How many rows are free at the last sample (1,). The problem of the next one begins with
        them, for its plan is much like that of the one before.
    """

    slack: Buffer
    kept: Buffer
    free: Buffer
    factor: Buffer
    basis: Buffer
    v: Buffer
    rounding: Buffer
    dv0: Buffer
    T: Buffer
    M: Buffer
    active: Buffer


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

    Parameters
    ----------
    dloop, drows : LoopMatrices, RowDirections
        Derivatives of the loop and of its rows.
    body : BodyTape
        What moves, unless it is empty.
    pushes : Buffer
        What its parameters add to each derivative, (steps, n, p), or nothing, (0, n, p).
    disturbance : Buffer
        (steps, d).
    divergence : float
        Entry of a state, in its unit, at which the simulation ends.
    unit : Buffer
        What the error of each input is measured by (m,): its nearer bound.
    work : Workspace
        For the rows.
    first : int
        Where to begin. When `status` has an answer there, u and du have it too.
    x, u : Buffer
        Written: states (steps + 1, n) after the first, inputs (steps, m).
    dx, du : Buffer
        Written: their derivatives (steps + 1, n, p) after the first, (steps, m, p).
    status : Buffer
        Written up to the sample that ends it: the value of `closed_loop.Status`, (steps,).
    lam : Buffer
        Written: the multipliers of the last problem (r,), or the combination of rows that should
        prove it inconsistent.
    gain_only : bool
        Whether to end, UNSOLVED, at the first sample where the gain breaks a bound.
    local : bool
        Whether every sample has the directions dx[0] in place of what came of them: du is then the
        derivative of each input with respect to its own state and to what is common to all.

    Returns
    -------
    weak, row : int
        Number of samples at which the active set is about to change; the row that proved the last
        problem inconsistent, or -1.
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
        if len(body.code):
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

    Parameters
    ----------
    loop, dloop, rows, drows, unit, lam, gain_only
        As in `run`; unit (m,) and lam (r,).
    work : Workspace
        Its multipliers and active rows are those of this state afterwards.
    x, dx : Buffer
        State (n,) and its derivatives (n, p).
    u, du : Buffer
        Written: input (m,) and its derivatives (m, p).

    Returns
    -------
    status, near, row : int, bool, int
        Whether the gain keeps every bound, a bound is active, and so on; whether the active set is
        about to change; the row that proved the problem inconsistent, or -1.
    """
    v = work.v
    needs_qp, near = _look(work.T, rows.b, work.kept, x, work.slack)
    v[: len(u)] = 0.0
    work.dv0[:] = 0.0
    begin, work.active[0] = work.active[0], 0
    if needs_qp:
        if gain_only:
            return _UNSOLVED, False, -1
        status, near, row = _solve(loop, dloop, rows, drows, unit, work, x, dx, lam, begin)
        if status > SOFTENED:
            return status, near, row
    else:
        status = _FREE
    _apply(loop, dloop, v, work.dv0, x, dx, u, du)
    return status, near, -1


@njit(cache=True)
def _look(T: Buffer, b: Buffer, kept: Buffer, x: Buffer, slack: Buffer) -> tuple[bool, bool]:
    """Write the slack of the gain; whether a row is broken, and whether one is about to be."""
    broken, near = False, False
    _fill_slack(T, b, x, slack)
    for r in range(len(slack)):
        broken |= not slack[r] >= -kept[r]
        near |= abs(slack[r]) < _WEAK * b[r]
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
    slack, free, factor = work.slack, work.free, work.factor
    code, active = solve_dual(
        rows.W,
        rows.gram,
        slack,
        rows.limit,
        work.kept,
        lam,
        free,
        factor,
        work.basis,
        begin,
    )
    if code == INCONSISTENT:
        return _INFEASIBLE, False, active
    if code == UNSOLVED:
        return _UNSOLVED, False, -1
    work.active[0] = active
    status, near = _answer(loop, dloop, rows, drows, unit, work, x, dx, lam, active)
    return status, near, -1


@njit(cache=True)
def _answer(
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
    """Write v and dv0 from the multipliers; return the status and whether the rows are weak."""
    _recover(rows, lam, work)
    soft, near, told = _check(loop.K, rows, lam, work, active, x, unit)
    if not told:
        _tighten(rows, work, active)
        soft, near, told = _check(loop.K, rows, lam, work, active, x, unit)
    if not told:
        return _UNSOLVED, False
    if dx.shape[1]:
        _differentiate(loop, dloop, rows, drows, lam, work, active, x, dx)
    return (SOFTENED if soft else _ACTIVE), near


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

    Parameters
    ----------
    loop, dloop : LoopMatrices
        Of the loop and its derivatives, as in `run`.
    rows, drows : Rows, RowDirections
        Likewise.
    unit : Buffer
        What the error of each input is measured by (m,).
    x, dx : Buffer
        State (n,) and its derivative (n, p).
    tight : Buffer
        Rows that hold with equality, linearly independent, (a,).
    given_up : Buffer of bool
        Soft rows that are exceeded (r,).
    u, du, lam, v : Buffer
        Written: input (m,) and its derivative (m, p), multipliers (r,), all of v (N m,).

    Returns
    -------
    status, weak : int, bool
        ACTIVE or SOFTENED when the answer keeps what `_check` asks for, UNSOLVED otherwise.
    """
    work, active = workspace(rows, du.shape[0], du.shape[1]), len(tight)
    if active >= len(work.free):
        return _UNSOLVED, False
    _fill_slack(work.T, rows.b, x, work.slack)
    for i in range(active):
        work.free[i] = tight[i]
        new = _append_row(rows.W, tight[i], i, work.factor, work.basis)
        if not new > _DEPENDENT * np.sqrt(rows.gram[tight[i], tight[i]]):
            return _UNSOLVED, False
        _accept_row(i, new, work.factor, work.basis)
    for r in range(len(lam)):
        lam[r] = rows.limit[r] if given_up[r] else 0.0
    _refine(rows.gram, work.slack, rows.limit, given_up, lam, work.free, active, work.factor)
    for i in range(active):
        if lam[tight[i]] > rows.limit[tight[i]]:
            return _UNSOLVED, False
    status, near = _answer(loop, dloop, rows, drows, unit, work, x, dx, lam, active)
    v[:] = work.v
    if status != _UNSOLVED:
        _apply(loop, dloop, work.v, work.dv0, x, dx, u, du)
    return status, near


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
        column[a] = slack[free[a]] - _dot(rows.M[free[a]], v)
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


@njit(cache=True)
def substitute_all(factor: Buffer, count: int, right: Buffer) -> None:
    """`substitute` for every column of `right` (count, c) at once, with the `factor` (a, a)."""
    for i in range(count):
        for k in range(i):
            for c in range(right.shape[1]):
                right[i, c] -= factor[i, k] * right[k, c]
        for c in range(right.shape[1]):
            right[i, c] /= factor[i, i]
    for i in range(count - 1, -1, -1):
        for k in range(i + 1, count):
            for c in range(right.shape[1]):
                right[i, c] -= factor[k, i] * right[k, c]
        for c in range(right.shape[1]):
            right[i, c] /= factor[i, i]


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
