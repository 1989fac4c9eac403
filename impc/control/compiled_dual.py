"""Compiled code: dual active-set method for the least-distance problem.

The problem of docs/why/theory.md, section 4,

    minimise  v'S v / 2 + sum_r limit_r s_r     subject to  M v <= d + s,  s >= 0

(hard rows have limit = inf and no s) has the dual

    minimise  lam' G lam / 2 + d' lam   subject to  0 <= lam <= limit,   G = M S^-1 M',

with one multiplier per row and v = -S^-1 M' lam; the gradient d + G lam is the slack of the rows.
Method of Goldfarb and Idnani (Math. Programming 27, 1983): start at v = 0, the solution without
bounds, and raise the multiplier of the most violated row while the active rows stay tight. A
multiplier that would leave [0, limit] blocks the step; at its limit the row is relaxed. An
unblocked step along which the slack of the violated row does not change proves the rows
inconsistent.
"""

from __future__ import annotations

import numpy as np

from impc.arrays import Buffer
from impc.jit import inner, njit

#: Status of `solve_dual`: solution found, rows proved inconsistent, step limit reached.
CONVERGED, INCONSISTENT, UNFINISHED = 0, 1, 2
#: A row depends on the active ones if less than this share of its length is new. The new part is
#: orthogonalised twice, which leaves rounding of 1e-16; neighbouring rows in the terminal sets of
#: tests/ differ by 1e-5 and more.
DEPENDENT = 1e-9
# The factor is computed anew from its rows after this many removals, whose rotations add rounding.
_WORN = 20
# Rounding of a slack relative to its largest term; relevant for relaxed rows, whose multipliers are
# the penalty, 1e6 and more.
_ROUNDING = 1e-14


@njit(inline="always")
def solve_dual(
    whitened: Buffer,
    reach: Buffer,
    gram: Buffer,
    d: Buffer,
    limit: Buffer,
    tolerance: Buffer,
    lam: Buffer,
    free: Buffer,
    factor: Buffer,
    basis: Buffer,
    worn: Buffer,
    begin: int,
) -> tuple[int, int]:
    """Solve the dual, starting from the free rows of a problem with the same rows.

    `whitened` W = M L^-T (r, N m), S = L L', of which the first `reach` (r,) columns can be
    nonzero; `gram` W W' (r, r); `d`, `limit`, `tolerance` (r,).
    Written: `lam` (r,), the rows with 0 < lam < limit in `free` (a + 1,), the lower `factor` of
    their Gram matrix (a + 1, a + 1) and their `basis` (a + 1, N m), a = min(r, N m); in `worn`
    (1,) the removals since this factor was computed. On entry `begin` rows of `free` are present
    with their factor. Returns a status, and the number of free
    rows or the inconsistent row, with the combination of rows that should prove it in `lam`.
    """
    rows = len(d)
    slack, change, lengths = d.copy(), np.empty(len(d)), np.empty(len(d))
    for r in range(rows):
        lengths[r] = np.sqrt(gram[r, r])
    at_limit = np.zeros(rows, dtype=np.bool_)
    is_free = np.zeros(rows, dtype=np.bool_)
    step = np.empty(len(free))
    lam[:] = 0.0
    count = _begun(whitened, reach, d, limit, lam, free, factor, basis, worn, begin)
    for i in range(count):
        is_free[free[i]] = True
        line, pull = gram[free[i]], lam[free[i]]
        for r in range(rows):
            slack[r] += line[r] * pull
    for _ in range(50 * (rows + 10)):
        row, worst = rows, 0.0
        noise = _ROUNDING * _largest_pull(lengths, lam)
        for r in range(rows):
            if is_free[r]:
                continue
            wrong = slack[r] if at_limit[r] else -slack[r]
            if wrong > tolerance[r] + noise * lengths[r]:
                # Distance of v to the row, so that the choice is independent of its scale.
                distance = wrong / lengths[r] if lengths[r] > 0 else np.inf
                if distance > worst:
                    row, worst = r, distance
        if row == rows:
            refine(gram, d, limit, at_limit, lam, free, count, factor)
            return CONVERGED, count
        sign = -1.0 if at_limit[row] else 1.0
        while True:
            new = append_row(whitened, reach, free, row, count, factor, basis)
            for i in range(count - 1, -1, -1):
                part = factor[count, i]
                for k in range(i + 1, count):
                    part -= factor[k, i] * step[k]
                step[i] = part / factor[i, i]
            length = np.inf
            if new > DEPENDENT * lengths[row]:
                length = -sign * slack[row] / new**2
            blocked = rows
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
            # Row by row of the symmetric matrix, the order of memory.
            for r in range(rows):
                change[r] = gram[row, r]
            for i in range(count):
                line, share = gram[free[i]], step[i]
                for r in range(rows):
                    change[r] -= line[r] * share
            for r in range(rows):
                slack[r] += sign * length * change[r]
            for i in range(count):
                lam[free[i]] -= sign * length * step[i]
            if blocked == rows:
                accept_row(count, new, factor, basis)
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
            count = _remove(reach, free, count, blocked, factor, basis, worn)
    return UNFINISHED, count


