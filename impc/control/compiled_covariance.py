"""Compiled code: covariance of plant and estimate from sample to sample, with its derivatives.

With the gain g = P C'S^-1 of a sample of the outputs, L = F g, and P|t what is left of P,

    P|t = P - g C P,    P+ = F P|t F' + Q,     G = F - L C,    dG = dF - L dC
    dP+ = G dP G' + dG P|t F' + F P|t dG' + dQ + L dR L'

as in `impc.model.kalman`: g makes P|t least, so that dP+ leaves dg alone. F, its command at its
slope among it, is of the sample; k directions are the last axis of every derivative.

The two products with G are most of what a likelihood costs (`compiled_products`). numba's cache
does not look there: `COMPILED_WITH` must change with it, which
tests/control/test_joint_likelihood.py asks for (docs/noisy-people.md).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from impc.arrays import Buffer
from impc.control.compiled_products import (
    add_both,
    both_sides,
    combine,
    invert,
    noise_products,
    turn,
)
from impc.control.joint_loop import JointLoop
from impc.jit import njit

__all__ = [
    "COMPILED_WITH",
    "Covariance",
    "Moves",
    "advance",
    "covariance",
    "moves_of",
    "variance_changes",
    "weigh",
]

#: First digits of the SHA-256 of each file whose functions are called.
COMPILED_WITH = {"compiled_products": "19e7f22bf8fd60eb"}


class Covariance(NamedTuple):
    """Covariance of z before a sample of the outputs is known, and what that sample does to it.

    Attributes
    ----------
    P, dP : Buffer
        Before the sample (z, z) and (z, z, k).
    CP, S, inverse, gain : Buffer
        C P (p, z), S and S^-1 (p, p), g (z, p).
    volume : Buffer
        log det S (1,).
    dCP, dS : Buffer
        Derivatives of C P (p, z, k) and of S (p, p, k).
    half : Buffer
        tr(S^-1 dS S^-1 dS) / 2 for each pair of directions (k, k), the lower half.
    left : Buffer
        P|t, once the sample is known (z, z).
    product : Buffer
        Room on the way (z, z, k).
    """

    P: Buffer
    dP: Buffer
    CP: Buffer
    S: Buffer
    inverse: Buffer
    gain: Buffer
    volume: Buffer
    dCP: Buffer
    dS: Buffer
    half: Buffer
    left: Buffer
    product: Buffer


class Moves(NamedTuple):
    """What is not zero of dF and dQ: few directions move either, and few columns of F.

    Attributes
    ----------
    row, along : Buffer
        Which rows move, along which direction (r,) each.
    column : Buffer
        Which columns of F any direction moves (j,).
    F, Q : Buffer
        What is there in these columns, and in all of Q: (j, r) and (z, r).
    plant : bool
        Whether any direction moves B, C, E or G.
    """

    row: Buffer
    along: Buffer
    column: Buffer
    F: Buffer
    Q: Buffer
    plant: bool


@njit(cache=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)
def covariance(P: Buffer, dP: Buffer, p: int) -> Covariance:
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
        np.empty((size, size, k)),
    )


@njit(cache=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)
def moves_of(djoint: JointLoop, k: int) -> Moves:
    """What the first k directions move."""
    size = len(djoint.F)
    found = np.zeros((size, k), dtype=np.bool_)
    for i in range(size):
        for c in range(k):
            found[i, c] = np.any(djoint.F[i, :, c]) or np.any(djoint.Q[i, :, c])
    row, along = np.nonzero(found)
    column = np.nonzero(np.array([np.any(djoint.F[:, j, :k]) for j in range(size)]))[0]
    F, Q = np.empty((len(column), len(row))), np.empty((size, len(row)))
    for r in range(len(row)):
        for j in range(len(column)):
            F[j, r] = djoint.F[row[r], column[j], along[r]]
        Q[:, r] = djoint.Q[row[r], :, along[r]]
    plant = np.any(djoint.B) or np.any(djoint.C) or np.any(djoint.E) or np.any(djoint.G)
    return Moves(row, along, column, F, Q, bool(plant))


@njit(cache=True, inline="always")
def weigh(joint: JointLoop, djoint: JointLoop, moves: Moves, here: Covariance) -> None:
    """Write all that follows from P and dP."""
    C, dC, dR, P, CP, S, dCP, dS = (
        joint.C, djoint.C, djoint.R, here.P, here.CP, here.S, here.dCP, here.dS
    )  # fmt: skip
    inverse, gain, left = here.inverse, here.gain, here.left
    size, p, k = len(P), len(C), dS.shape[2]
    combine(C, P, 0, CP)
    for a in range(p):
        for b in range(p):
            S[a, b] = joint.R[a, b]
            for i in range(size):
                S[a, b] += C[a, i] * CP[b, i]
    here.volume[0] = invert(S, inverse)
    for i in range(size):
        for a in range(p):
            gain[i, a] = 0.0
            for b in range(p):
                gain[i, a] += CP[b, i] * inverse[b, a]
    combine(gain, CP, 0, left)
    for i in range(size):
        for j in range(size):
            left[i, j] = P[i, j] - left[i, j]
    if k == 0:
        return
    combine(C, here.dP.reshape(size, size * k), 0, dCP.reshape(p, size * k))
    if moves.plant:
        for a in range(p):
            for i in range(size):
                for j in range(size):
                    for c in range(k):
                        dCP[a, i, c] += P[i, j] * dC[a, j, c]
    for a in range(p):
        for b in range(p):
            for c in range(k):
                dS[a, b, c] = dR[a, b, c]
            for i in range(size):
                if C[a, i] != 0.0:
                    for c in range(k):
                        dS[a, b, c] += C[a, i] * dCP[b, i, c]
                if moves.plant:
                    for c in range(k):
                        dS[a, b, c] += dC[a, i, c] * CP[b, i]
    noise_products(inverse, dS, here.half)


@njit(cache=True, inline="always")
def advance(
    joint: JointLoop,
    djoint: JointLoop,
    moves: Moves,
    here: Covariance,
    slope: Buffer,
    dslope: Buffer,
    at: int,
    noise: Buffer,
    dnoise: Buffer,
) -> None:
    """P and dP become those before the next sample.

    Parameters
    ----------
    joint, djoint, moves
        The system, its derivatives along k directions and more, and what the first k move.
    here : Covariance
        Of this sample.
    slope, dslope : Buffer
        Of the commands with the estimate, which stands at `at` in z: (m, n) and (m, n, k).
    at : int
        Of the first entry of the estimate.
    noise, dnoise : Buffer
        Variance of noise that enters with each command, by B and by G, (2, m), and its derivatives
        (2, m, k).
    """
    (m, n), p = slope.shape, len(joint.C)
    size, k = len(here.P), here.dP.shape[2]
    F, P, B, G = joint.F.copy(), here.P, joint.B, joint.G
    for i in range(size):
        for a in range(m):
            for j in range(n):
                F[i, at + j] += B[i, a] * slope[a, j]
    FP, L, LC = np.empty((size, size)), np.empty((size, p)), np.empty((size, size))
    combine(F, here.left, 0, FP)
    combine(F, here.gain, 0, L)
    ahead = np.ascontiguousarray(FP.T)
    combine(F, ahead, 0, FP)
    for i in range(size):
        for j in range(i + 1):
            both = (FP[i, j] + FP[j, i]) / 2 + joint.Q[i, j]
            for a in range(m):
                both += B[i, a] * B[j, a] * noise[0, a] + G[i, a] * G[j, a] * noise[1, a]
            P[i, j] = both
            P[j, i] = both
    if k == 0:
        return
    combine(L, joint.C, 0, LC)
    both_sides(F - LC, here.dP, here.product)
    # Of all the rest a half is written, columns times changes: to dP go that and its transpose.
    columns, rest = np.concatenate((B, G, L), axis=1), here.product
    lines, changes = np.ascontiguousarray(columns.T), np.zeros((2 * m + p, size, k))
    halves, estimate = lines / 2, np.ascontiguousarray(ahead[at : at + n].T)
    for a in range(m):
        combine(estimate, dslope[a], 0, changes[a])
        turn(dnoise[0, a : a + 1], halves[a : a + 1], changes[a])
        if joint.share[a] != 0.0:
            turn(dnoise[1, a : a + 1], halves[m + a : m + a + 1], changes[m + a])
    for a in range(p):
        turn(djoint.R[a], halves[2 * m :], changes[2 * m + a])
        if moves.plant:
            turn(djoint.C[a], -ahead, changes[2 * m + a])
    combine(columns, changes.reshape(2 * m + p, size * k), 0, rest.reshape(size, size * k))
    _add_moves(moves, ahead, rest)
    if moves.plant:
        for a in range(m):
            commanded = slope[a] @ ahead[at : at + n] + noise[0, a] * lines[a]
            for i in range(size):
                for b in range(size):
                    for c in range(k):
                        rest[i, b, c] += djoint.B[i, a, c] * commanded[b]
                        rest[i, b, c] += djoint.G[i, a, c] * noise[1, a] * lines[m + a, b]
    add_both(rest, here.dP)


@njit(cache=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)
def _add_moves(moves: Moves, ahead: Buffer, rest: Buffer) -> None:
    """Add dF P|t F' + dQ / 2."""
    row, along, Q, both = moves.row, moves.along, moves.Q, np.empty(moves.Q.shape)
    combine(np.ascontiguousarray(ahead[moves.column].T), moves.F, 0, both)
    for b in range(len(rest)):
        for r in range(len(row)):
            rest[row[r], b, along[r]] += both[b, r] + Q[b, r] / 2


@njit(cache=True, inline="always")
def variance_changes(
    joint: JointLoop, djoint: JointLoop, moves: Moves, here: Covariance, seen: Buffer
) -> Buffer:
    """Derivatives (k,) of seen' P|t seen, `seen` (z,) what is held."""
    size, k, dR = len(seen), here.dP.shape[2], djoint.R
    known = seen @ here.gain
    before, turned, change = seen - known @ joint.C, np.empty((1, size * k)), np.empty((1, k))
    combine(before.reshape(1, size), here.dP.reshape(size, size * k), 0, turned)
    combine(before.reshape(1, size), turned.reshape(size, k), 0, change)
    changes = change[0]
    for a in range(len(known)):
        for b in range(len(known)):
            for c in range(k):
                changes[c] += known[a] * dR[a, b, c] * known[b]
    if moves.plant:
        left = here.left @ seen
        for a in range(len(known)):
            for j in range(size):
                for c in range(k):
                    changes[c] -= 2 * known[a] * djoint.C[a, j, c] * left[j]
    return changes  # type: ignore[no-any-return]
