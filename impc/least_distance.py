"""Least-distance problem by a dual active-set method, compiled.

    minimise  v'S v / 2 + sum_r limit_r s_r     subject to  M v <= d + s,  s >= 0

(hard rows have limit = inf and no s). Its dual is a bounded least-squares problem in one
multiplier a row,

    minimise  lam' G lam / 2 + d' lam   subject to  0 <= lam <= limit,   G = M S^-1 M',

with v = -S^-1 M' lam; the gradient d + G lam is the slack of the rows. The method is that of
Goldfarb and Idnani (Math. Programming 27, 1983): start at v = 0, the answer without bounds, and
raise the multiplier of the most violated row while the rows already active stay tight. A
multiplier that would leave [0, limit] blocks the step; at its limit the row is given up softly. An
unblocked step along which no slack changes proves the rows inconsistent.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from impc.arrays import Array

__all__ = ["CONVERGED", "INCONSISTENT", "ITERATION_LIMIT", "append_row", "solve_dual", "substitute"]

CONVERGED, INCONSISTENT, ITERATION_LIMIT = 0, 1, 2

# A row is dependent on the active ones when less than this share of its squared length is new.
# Rounding of the subtraction leaves about 1e-15; genuine neighbours in the terminal sets of
# tests/ differ by 1e-7 and more.
_DEPENDENT = 1e-12


@njit(cache=True)
def substitute(factor: Array, count: int, right: Array) -> None:
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
def append_row(gram: Array, free: Array, count: int, row: int, factor: Array) -> float:
    """Write the Cholesky row of `row` below the factor of the free rows; return its square."""
    for i in range(count):
        total = gram[free[i], row]
        for k in range(i):
            total -= factor[i, k] * factor[count, k]
        factor[count, i] = total / factor[i, i]
    square = gram[row, row]
    for k in range(count):
        square -= factor[count, k] ** 2
    return square  # type: ignore[no-any-return]


@njit(cache=True)
def solve_dual(
    gram: Array,
    d: Array,
    limit: Array,
    tolerance: Array,
    lam: Array,
    free: Array,
    factor: Array,
) -> tuple[int, int]:
    """Solve the dual from lam = 0.

    Parameters
    ----------
    gram, d, limit, tolerance : Array
        G (r, r), d (r,), upper limits (r,) and the violation (r,) below which a row counts as
        kept.
    lam, free, factor : Array
        Written: multipliers (r,), the rows with 0 < lam < limit in the order of the factor, and
        the Cholesky factor of their Gram matrix. Sizes r, r + 1 and (r + 1, r + 1).

    Returns
    -------
    status, count : int
        One of the codes above, and the number of free rows.
    """
    rows = len(d)
    slack = d.copy()
    at_limit = np.zeros(rows, dtype=np.bool_)
    is_free = np.zeros(rows, dtype=np.bool_)
    step = np.empty(rows + 1)
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
            return CONVERGED, count
        sign = -1.0 if at_limit[row] else 1.0
        while True:
            square = append_row(gram, free, count, row, factor)
            for i in range(count):
                step[i] = gram[free[i], row]
            substitute(factor, count, step)
            length = np.inf
            if square > _DEPENDENT * gram[row, row]:
                length = -sign * slack[row] / square
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
                factor[count, count] = np.sqrt(square)
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
            count = _remove(gram, free, count, blocked, factor)
    return ITERATION_LIMIT, count


@njit(cache=True)
def _remove(gram: Array, free: Array, count: int, place: int, factor: Array) -> int:
    """Drop the free row at `place` and factor the rows behind it again."""
    for i in range(place, count - 1):
        free[i] = free[i + 1]
    for i in range(place, count - 1):
        square = append_row(gram, free, i, free[i], factor)
        factor[i, i] = np.sqrt(max(square, 1e-300))
    return count - 1


@njit(cache=True)
def _refine(
    gram: Array,
    d: Array,
    limit: Array,
    at_limit: Array,
    lam: Array,
    free: Array,
    count: int,
    factor: Array,
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
