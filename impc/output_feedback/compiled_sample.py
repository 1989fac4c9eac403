"""Compiled code: what one sample does in the filter of plant and estimate.

`update` takes the recorded outputs in, `expected_command`, `clip_command` and `share_noise` say
what is expected of the command that follows and what noise comes with it, and `ahead` goes on to
the next sample (`likelihood`, docs/noisy-people.md).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from impc.arrays import Buffer
from impc.jit import njit
from impc.output_feedback.compiled_clip import Clip, Clipped, clipped
from impc.output_feedback.compiled_covariance import variance_changes
from impc.output_feedback.compiled_products import combine
from impc.output_feedback.compiled_room import Room
from impc.output_feedback.joint_loop import JointLoop

# A first state is forgotten when none of its directions moves an innovation by more than this, of
# its deviation.
_FORGOTTEN = 1e-9


class FilterResult(NamedTuple):
    """What the filter writes, sample by sample of one trial."""

    identified: Buffer  # Log-likelihood of each sample given the earlier ones (samples,)
    score: Buffer  # Its derivatives along the q directions (samples, q)
    # The sum of their expected products (q, q), the lower half
    information: Buffer
    # Recorded outputs minus what is expected (samples, p), and their covariance (samples, p, p)
    innovation: Buffer
    spread: Buffer
    filtered: Buffer  # Expected z given all outputs so far (samples, z)
    u: Buffer  # Command expected there (samples, m)
    status: Buffer  # Of each sample: the value of `closed_loop.Status` (samples,)
    # The first sample of a trial that is identified: those before it say nothing, and are what the
    # others are identified given
    counted: int


@njit(cache=True, inline="always")
def update(
    joint: JointLoop,
    djoint: JointLoop,
    room: Room,
    output: Buffer,
    z: Buffer,
    dz: Buffer,
    result: FilterResult,
    t: int,
    lasting: int,
) -> bool:
    """Likelihood and score of one sample; z and dz become those given the sample.

    `output` (p,); `z` (z,); `dz` (z, q).
    """
    _innovate(joint, djoint, room, output, z, dz)
    result.innovation[t], result.spread[t] = room.e, room.here.S
    _tell(room, result, t)
    _correct(room, z, dz)
    result.filtered[t] = z
    return _forgotten(room, lasting)


@njit(cache=True, inline="always")
def _innovate(
    joint: JointLoop, djoint: JointLoop, room: Room, output: Buffer, z: Buffer, dz: Buffer
) -> None:
    """Write the innovation and its derivatives, and S^-1 times them."""
    C, inverse, (p, q), k = joint.C, room.here.inverse, room.de.shape, room.moved.shape[1]
    e, we, de, wde = room.e, room.we, room.de, room.wde
    e[:], de[:], we[:], wde[:] = output, 0.0, 0.0, 0.0
    for a in range(p):
        for i in range(len(z)):
            if C[a, i] != 0.0:
                e[a] -= C[a, i] * z[i]
                for c in range(q):
                    de[a, c] -= C[a, i] * dz[i, c]
            if room.moves.plant:
                for c in range(k):
                    de[a, c] -= djoint.C[a, i, c] * z[i]
    for a in range(p):
        for b in range(p):
            we[a] += inverse[a, b] * e[b]
            for c in range(q):
                wde[a, c] += inverse[a, b] * de[b, c]


@njit(cache=True, inline="always")
def _tell(room: Room, result: FilterResult, t: int) -> None:
    """Write likelihood and score, and add the information."""
    here, e, we, de, moved = room.here, room.e, room.we, room.de, room.moved
    inverse, dS, (p, q), k = here.inverse, here.dS, de.shape, moved.shape[1]
    moved[:] = 0.0
    for a in range(p):
        for b in range(p):
            for c in range(k):
                moved[a, c] += dS[a, b, c] * we[b]
    if t < result.counted:
        return
    result.identified[t] = -(np.dot(e, we) + here.volume[0] + p * np.log(2 * np.pi)) / 2
    score = result.score[t, :q]
    for a in range(p):
        for c in range(q):
            score[c] -= we[a] * de[a, c]
        for c in range(k):
            score[c] += we[a] * moved[a, c] / 2
        for b in range(p):
            for c in range(k):
                score[c] -= inverse[a, b] * dS[a, b, c] / 2
    _inform(result.information, de, room.wde, here.half)


@njit(cache=True, inline="always")
def _correct(room: Room, z: Buffer, dz: Buffer) -> None:
    """z and dz become those given the sample.

    The gain is P C'S^-1: with w = S^-1 e it moves by (dP C' w - gain dS w) where it is applied.
    """
    gain, dCP, e, we, de, moved = (
        room.here.gain, room.here.dCP, room.e, room.we, room.de, room.moved
    )  # fmt: skip
    (p, q), k = de.shape, moved.shape[1]
    for i in range(len(z)):
        for a in range(p):
            z[i] += gain[i, a] * e[a]
            for c in range(q):
                dz[i, c] += gain[i, a] * de[a, c]
            for c in range(k):
                dz[i, c] += dCP[a, i, c] * we[a] - gain[i, a] * moved[a, c]


@njit(cache=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)
def _forgotten(room: Room, lasting: int) -> bool:
    """Whether directions from `lasting` on move neither the innovation nor its covariance."""
    S, dS, de = room.here.S, room.here.dS, room.de
    for a in range(len(S)):
        for c in range(lasting, de.shape[1]):
            if not abs(de[a, c]) <= _FORGOTTEN * np.sqrt(S[a, a]):
                return False
        for c in range(lasting, dS.shape[2]):
            if not abs(dS[a, a, c]) <= _FORGOTTEN * S[a, a]:
                return False
    return True


@njit(cache=True, nogil=True)
def _inform(information: Buffer, de: Buffer, wde: Buffer, half: Buffer) -> None:
    """Add what one sample says, the lower half: of its mean de' S^-1 de, of its covariance."""
    for c in range(de.shape[1]):
        for a in range(len(de)):
            for d in range(c + 1):
                information[c, d] += de[a, c] * wde[a, d]
    for c in range(len(half)):
        for d in range(c + 1):
            information[c, d] += half[c, d]


