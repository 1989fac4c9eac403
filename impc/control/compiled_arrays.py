"""What the compiled law and loop are given, the arrays they work in, and how a sample ends.

The letters are those of docs/theory.md, section 4.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from impc.arrays import Buffer
from impc.jit import njit

if TYPE_CHECKING:
    from impc.control.constraint_rows import Rows

__all__ = [
    "ACTIVE",
    "DIVERGED",
    "FREE",
    "INFEASIBLE",
    "LARGEST",
    "SOFTENED",
    "UNSOLVED",
    "LoopMatrices",
    "Workspace",
    "workspace",
]

#: Of `closed_loop.Status`, by which what is compiled says how a sample ended.
FREE, ACTIVE, SOFTENED, INFEASIBLE, UNSOLVED, DIVERGED = 0, 1, 2, 3, 4, 5
#: No entry of plant and estimate together goes beyond this: neither a state nor what is expected.
LARGEST = 1e100
# A row is kept when it is exceeded by less than this share of its bound: a hundred times the
# rounding of T x + M v, so that the quadratic program is never entered for rounding alone.
_KEPT = 1e-13


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