@njit(inline="always")
def _begun(
    whitened: Buffer,
    reach: Buffer,
    d: Buffer,
    limit: Buffer,
    lam: Buffer,
    free: Buffer,
    factor: Buffer,
    basis: Buffer,
    worn: Buffer,
    count: int,
) -> int:
    """Write the multipliers with which some rows are tight; return how many rows remain.

    Rows without a positive multiplier are dropped, the most negative first: the remaining rows
    solve a problem with only these rows, from which the dual method may continue.
    """
    right = np.empty(count)
    if count == 0 or worn[0] > _WORN:
        worn[0] = 0
        for i in range(count):
            accept_row(
                i, append_row(whitened, reach, free, free[i], i, factor, basis), factor, basis
            )
    while count > 0:
        for i in range(count):
            right[i] = -d[free[i]]
        substitute(factor, count, right)
        place, worst = count, np.inf
        for i in range(count):
            if not right[i] <= limit[free[i]]:  # also false for NaN
                return 0
            if right[i] < worst:
                place, worst = i, right[i]
        if worst > 0.0:
            for i in range(count):
                lam[free[i]] = right[i]
            return count
        count = _remove(reach, free, count, place, factor, basis, worn)
    return 0


@njit(inline="always")
def _largest_pull(lengths: Buffer, lam: Buffer) -> float:
    """Largest multiplier times the length of its row."""
    largest = 0.0
    for r in range(len(lam)):
        largest = max(largest, abs(lam[r]) * lengths[r])
    return largest


@inner()
def _remove(
    reach: Buffer, free: Buffer, count: int, place: int, factor: Buffer, basis: Buffer, worn: Buffer
) -> int:
    """Drop the free row at `place`; Givens rotations make the factor lower triangular again."""
    width = furthest(reach, free, count)
    for i in range(place, count - 1):
        free[i] = free[i + 1]
        for k in range(i + 2):
            factor[i, k] = factor[i + 1, k]
    for i in range(place, count - 1):
        length = np.hypot(factor[i, i], factor[i, i + 1])
        cosine, sine = factor[i, i] / length, factor[i, i + 1] / length
        for k in range(i, count - 1):
            left, right = factor[k, i], factor[k, i + 1]
            factor[k, i] = cosine * left + sine * right
            factor[k, i + 1] = cosine * right - sine * left
        one, two = basis[i], basis[i + 1]
        for k in range(width):
            one[k], two[k] = cosine * one[k] + sine * two[k], cosine * two[k] - sine * one[k]
    worn[0] += 1
    return count - 1


@inner()
def refine(
    gram: Buffer,
    d: Buffer,
    limit: Buffer,
    at_limit: Buffer,
    lam: Buffer,
    free: Buffer,
    count: int,
    factor: Buffer,
) -> None:
    """Solve once more for the final active set, to remove accumulated rounding.

    `gram` (r, r); `d, limit` (r,); `at_limit` (r,); `lam` (r,); `free` (a + 1,); `factor` (a
    + 1, a + 1).
    """
    right = np.empty(count)
    for i in range(count):
        right[i] = -d[free[i]]
    for r in range(len(d)):
        if at_limit[r]:
            for i in range(count):
                right[i] -= gram[r, free[i]] * limit[r]
    substitute(factor, count, right)
    for i in range(count):
        lam[free[i]] = right[i]


@inner(fastmath={"reassoc"})  # sums in the order of the processor
def append_row(
    whitened: Buffer,
    reach: Buffer,
    free: Buffer,
    row: int,
    count: int,
    factor: Buffer,
    basis: Buffer,
) -> float:
    """Write the coefficients of a row in the basis of the active ones; return the new length.

    The new part goes to basis[count], not normalised. Using rows instead of their Gram matrix keeps
    twice as many digits of it.

    `whitened` (r, N m); `reach` (r,); `free` (a + 1,); `factor` (a + 1, a + 1); `basis`
    (a + 1, N m).
    """
    width = max(reach[row], furthest(reach, free, count))
    new = basis[count]
    for k in range(len(new)):
        new[k] = whitened[row, k]
    for i in range(count):
        factor[count, i] = 0.0
    for _ in range(2):
        for i in range(count):
            part = 0.0
            for k in range(width):
                part += basis[i, k] * new[k]
            factor[count, i] += part
            one = basis[i]
            for k in range(width):
                new[k] -= part * one[k]
    length = 0.0
    for k in range(width):
        length += new[k] ** 2
    return np.sqrt(length)  # type: ignore[no-any-return]


@inner()
def furthest(reach: Buffer, free: Buffer, count: int) -> int:
    """Largest `reach` (r,) of the first `count` rows in `free` (a + 1,)."""
    width = 0
    for i in range(count):
        width = max(width, reach[free[i]])
    return width


@inner()
def accept_row(count: int, length: float, factor: Buffer, basis: Buffer) -> None:
    """Accept the row of `append_row` into the basis.

    `factor` (a + 1, a + 1); `basis` (a + 1, N m).
    """
    factor[count, count] = length
    for k in range(basis.shape[1]):
        basis[count, k] /= length


@inner(fastmath={"reassoc"})  # sums in the order of the processor
def substitute(factor: Buffer, count: int, right: Buffer) -> None:
    """Solve L L' x = right in place; `factor` (count, count); `right` (count,)."""
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


@inner()
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
