"""Compiled code: the filter of plant and estimate together, with its exact derivatives.

The filter is that of `joint_likelihood` (docs/noisy-people.md). numba's cache looks at this file
only: a change of another one whose functions are called must change `COMPILED_WITH` below, which
tests/control/test_joint_likelihood.py asks for.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from impc.arrays import Buffer
from impc.borrowed import borrowed
from impc.control.compiled_clip import Clip, clipped
from impc.control.compiled_covariance import (
    Covariance,
    Moves,
    advance,
    covariance,
    moves_of,
    variance_changes,
    weigh,
)
from impc.control.compiled_loop import LoopMatrices, Workspace, law, workspace
from impc.control.compiled_products import combine
from impc.control.compiled_slope import slope_of_law
from impc.control.constraint_rows import RowDirections, Rows
from impc.control.joint_loop import JointLoop
from impc.jit import njit

__all__ = [
    "COMPILED_WITH",
    "FilterResult",
    "Room",
    "Steady",
    "filter_room",
    "run_filter",
    "run_person",
]

#: First digits of the SHA-256 of each file whose functions are called.
COMPILED_WITH = {
    "borrowed": "f9ef79e3bd6dacdb",
    "compiled_clip": "4b317b8d6c67db13",
    "compiled_covariance": "3bb8c6da99fea449",
    "compiled_loop": "9f871626bc4c54b4",
    "compiled_products": "19e7f22bf8fd60eb",
    "compiled_slope": "214c56a85ed59fe1",
}

_SOFTENED, _DIVERGED = 2, 5
# An expectation beyond this ends the filter.
_LARGEST = 1e100
# The covariance is taken for the stationary one when no entry differs by more than this, of the
# deviations of its row and column; nor its derivative by more than the second.
_STEADY, _STEADY_SLOPE = 1e-10, 1e-8
# A first state is forgotten when none of its directions moves an innovation by more than this, of
# its deviation.
_FORGOTTEN = 1e-11


class Steady(NamedTuple):
    """The stationary filter where no bound is active, and its derivatives along k directions.

    Attributes
    ----------
    P, dP : Buffer
        Covariance of z given all earlier outputs (z, z), and (z, z, k).
    known : bool
        Whether there is one.
    """

    P: Buffer
    dP: Buffer
    known: bool


class FilterResult(NamedTuple):
    """What the filter writes, sample by sample.

    Attributes
    ----------
    told : Buffer
        Log-likelihood of each sample given the earlier ones (samples,).
    score : Buffer
        Its derivatives along the q directions (samples, q).
    information : Buffer
        Sum of their expected products (q, q), the lower half.
    innovation, spread : Buffer
        Recorded outputs minus what is expected (samples, p), and their covariance (samples, p, p).
    filtered : Buffer
        Expected z given all outputs so far (samples, z).
    u : Buffer
        Command expected there (samples, m).
    status : Buffer
        Of each sample: the value of `closed_loop.Status` (samples,).
    counted : int
        The first sample that is told: those before it tell nothing, and are what the others are
        told given.
    """

    told: Buffer
    score: Buffer
    information: Buffer
    innovation: Buffer
    spread: Buffer
    filtered: Buffer
    u: Buffer
    status: Buffer
    counted: int


class Room(NamedTuple):
    """What a filter works in along q directions, of which the first k move covariances.

    Attributes
    ----------
    work : Workspace
        Of the law.
    lam, du : Buffer
        Multipliers (r,), and derivatives of the commands (m, q).
    noise, dnoise : Buffer
        Variances as in `advance` (2, m), and their derivatives (2, m, k).
    here : Covariance
        Of z, before the sample that is next.
    moves : Moves
        What the k directions move.
    """

    work: Workspace
    lam: Buffer
    du: Buffer
    noise: Buffer
    dnoise: Buffer
    here: Covariance
    moves: Moves


@njit(cache=True)
def filter_room(
    rows: Rows, joint: JointLoop, djoint: JointLoop, P: Buffer, dP: Buffer, q: int
) -> Room:
    """Room for a filter.

    Parameters
    ----------
    rows, joint, djoint
        As in `run_filter`.
    P, dP : Buffer
        Covariance of z before the sample that is next (z, z), and its derivatives (z, z, k).
    q : int
        How many directions there are.
    """
    m, k = joint.B.shape[1], dP.shape[2]
    here, moves = covariance(P, dP, len(joint.C)), moves_of(djoint, k)
    weigh(joint, djoint, moves, here)
    return Room(
        workspace(rows, m, q),
        np.zeros(len(rows.b)),
        np.empty((m, q)),
        np.zeros((2, m)),
        np.zeros((2, m, k)),
        here,
        moves,
    )


@njit(cache=True, nogil=True)
def run_filter(
    loop: LoopMatrices,
    dloop: LoopMatrices,
    rows: Rows,
    drows: RowDirections,
    unit: Buffer,
    clip: Clip,
    joint: JointLoop,
    djoint: JointLoop,
    steady: Steady,
    at: int,
    shared: int,
    outputs: Buffer,
    disturbance: Buffer,
    z: Buffer,
    dz: Buffer,
    room: Room,
    result: FilterResult,
    first: int,
) -> int:
    """Filter one recording; directions that move covariances stand first among all q.

    Parameters
    ----------
    loop, dloop, rows, drows, unit
        Of the controller's law, as in `compiled_loop.run`, along all q directions; unit (m,).
    clip : Clip
        What is done to the law's command.
    joint, djoint : JointLoop
        The system, and its derivatives along the first k directions.
    steady : Steady
        The stationary filter.
    at : int
        Where the estimate stands in z.
    shared : int
        How many directions, the first ones, move more than the first state.
    outputs, disturbance : Buffer
        (samples, p) and (samples, d).
    z, dz : Buffer
        Expected state at the first sample (z,) and its derivatives (z, q); overwritten.
    room : Room
        Overwritten.
    result : FilterResult
        Written.
    first : int
        The first sample.

    Returns
    -------
    int
        The sample at which it ended: all when it came to the end; one whose status has been
        written, at which the law has no answer or the state leaves every range; or the first one
        that remembers nothing of the first state, from where `shared` directions are enough.
    """
    # The caller keeps all of these while this runs.
    loop, dloop, rows, drows, unit = borrowed((loop, dloop, rows, drows, unit))
    joint, djoint, steady, room, result = borrowed((joint, djoint, steady, room, result))
    outputs, disturbance, z, dz = borrowed((outputs, disturbance, z, dz))
    work, lam, du, here, moves = room.work, room.lam, room.du, room.here, room.moves
    noise, dnoise = room.noise, room.dnoise
    n, k = loop.K.shape[1], here.dP.shape[2]
    settled, quiet = False, 0
    for t in range(first, len(outputs)):
        if quiet > 2 * len(z) and dz.shape[1] > shared:
            return t
        forgotten = _update(joint, djoint, moves, here, outputs[t], z, dz, result, t, shared)
        quiet = quiet + 1 if forgotten else 0
        u, x, dx = result.u[t], z[at : at + n], dz[at : at + n]
        status, _, _ = law(loop, dloop, rows, drows, unit, work, x, dx, lam, False, u, du)
        if status > _SOFTENED:
            result.status[t] = status
            return t
        slope, dslope = slope_of_law(loop, dloop, rows, drows, work, k)
        met = status > 0
        if clip.used:
            beyond, near = _clip(
                clip, joint, djoint, moves, here, at, slope, dslope, u, du, noise[0], dnoise[0]
            )
            status, met = max(status, beyond), met or near
        result.status[t] = status
        if not settled or met:
            _share(joint.share, djoint.share, u, du, noise[1], dnoise[1])
            advance(joint, djoint, moves, here, slope, dslope, at, noise, dnoise)
            settled = steady.known and not met and _near(here, steady)
            if settled:
                here.P[:], here.dP[:] = steady.P, steady.dP[:, :, :k]
            weigh(joint, djoint, moves, here)
        _ahead(joint, djoint, moves, u, du, disturbance[t], z, dz)
        if not np.max(np.abs(z)) < _LARGEST:
            result.status[t] = _DIVERGED
            return t
    return len(outputs)


@njit(cache=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)
def _share(
    share: Buffer, dshare: Buffer, u: Buffer, du: Buffer, noise: Buffer, dnoise: Buffer
) -> None:
    """Write the variance of noise that is a share of the commands, and its derivatives."""
    for a in range(len(u)):
        noise[a] = (share[a] * u[a]) ** 2
        for c in range(dnoise.shape[1]):
            change = share[a] * du[a, c] + dshare[a, c] * u[a]
            dnoise[a, c] = 2 * share[a] * u[a] * change


@njit(cache=True, inline="always")
def _clip(
    clip: Clip,
    joint: JointLoop,
    djoint: JointLoop,
    moves: Moves,
    here: Covariance,
    at: int,
    slope: Buffer,
    dslope: Buffer,
    u: Buffer,
    du: Buffer,
    noise: Buffer,
    dnoise: Buffer,
) -> tuple[int, bool]:
    """Command and slope become those that are expected of a clipped command; see `Clip`.

    Returns whether the command itself is beyond a bound, and whether a bound is anywhere near. The
    variance that no slope explains goes to noise[0], its derivatives to dnoise[0].
    """
    n, k = slope.shape[1], dslope.shape[2]
    seen = np.zeros(len(here.P))
    seen[at : at + n] = slope[0]
    weighed = here.left @ seen
    s = np.sqrt(max(np.dot(seen, weighed), 0.0))
    found = clipped(clip, u[0], s)
    noise[0], dnoise[0] = found.variance, 0.0
    if not found.near:
        return 0, False
    ds, turned = np.zeros(k), np.zeros(k)
    if found.inside_g != 0.0 or found.inside_s != 0.0:
        ds += variance_changes(joint, djoint, moves, here, seen) / (2 * s)
        for i in range(n):
            for c in range(k):
                ds[c] += dslope[0, i, c] * weighed[at + i] / s
    for c in range(k):
        turned[c] = found.inside_g * du[0, c] + found.inside_s * ds[c]
        dnoise[0, c] = found.variance_g * du[0, c] + found.variance_s * ds[c]
    for i in range(n):
        for c in range(k):
            dslope[0, i, c] = found.inside * dslope[0, i, c] + turned[c] * slope[0, i]
    du *= found.inside
    for c in range(k):
        du[0, c] += found.value_s * ds[c]
    u[0] = found.value
    slope *= found.inside
    return found.beyond, True


@njit(cache=True, nogil=True)
def _inform(information: Buffer, de: Buffer, wde: Buffer, half: Buffer) -> None:
    """Add what one sample tells, the lower half: of its mean de' S^-1 de, of its covariance."""
    for c in range(de.shape[1]):
        for a in range(len(de)):
            for d in range(c + 1):
                information[c, d] += de[a, c] * wde[a, d]
    for c in range(len(half)):
        for d in range(c + 1):
            information[c, d] += half[c, d]


