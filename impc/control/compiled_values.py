"""Compiled code: the values that it reads and writes, as named tuples, and the codes it returns."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from impc.arrays import Array, Buffer, IntArray

#: Values of `simulation.Status` that compiled code returns.
FREE, ACTIVE, SOFTENED, INFEASIBLE, UNSOLVED, DIVERGED = 0, 1, 2, 3, 4, 5
#: The solution of a shortened problem does not satisfy, or nearly violates, a later row.
TOO_SHORT = 7
# A row exceeded by less than this share of its bound is satisfied: 100 times the rounding of
# T x + M v, so that the quadratic program is never solved because of rounding alone.
_KEPT = 1e-13


class Rows(NamedTuple):
    """T x + M v <= b, with derived matrices.

    The first h of the r rows make the problem; those of later stages are only checked. N is the
    number of stages of the problem; h = r unless it is shortened.
    """

    T: Array  # (r, n)
    M: Array  # (r, N m), the columns of each stage adjacent
    N: Array  # (h, N m), M S^-1 with the metric S of each stage
    W: Array  # (h, N m), M L^-T with S = L L': rows in coordinates in which S is the identity
    gram: Array  # (h, h), W W' = M S^-1 M'
    b: Array  # (r,)
    limit: Array  # (h,), largest multiplier: infinite if hard, penalty per unit of excess if soft
    family: IntArray  # (r,), index of the bound
    stage: IntArray  # (r,), samples ahead
    reach: IntArray  # (h,), number of columns of M that can be nonzero


class RowDirections(NamedTuple):
    """Derivatives of the first h `Rows` along p directions (last axis)."""

    T: Array  # (h, n, p)
    M: Array  # (h, N m, p)
    b: Array  # (h, p)


class LoopMatrices(NamedTuple):
    """Plant, gain and inverse metric; or derivatives (of S, not S^-1) along p directions."""

    A: Buffer  # (n, n); derivatives have a further last axis, (n, n, p) and so on
    B: Buffer  # (n, m)
    E: Buffer  # (n, d)
    K: Buffer  # (m, n)
    S: Buffer  # S^-1 (m, m); derivatives are those of S, (m, m, p)


class Aim(NamedTuple):
    """Set points of the controller, sample by sample; all of length 0 for rest.

    Bounds apply to the deviations, so each is reduced by what the target uses of it.
    """

    x: Buffer  # (steps, n), target states
    u: Buffer  # (steps, m), target commands
    taken: Buffer  # (steps + ahead, c), E x + F u of every bound at the target, previews included
    held: Buffer  # (steps, c), addition to `taken` by an estimated disturbance
    dx: Buffer  # (steps, n, p), derivatives along p directions; or of length 0
    du: Buffer
    dtaken: Buffer
    dheld: Buffer


class Workspace(NamedTuple):
    """Arrays that are reused from sample to sample."""

    # right sides of the rows at the sample (r,), reduced by the target, and derivatives (h, p)
    right: Buffer
    dright: Buffer
    # of the rows: slack (r,), violation that is accepted (r,), free rows (a + 1,)
    slack: Buffer
    kept: Buffer
    free: Buffer
    factor: Buffer  # (a + 1, a + 1), as in `solve_dual`
    basis: Buffer  # (a + 1, N m), as in `solve_dual`
    v: Buffer  # (N m,), planned inputs minus those of the gain
    rounding: Buffer  # (N m,), rounding error of v
    dv0: Buffer  # (m, p), derivatives of the first of them
    T: Buffer  # (n, r), transposed rows
    M: Buffer  # (N m, r), transposed rows
    first: Buffer  # (N m,), first row with the column: rows are ordered by stage
    active: Buffer  # (1,), number of free rows at the last sample: warm start of the next problem
    worn: Buffer  # (1,), as in `solve_dual`
    # active set of another solver, for one sample, or empty
    tight: Buffer  # (a,), rows
    given_up: Buffer  # (r,), whether a row is exceeded


def workspace(rows: Rows, drows: RowDirections, m: int) -> Workspace:
    """Allocate the workspace of a law with `m` inputs."""
    count, width = rows.M.shape
    room = min(len(rows.limit), width) + 1
    # T and M are stored by columns: sums over columns then run over all rows at once.
    return Workspace(
        rows.b.copy(),
        drows.b.copy(),
        np.empty(count),
        _KEPT * rows.b,
        np.empty(room, dtype=np.int64),
        np.empty((room, room)),
        np.zeros((room, width)),
        np.zeros(width),
        np.empty(width),
        np.zeros((m, drows.b.shape[1])),
        np.ascontiguousarray(rows.T.T),
        np.ascontiguousarray(rows.M.T),
        np.searchsorted(rows.stage, np.arange(width) // m),
        np.zeros(1, dtype=np.int64),
        np.zeros(1, dtype=np.int64),
        np.zeros(0, dtype=np.int64),
        np.zeros(0, dtype=np.bool_),
    )


class Trace(NamedTuple):
    """What a simulation of some steps writes."""

    x: Buffer  # (steps + 1, n)
    u: Buffer  # (steps, m)
    dx: Buffer  # (steps + 1, n, p); or (2, n, p), where the last samples overwrite earlier ones
    du: Buffer  # (steps, m, p), or (1, m, p)
    seen: Buffer  # (q, n), given: outputs whose derivatives are kept
    dy: Buffer  # (steps + 1, q, p), seen dx
    status: Buffer  # (steps,)
    lam: Buffer  # (h,), multipliers of the last problem


class BodyTape(NamedTuple):
    """Machine code of a `Body` with its buffers."""

    address: int  # 0 for a linear plant
    constants: Buffer  # (c,)
    given: Buffer  # (g,), written at every sample: state, input and disturbance
    found: Buffer  # (n + n*g,), written by the code: next state, then its slopes
    slopes: Buffer  # (n, g), view of the slopes in `found`
    beside: Buffer  # (n, g), slopes of an added linear part; or (n, 0)
