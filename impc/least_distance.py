"""Least-distance problem by a dual active-set method, compiled.

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
"""

from __future__ import annotations

import numpy as np
from numba import njit

from impc.arrays import Buffer

__all__ = ["CONVERGED", "INCONSISTENT", "UNSOLVED", "solve_dual", "substitute"]

CONVERGED, INCONSISTENT, UNSOLVED = 0, 1, 2

# A row is dependent on the active ones when less than this share of its length is new. The part is
# computed by orthogonalising twice, which leaves rounding of 1e-16; genuine neighbours in the
# terminal sets of tests/ differ by 1e-5 and more.
_DEPENDENT = 1e-9
# The answer must keep every row to this share of the distance between v = 0 and the row, or it is
# not given out.
_CHECKED = 1e-8


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
) -> tuple[int, int]:
    """Solve the dual from lam = 0.

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

    Returns
    -------
    status, count : int
        CONVERGED and the number of free rows; INCONSISTENT and the row that proves it; UNSOLVED.
    """
    rows = len(d)
    slack = d.copy()
    at_limit = np.zeros(rows, dtype=np.bool_)
    is_free = np.zeros(rows, dtype=np.bool_)
    step = np.empty(len(free))
    lam[:] = 0.0
    count = 0
    for _ in range(50 * (rows + 10)):
        row, worst = -1, 0.0
        for r in range(rows):
            if is_free[r]:
                continue
            wrong = slack[r] if at_limit[r] else -slack[r]
            if wrong > tolerance[r]:
                # Distance of v to the row, so that the choice does not depend on its scale.
                distance = wrong / np.sqrt(gram[r, r]) if gram[r, r] > 0 else np.inf
                if distance > worst:
                    row, worst = r, distance
        if row < 0:
            _refine(gram, d, limit, at_limit, lam, free, count, factor)
            kept = _verify(gram, d, tolerance, at_limit, lam)
            return (CONVERGED if kept else UNSOLVED), count
        sign = -1.0 if at_limit[row] else 1.0
        while True:
            new = _append_row(whitened, row, count, factor, basis)
            for i in range(count - 1, -1, -1):
                part = factor[count, i]
                for k in range(i + 1, count):
                    part -= factor[k, i] * step[k]
                step[i] = part / factor[i, i]
            length = np.inf
            if new > _DEPENDENT * np.sqrt(gram[row, row]):
                length = -sign * slack[row] / new**2
            blocked = -1
            room = lam[row] if sign < 0 else limit[row] - lam[row]
            if room <= length:
                length, blocked = room, count
            for i in range(count):
                change = -sign * step[i]
                if change < 0:
                    room = lam[free[i]] / -change
                elif change > 0:
                    room = (limit[free[i]] - lam[free[i]]) / change
                else:
                    continue
                if room < length:
                    length, blocked = room, i
            if length == np.inf:
                return INCONSISTENT, row
            lam[row] += sign * length
            for r in range(rows):
                change = gram[r, row]
                for i in range(count):
                    change -= gram[r, free[i]] * step[i]
                slack[r] += sign * length * change
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
def _remove(
    whitened: Buffer, free: Buffer, count: int, place: int, factor: Buffer, basis: Buffer
) -> int:
    """Drop the free row at `place` and factor the rows behind it again."""
    for i in range(place, count - 1):
        free[i] = free[i + 1]
        _accept_row(i, _append_row(whitened, free[i], i, factor, basis), factor, basis)
    return count - 1


@njit(cache=True)
def _verify(gram: Buffer, d: Buffer, tolerance: Buffer, at_limit: Buffer, lam: Buffer) -> bool:
    """Check the rows and the multipliers of the answer itself."""
    for r in range(len(d)):
        slack = d[r]
        for i in range(len(d)):
            if lam[i] != 0.0:
                slack += gram[r, i] * lam[i]
        if not at_limit[r] and slack < -max(tolerance[r], _CHECKED * abs(d[r])):
            return False
        if lam[r] * gram[r, r] < -_CHECKED * abs(d[r]):
            return False
    return True


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