@njit(cache=True, inline="always")
def _update(
    joint: JointLoop,
    djoint: JointLoop,
    moves: Moves,
    here: Covariance,
    output: Buffer,
    z: Buffer,
    dz: Buffer,
    result: FilterResult,
    t: int,
    shared: int,
) -> bool:
    """Likelihood and score of one sample; z and dz become those given the sample.

    Returns whether directions from `shared` on move the innovation and its covariance by nothing.
    """
    C, dC, S, inverse, gain = joint.C, djoint.C, here.S, here.inverse, here.gain
    dCP, dS = here.dCP, here.dS
    size, p, k, q = len(z), len(output), dS.shape[2], dz.shape[1]
    e, de = output - C @ z, np.zeros((p, q))
    for a in range(p):
        for i in range(size):
            if C[a, i] != 0.0:
                for c in range(q):
                    de[a, c] -= C[a, i] * dz[i, c]
            if moves.plant:
                for c in range(k):
                    de[a, c] -= dC[a, i, c] * z[i]
    weighed = inverse @ e
    result.innovation[t], result.spread[t] = e, S
    result.told[t] = -(np.dot(e, weighed) + here.volume[0] + p * np.log(2 * np.pi)) / 2
    wde = inverse @ de
    score, moved = result.score[t, :q], np.zeros((p, k))
    score[:] = -(weighed @ de)
    for a in range(p):
        for b in range(p):
            apart = (weighed[a] * weighed[b] - inverse[a, b]) / 2
            for c in range(k):
                score[c] += apart * dS[a, b, c]
                moved[a, c] += dS[a, b, c] * weighed[b]
    if t < result.counted:
        result.told[t], score[:] = 0.0, 0.0
    else:
        _inform(result.information, de, wde, here.half)
    # The gain is P C'S^-1: with w = S^-1 e it moves by (dP C' w - gain dS w) where it is applied.
    for i in range(size):
        for a in range(p):
            z[i] += gain[i, a] * e[a]
            for c in range(q):
                dz[i, c] += gain[i, a] * de[a, c]
            for c in range(k):
                dz[i, c] += dCP[a, i, c] * weighed[a] - gain[i, a] * moved[a, c]
    result.filtered[t] = z
    for a in range(p):
        for c in range(shared, q):
            if not abs(de[a, c]) <= _FORGOTTEN * np.sqrt(S[a, a]):
                return False
        for c in range(shared, k):
            if not abs(dS[a, a, c]) <= _FORGOTTEN * S[a, a]:
                return False
    return True


