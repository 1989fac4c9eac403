"""Compiled code: the arrays that a filter of plant and estimate works in.

A sample of the filter makes some thirty arrays. They are made once for a recording: to ask for them
at every sample, and to count who uses them, took a sixth of the time (docs/noisy-people.md).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from impc.arrays import Buffer
from impc.control.compiled_kernel import Workspace, workspace
from impc.control.constraint_rows import Rows
from impc.jit import njit
from impc.output_feedback.joint_loop import JointLoop


class Covariance(NamedTuple):
    """Covariance of z before a sample of the outputs is known, and what that sample does to it."""

    P: Buffer  # Before the sample (z, z) and (z, z, k)
    dP: Buffer
    CP: Buffer  # C P (p, z), S and S^-1 (p, p), g (z, p)
    S: Buffer
    inverse: Buffer
    gain: Buffer
    volume: Buffer  # log det S (1,)
    dCP: Buffer  # Derivatives of C P (p, z, k) and of S (p, p, k)
    dS: Buffer
    half: Buffer  # tr(S^-1 dS S^-1 dS) / 2 for each pair of directions (k, k), the lower half
    left: Buffer  # P|t, once the sample is known (z, z)


class Way(NamedTuple):
    """Room for what a sample makes on its way, so that none is asked for at every sample."""

    F: Buffer  # F at the slope of the command, F P|t, (F P|t)' and F - L C (z, z)
    FP: Buffer
    ahead: Buffer
    G: Buffer
    L: Buffer  # F g (z, p)
    # What enters by one column each, B, G and the L of the sample (z, j), the same as lines (j, z),
    # and how each of the 2 m + p changes (j, z, k)
    columns: Buffer
    lines: Buffer
    changes: Buffer
    estimate: Buffer  # Of F P|t, the columns of the estimate (z, n)
    # Of F P|t, the columns that move (z, j), and what their moves make (z, v), v being z times the
    # width of `Moves`
    picked: Buffer
    moved: Buffer
    identified: Buffer  # S^-1 dS (p, p, k)
    product: Buffer  # (z, z, k)
    known: Buffer  # What is seen of the outputs (p,), and of z before them (1, z)
    before: Buffer
    turned: Buffer  # Its changes (1, z k), and those of its variance (1, k)
    change: Buffer


class Moves(NamedTuple):
    """What is not zero of dF and dQ: few directions move either, and few columns of F."""

    first: int  # Which directions move either: `width` of them beginning at the first
    width: int
    column: Buffer  # Which columns of F any direction moves (j,)
    # Of these directions dF, the columns that move (j, v), and dQ / 2 (z, v), v being z times the
    # width
    F: Buffer
    Q: Buffer
    plant: bool  # Whether any direction moves B, C, E or G


class Room(NamedTuple):
    """What a filter works in along q directions, of which the first k move covariances."""

    work: Workspace  # Of the law
    lam: Buffer  # Multipliers (r,), and the commands (m,) with their derivatives (m, q)
    u: Buffer
    du: Buffer
    slope: Buffer  # Of the commands with the estimate (m, n), and its derivatives (m, n, k)
    dslope: Buffer
    # Variance of noise that enters with each command, by B and by G, (2, m), and its derivatives
    # (2, m, k)
    noise: Buffer
    dnoise: Buffer
    e: Buffer  # An innovation and S^-1 times it (p,)
    we: Buffer
    de: Buffer  # Derivatives of the innovation and S^-1 times them (p, q)
    wde: Buffer
    moved: Buffer  # dS S^-1 e (p, k)
    before: Buffer  # z once the outputs are known (z,), and its derivatives (z, q)
    dbefore: Buffer
    seen: Buffer  # The slope in z and its covariance with z (z,); derivatives of its deviation (k,)
    weighed: Buffer
    ds: Buffer
    here: Covariance  # Of z, before the sample that is next
    way: Way  # Where its next one is made
    moves: Moves  # What the k directions move


@njit(cache=True)
def filter_room(
    rows: Rows, joint: JointLoop, djoint: JointLoop, P: Buffer, dP: Buffer, n: int, q: int
) -> Room:
    """Room for a filter from a covariance on.

    `P` (z, z); `dP` (z, z, k).
    """
    (size, m), p, k = joint.B.shape, len(joint.C), dP.shape[2]
    moves = _moves(djoint, k)
    return Room(
        workspace(rows, m, q),
        np.zeros(len(rows.b)),
        np.empty(m),
        np.empty((m, q)),
        np.empty((m, n)),
        np.empty((m, n, k)),
        np.zeros((2, m)),
        np.zeros((2, m, k)),
        np.empty(p),
        np.empty(p),
        np.empty((p, q)),
        np.empty((p, q)),
        np.empty((p, k)),
        np.empty(size),
        np.empty((size, q)),
        np.empty(size),
        np.empty(size),
        np.empty(k),
        _covariance(P, dP, p),
        _way(joint, moves, n, k),
        moves,
    )


@njit(cache=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)
def _covariance(P: Buffer, dP: Buffer, p: int) -> Covariance:
    """P and dP (z, z, k), copied, and room for what follows from them for p outputs."""
    size, k = len(P), dP.shape[2]
    return Covariance(
        P.copy(),
        dP.copy(),
        np.empty((p, size)),
        np.empty((p, p)),
        np.empty((p, p)),
        np.empty((size, p)),
        np.empty(1),
        np.empty((p, size, k)),
        np.empty((p, p, k)),
        np.empty((k, k)),
        np.empty((size, size)),
    )


@njit(cache=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)
def _way(joint: JointLoop, moves: Moves, n: int, k: int) -> Way:
    """Room for an estimate of n states, and k directions."""
    size, p = len(joint.F), len(joint.C)
    columns = np.concatenate((joint.B, joint.G, np.empty((size, p))), axis=1)
    return Way(
        np.empty((size, size)),
        np.empty((size, size)),
        np.empty((size, size)),
        np.empty((size, size)),
        np.empty((size, p)),
        columns,
        np.ascontiguousarray(columns.T),
        np.empty((columns.shape[1], size, k)),
        np.empty((size, n)),
        np.empty((size, len(moves.column))),
        np.empty((size, size * moves.width)),
        np.empty((p, p, k)),
        np.empty((size, size, k)),
        np.empty(p),
        np.empty((1, size)),
        np.empty((1, size * k)),
        np.empty((1, k)),
    )


@njit(cache=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)
def _moves(djoint: JointLoop, k: int) -> Moves:
    """What the first k directions move."""
    size = len(djoint.F)
    found = np.nonzero(
        np.array([np.any(djoint.F[:, :, c]) or np.any(djoint.Q[:, :, c]) for c in range(k)])
    )[0]
    first = found[0] if len(found) > 0 else 0
    width = found[-1] + 1 - first if len(found) > 0 else 0
    column = np.nonzero(np.array([np.any(djoint.F[:, j, :k]) for j in range(size)]))[0]
    F, Q = np.empty((len(column), size, width)), np.empty((size, size, width))
    for i in range(size):
        for c in range(width):
            for j in range(len(column)):
                F[j, i, c] = djoint.F[i, column[j], first + c]
            for j in range(size):
                Q[j, i, c] = djoint.Q[i, j, first + c] / 2
    plant = np.any(djoint.B) or np.any(djoint.C) or np.any(djoint.E) or np.any(djoint.G)
    flat = size * width
    return Moves(
        first, width, column, F.reshape(len(column), flat), Q.reshape(size, flat), bool(plant)
    )
