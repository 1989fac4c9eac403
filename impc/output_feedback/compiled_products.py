"""Compiled code: sums of rows and other products, of matrices with derivatives along k directions.

The last axis of a derivative, its directions, and the one before are taken as one: a processor then
works on many numbers at a time. Everything is a plain array, for numba counts who uses an array
whenever a slice is made or a tuple of arrays handed over, which took half of the time
(docs/noisy-people.md).
"""

from __future__ import annotations

import numpy as np

from impc.arrays import Buffer
from impc.jit import njit


@njit(cache=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)
def combine(weights: Buffer, rows: Buffer, step: int, result: Buffer) -> None:
    """Write weights (i, j) times rows (j, w): of line i the first (i + 1) step, all if step is 0.

    Four lines at a time, so that a number that is loaded serves four, and beyond what is asked of
    the first three. Indices begin at 0: where one might be negative numba takes one number at a
    time.

    `result` (i, w).
    """
    lines, width = len(weights), rows.shape[1]
    whole = lines - lines % 4 if len(rows) > 3 else 0
    for i in range(0, whole, 4):
        _four_lines(weights, rows, i, width if step == 0 else (i + 4) * step, result)
    for i in range(whole, lines):
        _line(weights, rows, i, width if step == 0 else (i + 1) * step, result)


@njit(cache=True, no_cpython_wrapper=True, no_cfunc_wrapper=True, fastmath={"contract"})
def _four_lines(weights: Buffer, rows: Buffer, i: int, end: int, result: Buffer) -> None:
    """Write `end` numbers of lines i to i + 3; four rows at a time, and none without a weight."""
    count = len(rows)
    one, two, three, four = result[i], result[i + 1], result[i + 2], result[i + 3]
    for j in range(0, count - 3, 4):
        w, x = _four(weights, i, j), _four(weights, i + 1, j)
        y, z = _four(weights, i + 2, j), _four(weights, i + 3, j)
        if j == 0:
            for b in range(end):
                identified = rows[0, b], rows[1, b], rows[2, b], rows[3, b]
                one[b], two[b] = _times(w, identified), _times(x, identified)
                three[b], four[b] = _times(y, identified), _times(z, identified)
        elif _any(w) or _any(x) or _any(y) or _any(z):
            for b in range(end):
                identified = rows[j, b], rows[j + 1, b], rows[j + 2, b], rows[j + 3, b]
                one[b] += _times(w, identified)
                two[b] += _times(x, identified)
                three[b] += _times(y, identified)
                four[b] += _times(z, identified)
    for j in range(count - count % 4, count):
        for line in range(i, i + 4):
            for b in range(end):
                result[line, b] += weights[line, j] * rows[j, b]


@njit(cache=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)
def _line(weights: Buffer, rows: Buffer, i: int, end: int, result: Buffer) -> None:
    """Write `end` numbers of line i, one row after the other that has a weight."""
    one = result[i]
    one[:end] = 0.0
    for j in range(len(rows)):
        if weights[i, j] != 0.0:
            for b in range(end):
                one[b] += weights[i, j] * rows[j, b]


@njit(cache=True, inline="always")
def _four(weights: Buffer, i: int, j: int) -> tuple[float, float, float, float]:
    return weights[i, j], weights[i, j + 1], weights[i, j + 2], weights[i, j + 3]


@njit(cache=True, inline="always")
def _any(w: tuple[float, float, float, float]) -> bool:
    return w[0] != 0.0 or w[1] != 0.0 or w[2] != 0.0 or w[3] != 0.0


@njit(cache=True, inline="always")
def _times(w: tuple[float, float, float, float], x: tuple[float, float, float, float]) -> float:
    return w[0] * x[0] + w[1] * x[1] + w[2] * x[2] + w[3] * x[3]


@njit(cache=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)
def both_sides(G: Buffer, dP: Buffer, product: Buffer) -> None:
    """The lower half of G dP G' takes the place of dP; what is above is left to `add_both`.

    `G` (z, z); `dP, product` (z, z, k).
    """
    size, k = len(G), dP.shape[2]
    flat, room = dP.reshape(size, size * k), product.reshape(size, size * k)
    combine(G, flat, 0, room)
    for i in range(size):  # so that the other G stands on the left, too
        for j in range(i):
            for c in range(k):
                product[i, j, c], product[j, i, c] = product[j, i, c], product[i, j, c]
    combine(G, room, k, flat)


@njit(cache=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)
def turn(weight: float, changes: Buffer, rows: Buffer, turned: Buffer) -> None:
    """Add weight times sum_j rows_j changes_j' to what is turned.

    `changes` (j, k); `rows` (j, z); `turned` (z, k).
    """
    for j in range(len(rows)):
        for b in range(len(turned)):
            for c in range(turned.shape[1]):
                turned[b, c] += weight * rows[j, b] * changes[j, c]


@njit(cache=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)
def add_both(rest: Buffer, dP: Buffer) -> None:
    """Add `rest` and its transpose to the lower half of dP, and write the upper.

    `rest, dP` (z, z, k).
    """
    size, k = len(dP), dP.shape[2]
    for i in range(size):
        for j in range(i + 1):
            for c in range(k):
                dP[i, j, c] += rest[i, j, c] + rest[j, i, c]
        for j in range(i):
            dP[j, i] = dP[i, j]


@njit(cache=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)
def noise_products(inverse: Buffer, dS: Buffer, identified: Buffer, half: Buffer) -> None:
    """Write tr(S^-1 dS S^-1 dS) / 2 for each pair of directions, the lower half.

    `inverse` (p, p); `dS` (p, p, k); `identified` (p, p, k); `half` (k, k).
    """
    p, k = len(inverse), dS.shape[2]
    identified[:] = 0.0
    for a in range(p):
        for b in range(p):
            for j in range(p):
                for c in range(k):
                    identified[a, b, c] += inverse[a, j] * dS[j, b, c]
    half[:] = 0.0
    for a in range(p):
        for b in range(p):
            for c in range(k):
                for d in range(c + 1):
                    half[c, d] += identified[a, b, c] * identified[b, a, d] / 2


@njit(cache=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)
def invert(S: Buffer, inverse: Buffer) -> float:
    """Write the inverse of a covariance, one pivot after the other; return log det S.

    `S, inverse` (p, p).
    """
    inverse[:] = S
    p, volume = len(S), 0.0
    for a in range(p):
        pivot = inverse[a, a]
        volume += np.log(pivot)
        inverse[a, a] = 1.0
        for c in range(p):
            inverse[a, c] /= pivot
        for b in range(p):
            if b != a:
                factor = inverse[b, a]
                inverse[b, a] = 0.0
                for c in range(p):
                    inverse[b, c] -= factor * inverse[a, c]
    return volume
