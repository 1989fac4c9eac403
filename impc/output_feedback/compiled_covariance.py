"""Compiled code: covariance of plant and estimate from sample to sample, with its derivatives.

With the gain g = P C'S^-1 of a sample of the outputs, L = F g, and P|t what is left of P,

    P|t = P - g C P,    P+ = F P|t F' + Q,     G = F - L C,    dG = dF - L dC
    dP+ = G dP G' + dG P|t F' + F P|t dG' + dQ + L dR L'

as in `kalman`: g makes P|t least, so that dP+ leaves dg alone. F, its command at its slope among
it, is of the sample; k directions are the last axis of every derivative.

The two products with G are most of what a likelihood costs (`compiled_products`). See
docs/noisy-people.md.
"""

from __future__ import annotations

from impc.arrays import Buffer
from impc.jit import njit
from impc.output_feedback.compiled_products import (
    add_both,
    both_sides,
    combine,
    invert,
    noise_products,
    turn,
)
from impc.output_feedback.compiled_room import Moves, Room, Way
from impc.output_feedback.joint_loop import JointLoop


@njit(cache=True, inline="always")
def weigh(joint: JointLoop, djoint: JointLoop, room: Room) -> None:
    """Write all that follows from P and dP, which are the room's."""
    here, plant = room.here, room.moves.plant
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
    if plant:
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
                if plant:
                    for c in range(k):
                        dS[a, b, c] += dC[a, i, c] * CP[b, i]
    noise_products(inverse, dS, room.way.identified, here.half)


@njit(cache=True, inline="always")
def advance(joint: JointLoop, djoint: JointLoop, room: Room, at: int) -> None:
    """P and dP become those before the next sample."""
    here, way, slope, noise = room.here, room.way, room.slope, room.noise
    (m, n), size = slope.shape, len(here.P)
    P, B, G, F, FP, ahead = here.P, joint.B, joint.G, way.F, way.FP, way.ahead
    for i in range(size):
        F[i] = joint.F[i]
        for a in range(m):
            if B[i, a] != 0.0:
                for j in range(n):
                    F[i, at + j] += B[i, a] * slope[a, j]
    combine(F, here.left, 0, FP)
    combine(F, here.gain, 0, way.L)
    ahead[:] = FP.T
    combine(F, ahead, 0, FP)
    for i in range(size):
        for j in range(i + 1):
            both = (FP[i, j] + FP[j, i]) / 2 + joint.Q[i, j]
            for a in range(m):
                both += B[i, a] * B[j, a] * noise[0, a] + G[i, a] * G[j, a] * noise[1, a]
            P[i, j] = both
            P[j, i] = both
    if here.dP.shape[2] > 0:
        _move(joint, djoint, room, at)


@njit(cache=True, inline="always")
def _move(joint: JointLoop, djoint: JointLoop, room: Room, at: int) -> None:
    """dP becomes that before the next sample; what `advance` has made is on the way."""
    here, way, moves, slope, noise, dnoise = (
        room.here, room.way, room.moves, room.slope, room.noise, room.dnoise
    )  # fmt: skip
    (m, n), (size, p), k, ahead = slope.shape, here.gain.shape, here.dP.shape[2], way.ahead
    _enter(joint, way)
    both_sides(way.G, here.dP, way.product)
    # Of all the rest a half is written, columns times changes: to dP go that and its transpose.
    lines, changes, rest = way.lines, way.changes, way.product
    for i in range(size):
        for j in range(n):
            way.estimate[i, j] = ahead[at + j, i]
    changes[m:] = 0.0
    for a in range(m):
        combine(way.estimate, room.dslope[a], 0, changes[a])
        turn(0.5, dnoise[0, a : a + 1], lines[a : a + 1], changes[a])
        if joint.share[a] != 0.0:
            turn(0.5, dnoise[1, a : a + 1], lines[m + a : m + a + 1], changes[m + a])
    for a in range(p):
        turn(0.5, djoint.R[a], lines[2 * m :], changes[2 * m + a])
        if moves.plant:
            turn(-1.0, djoint.C[a], ahead, changes[2 * m + a])
    combine(way.columns, changes.reshape(2 * m + p, size * k), 0, rest.reshape(size, size * k))
    _add_moves(moves, way, rest)
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
def _enter(joint: JointLoop, way: Way) -> None:
    """Write F - L C, and L among what lets something enter: B and G stand there."""
    C, L, (size, m) = joint.C, way.L, joint.B.shape
    way.G[:] = way.F
    for i in range(size):
        for a in range(len(C)):
            for j in range(size):
                way.G[i, j] -= L[i, a] * C[a, j]
            way.columns[i, 2 * m + a] = L[i, a]
            way.lines[2 * m + a, i] = L[i, a]


@njit(cache=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)
def _add_moves(moves: Moves, way: Way, rest: Buffer) -> None:
    """Add dF P|t F' + dQ / 2."""
    first, width, Q, both = moves.first, moves.width, moves.Q, way.moved
    for j in range(len(moves.column)):
        for i in range(len(both)):
            way.picked[i, j] = way.ahead[moves.column[j], i]
    combine(way.picked, moves.F, 0, both)
    both += Q
    moved = rest[:, :, first : first + width]
    for i in range(len(rest)):
        for b in range(len(rest)):
            for c in range(width):
                moved[i, b, c] += both[b, i * width + c]


@njit(cache=True, inline="always")
def variance_changes(joint: JointLoop, djoint: JointLoop, room: Room) -> Buffer:
    """Derivatives (k,) of seen' P|t seen, what is seen held; the room's way keeps them."""
    here, way, moves, seen = room.here, room.way, room.moves, room.seen
    size, k, dR, known, before = len(seen), here.dP.shape[2], djoint.R, way.known, way.before
    known[:], before[0] = 0.0, seen
    for a in range(len(known)):
        for i in range(size):
            known[a] += seen[i] * here.gain[i, a]
        for i in range(size):
            before[0, i] -= known[a] * joint.C[a, i]
    combine(before, here.dP.reshape(size, size * k), 0, way.turned)
    combine(before, way.turned.reshape(size, k), 0, way.change)
    changes = way.change[0]
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
