"""Compiled code: slope of the command with the state at the active rows (docs/noisy-people.md)."""

from __future__ import annotations

import numpy as np

from impc.arrays import Buffer
from impc.control.compiled_dual import substitute_all
from impc.control.compiled_kernel import LoopMatrices, Workspace
from impc.control.constraint_rows import RowDirections, Rows
from impc.jit import njit


@njit(cache=True, inline="always")
def slope_of_law(
    loop: LoopMatrices,
    dloop: LoopMatrices,
    rows: Rows,
    drows: RowDirections,
    work: Workspace,
    slope: Buffer,
    dslope: Buffer,
) -> None:
    """Write the slope of the input with the state, and its derivative: exact.

    With the active rows a it is -K - (Gram_aa^-1 N_a0)' T_a, N_a0 the columns of the first stage.

    `slope` (m, n); `dslope` (m, n, k).
    """
    (m, n), active, free = loop.K.shape, work.active[0], work.free
    k = dslope.shape[2]
    for i in range(m):
        for j in range(n):
            slope[i, j] = -loop.K[i, j]
            for c in range(k):
                dslope[i, j, c] = -dloop.K[i, j, c]
    if active == 0:
        return
    first = np.empty((active, m))
    for a in range(active):
        first[a] = rows.N[free[a], :m]
    substitute_all(work.factor, active, first)
    dfirst = _first_changes(loop, dloop, rows, drows, work, first, k)
    for i in range(m):
        for a in range(active):
            for j in range(n):
                slope[i, j] -= first[a, i] * rows.T[free[a], j]
                for c in range(k):
                    dslope[i, j, c] -= dfirst[a, i * k + c] * rows.T[free[a], j]
                    dslope[i, j, c] -= first[a, i] * drows.T[free[a], j, c]


@njit(cache=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)
def _first_changes(
    loop: LoopMatrices,
    dloop: LoopMatrices,
    rows: Rows,
    drows: RowDirections,
    work: Workspace,
    first: Buffer,
    k: int,
) -> Buffer:
    """Derivative (a, m k) of `first` = Gram^-1 N_0: Gram^-1 (dN_0 - dGram first)."""
    (active, m), free, width = first.shape, work.free, rows.N.shape[1]
    pulled, moved = np.zeros((m, width)), np.zeros((m, width, k))
    for i in range(m):
        for a in range(active):
            for j in range(width):
                pulled[i, j] += rows.N[free[a], j] * first[a, i]
                for c in range(k):
                    moved[i, j, c] += drows.M[free[a], j, c] * first[a, i]
        for j in range(width):
            for h in range(m):
                for c in range(k):
                    moved[i, j, c] -= dloop.S[j % m, h, c] * pulled[i, j - j % m + h]
    result = np.zeros((active, m * k))
    for a in range(active):
        for i in range(m):
            for c in range(k):
                left = drows.M[free[a], i, c]
                for h in range(m):
                    left -= rows.N[free[a], h] * dloop.S[h, i, c]
                for h in range(m):
                    result[a, h * k + c] += left * loop.S[i, h]
            for j in range(width):
                for c in range(k):
                    result[a, i * k + c] -= drows.M[free[a], j, c] * pulled[i, j]
                    result[a, i * k + c] -= rows.N[free[a], j] * moved[i, j, c]
    substitute_all(work.factor, active, result)
    return result