@njit(cache=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)
def _near(here: Covariance, steady: Steady) -> bool:
    """Whether covariance and derivative are the stationary ones, but for what is left out."""
    for i in range(len(here.P)):
        for j in range(len(here.P)):
            unit = np.sqrt(steady.P[i, i] * steady.P[j, j])
            if not abs(here.P[i, j] - steady.P[i, j]) <= _STEADY * unit:
                return False
            for c in range(here.dP.shape[2]):
                if not abs(here.dP[i, j, c] - steady.dP[i, j, c]) <= _STEADY_SLOPE * unit:
                    return False
    return True


@njit(cache=True, inline="always")
def _ahead(
    joint: JointLoop,
    djoint: JointLoop,
    moves: Moves,
    u: Buffer,
    du: Buffer,
    disturbance: Buffer,
    z: Buffer,
    dz: Buffer,
) -> None:
    """z becomes F z + B u + E d, and dz its derivative."""
    before, dbefore, q = z.copy(), dz.copy(), dz.shape[1]
    z[:] = joint.F @ before + joint.B @ u + joint.E @ disturbance
    if q == 0:
        return
    B = joint.B
    combine(joint.F, dbefore, 0, dz)
    for i in range(len(z)):
        for a in range(len(u)):
            if B[i, a] != 0.0:
                for c in range(q):
                    dz[i, c] += B[i, a] * du[a, c]
    moved = before[moves.column] @ moves.F
    for r in range(len(moved)):
        dz[moves.row[r], moves.along[r]] += moved[r]
    if moves.plant:
        dB, dE, k = djoint.B, djoint.E, djoint.B.shape[2]
        for i in range(len(z)):
            for c in range(k):
                for a in range(len(u)):
                    dz[i, c] += dB[i, a, c] * u[a]
                for a in range(len(disturbance)):
                    dz[i, c] += dE[i, a, c] * disturbance[a]