@njit(cache=True, inline="always")
def expected_command(clip: Clip, room: Room, at: int, u: Buffer) -> tuple[Clipped, float]:
    """What is expected of a command, and the deviation of what the person would do without bounds.

    `u` (1,).
    """
    slope, here, seen, weighed = room.slope, room.here, room.seen, room.weighed
    n = slope.shape[1]
    seen[:], weighed[:], variance = 0.0, 0.0, 0.0
    seen[at : at + n] = slope[0]
    for i in range(len(seen)):
        for j in range(at, at + n):
            weighed[i] += here.left[i, j] * seen[j]
        variance += seen[i] * weighed[i]
    s = np.sqrt(max(variance, 0.0))
    return clipped(clip, u[0], s), s


@njit(cache=True, inline="always")
def clip_command(
    found: Clipped, s: float, joint: JointLoop, djoint: JointLoop, room: Room, at: int, u: Buffer
) -> None:
    """Command and slope become those that are expected of a clipped command; see `Clip`.

    The variance that no slope explains goes to the first row of the room's noise.

    `u` (1,).
    """
    slope, dslope, du = room.slope, room.dslope, room.du
    noise, dnoise, weighed, ds = room.noise[0], room.dnoise[0], room.weighed, room.ds
    n, k = slope.shape[1], dslope.shape[2]
    noise[0], dnoise[0] = found.variance, 0.0
    if not found.near:
        return
    ds[:] = 0.0
    if found.inside_g != 0.0 or found.inside_s != 0.0:
        changes = variance_changes(joint, djoint, room)
        for c in range(k):
            ds[c] = changes[c] / (2 * s)
        for i in range(n):
            for c in range(k):
                ds[c] += dslope[0, i, c] * weighed[at + i] / s
    for c in range(k):
        dnoise[0, c] = found.variance_g * du[0, c] + found.variance_s * ds[c]
    for i in range(n):
        for c in range(k):
            turned = found.inside_g * du[0, c] + found.inside_s * ds[c]
            dslope[0, i, c] = found.inside * dslope[0, i, c] + turned * slope[0, i]
    du *= found.inside
    for c in range(k):
        du[0, c] += found.value_s * ds[c]
    u[0] = found.value
    slope *= found.inside


@njit(cache=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)
def share_noise(
    share: Buffer, dshare: Buffer, u: Buffer, du: Buffer, noise: Buffer, dnoise: Buffer
) -> None:
    """Write the variance of noise that is a share of the commands, and its derivatives.

    `share` (m,); `dshare` (m, k); `u` (m,); `du` (m, q); `noise` (m,); `dnoise` (m, k).
    """
    for a in range(len(u)):
        noise[a] = (share[a] * u[a]) ** 2
        for c in range(dnoise.shape[1]):
            change = share[a] * du[a, c] + dshare[a, c] * u[a]
            dnoise[a, c] = 2 * share[a] * u[a] * change


@njit(cache=True, inline="always")
def ahead(
    joint: JointLoop,
    djoint: JointLoop,
    room: Room,
    u: Buffer,
    disturbance: Buffer,
    z: Buffer,
    dz: Buffer,
) -> None:
    """z becomes F z + B u + E d, and dz its derivative.

    `u` (m,); `disturbance` (d,); `z` (z,); `dz` (z, q).
    """
    F, B, E, du, moves, q = joint.F, joint.B, joint.E, room.du, room.moves, dz.shape[1]
    before, dbefore = room.before, room.dbefore
    before[:], dbefore[:] = z, dz
    for i in range(len(z)):
        z[i] = 0.0
        for j in range(len(z)):
            z[i] += F[i, j] * before[j]
        for a in range(len(u)):
            z[i] += B[i, a] * u[a]
        for a in range(len(disturbance)):
            z[i] += E[i, a] * disturbance[a]
    if q == 0:
        return
    combine(F, dbefore, 0, dz)
    for i in range(len(z)):
        for a in range(len(u)):
            if B[i, a] != 0.0:
                for c in range(q):
                    dz[i, c] += B[i, a] * du[a, c]
    first, width = moves.first, moves.width
    for j in range(len(moves.column)):
        moved = before[moves.column[j]]
        for i in range(len(z)):
            for c in range(width):
                dz[i, first + c] += moved * moves.F[j, i * width + c]
    if moves.plant:
        dB, dE, k = djoint.B, djoint.E, djoint.B.shape[2]
        for i in range(len(z)):
            for c in range(k):
                for a in range(len(u)):
                    dz[i, c] += dB[i, a, c] * u[a]
                for a in range(len(disturbance)):
                    dz[i, c] += dE[i, a, c] * disturbance[a]