@njit(cache=True, nogil=True)
def run_person(
    loop: LoopMatrices,
    dloop: LoopMatrices,
    rows: Rows,
    drows: RowDirections,
    unit: Buffer,
    joint: JointLoop,
    at: int,
    disturbance: Buffer,
    noise: Buffer,
    shared: Buffer,
    z: Buffer,
    u: Buffer,
    status: Buffer,
) -> int:
    """Simulate from z[0] with noise that has been drawn, without derivatives.

    Parameters
    ----------
    loop, dloop, rows, drows, unit, joint, at
        As in `run_filter`, along no direction; unit (m,).
    disturbance, noise : Buffer
        (samples, d), and what is added to the next z (samples, z).
    shared : Buffer
        Normal numbers (samples, m), for the noise that is a share of the command.
    z, u, status : Buffer
        Written: (samples + 1, z) after the first, (samples, m) and (samples,).

    Returns
    -------
    int
        Samples before the one at which the law has no answer; all when it always has.
    """
    n = loop.K.shape[1]
    work = workspace(rows, u.shape[1], 0)
    lam, dx, du = np.zeros(len(rows.b)), np.zeros((n, 0)), np.zeros((u.shape[1], 0))
    for t in range(len(u)):
        x = z[t, at : at + n]
        status[t], _, _ = law(loop, dloop, rows, drows, unit, work, x, dx, lam, False, u[t], du)
        if status[t] > _SOFTENED:
            return t
        z[t + 1] = joint.F @ z[t] + joint.B @ u[t] + joint.E @ disturbance[t] + noise[t]
        z[t + 1] += joint.G @ (joint.share * u[t] * shared[t])
        if not np.max(np.abs(z[t + 1])) < _LARGEST:
            status[t] = _DIVERGED
            return t
    return len(u)
