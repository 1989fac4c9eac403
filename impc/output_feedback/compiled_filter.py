"""Compiled code: the filter of plant and estimate, of many trials at once, with its derivatives.

The filter is that of `likelihood` (docs/noisy-people.md), a sample of it that of
`compiled_sample`. While no bound is near, what is recorded changes no covariance, so that trials
share one: it is most of what a filter costs.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from impc.arrays import Buffer
from impc.control.compiled_kernel import DIVERGED, LARGEST, SOFTENED, LoopMatrices, law
from impc.control.constraint_rows import RowDirections, Rows
from impc.jit import njit
from impc.output_feedback.compiled_clip import Clip
from impc.output_feedback.compiled_covariance import advance, weigh
from impc.output_feedback.compiled_room import Covariance, Room
from impc.output_feedback.compiled_sample import (
    FilterResult,
    ahead,
    clip_command,
    expected_command,
    share_noise,
    update,
)
from impc.output_feedback.compiled_slope import slope_of_law
from impc.output_feedback.joint_loop import JointLoop

# The covariance is taken for the stationary one when no entry differs by more than this, of the
# deviations of its row and column; nor its derivative by more than the second.
_STEADY, _STEADY_SLOPE = 1e-10, 1e-8


class Steady(NamedTuple):
    """The stationary filter where no bound is active, and its derivatives along k directions."""

    P: Buffer  # Covariance of z given all earlier outputs (z, z), and (z, z, k)
    dP: Buffer
    known: bool  # Whether there is one


class Course(NamedTuple):
    """Trials that are filtered together, and where each leaves."""

    begin: Buffer  # The row at which each trial begins, and the one after the last (trials + 1,)
    first: int  # The sample at which all are
    corrected: bool  # Whether z knows the outputs of that sample
    # Whether trials share a covariance, and leave where a bound is near; one alone need not
    shared: bool
    reached: Buffer  # Written: the sample at which each leaves, or how many it has (trials,)
    known: Buffer  # Written: whether its z knows the outputs of that sample (trials,)
    # Covariance before the first sample (trials, z, z), and its derivatives (trials, z, z, k);
    # written, of each that leaves before its end: those before the sample at which it does
    P: Buffer
    dP: Buffer


class FilterParts(NamedTuple):
    """What is filtered with, along q directions of which the first k move covariances."""

    # Of the controller's law, as in `compiled_kernel.run`, along all q directions; unit (m,)
    loop: LoopMatrices
    dloop: LoopMatrices
    rows: Rows
    drows: RowDirections
    unit: Buffer
    clip: Clip  # What is done to the law's command
    joint: JointLoop  # The system, and its derivatives along the first k directions
    djoint: JointLoop
    steady: Steady  # The stationary filter
    at: int  # Where the estimate stands in z
    lasting: int  # How many directions, the first ones, move more than the first state


@njit(cache=True, nogil=True)
def run_filter(
    parts: FilterParts,
    outputs: Buffer,
    disturbance: Buffer,
    z: Buffer,
    dz: Buffer,
    room: Room,
    result: FilterResult,
    course: Course,
) -> None:
    """Filter trials from the sample at which all are.

    A trial leaves at its end; at a sample whose status has been written, at which the law has no
    answer or the state leaves every range; at the first one at which a bound is near, where
    covariances are shared; and where they are not, at the first one that remembers nothing of the
    first state, from where `lasting` directions are enough.

    `outputs` (rows, p); `disturbance` (rows, d); `z` (trials, z); `dz` (trials, z, q).
    """
    u, here, joint, djoint, lasting = room.u, room.here, parts.joint, parts.djoint, parts.lasting
    begin, reached, first, at = course.begin, course.reached, course.first, parts.at
    n = parts.loop.K.shape[1]
    settled, quiet, left, t = False, 0, len(reached), first
    reached[:] = begin[1:] - begin[:-1]
    course.known[:] = False
    weigh(joint, djoint, room)
    while left > 0:
        met, left = False, 0
        for i in range(len(reached)):
            row = begin[i] + t
            if t >= reached[i]:
                continue
            if not (t == first and course.corrected):
                if quiet > 2 * z.shape[1] and dz.shape[2] > lasting:
                    _leave(course, here, i, t, False)
                    continue
                forgotten = update(
                    joint, djoint, room, outputs[row], z[i], dz[i], result, i, row, t, lasting
                )
                quiet = quiet + 1 if forgotten and not course.shared else 0
            x, dx = z[i, at : at + n], dz[i, at : at + n]
            status, near = _command(parts, room, course.shared, x, dx)
            result.u[row], result.status[row] = u, status
            if status > SOFTENED:
                reached[i] = t
                continue
            if course.shared and near:
                _leave(course, here, i, t, True)
                continue
            met = met or near
            ahead(joint, djoint, room, u, disturbance[row], z[i], dz[i])
            if not np.max(np.abs(z[i])) < LARGEST:
                result.status[row], reached[i] = DIVERGED, t
                continue
            left += 1
        if left > 0 and (not settled or met):
            settled = _advanced(parts, room, met)
        t += 1


@njit(cache=True, inline="always")
def _command(
    parts: FilterParts, room: Room, shared: bool, x: Buffer, dx: Buffer
) -> tuple[int, bool]:
    """The room has what is expected of a command, but of one near a bound if that is to be shared.

    The estimate x (n,) and its derivatives (n, q) are those that are expected. Returns the status,
    and whether a bound is near.
    """
    loop, dloop, rows, drows, unit = parts.loop, parts.dloop, parts.rows, parts.drows, parts.unit
    work, lam, u, du = room.work, room.lam, room.u, room.du
    status, _, _ = law(loop, dloop, rows, drows, unit, work, x, dx, lam, False, u, du)
    near = status > 0
    if status > SOFTENED or (shared and near):
        return status, near
    slope_of_law(loop, dloop, rows, drows, work, room.slope, room.dslope)
    if parts.clip.used:
        found, s = expected_command(parts.clip, room, parts.at, u)
        near = near or found.near
        if not (shared and near):
            clip_command(found, s, parts.joint, parts.djoint, room, parts.at, u)
            status = max(status, found.beyond)
    return status, near


@njit(cache=True, inline="always")
def _advanced(parts: FilterParts, room: Room, met: bool) -> bool:
    """The covariance becomes that of the next sample; whether it is the stationary one."""
    here, noise, dnoise = room.here, room.noise[1], room.dnoise[1]
    joint, djoint, steady = parts.joint, parts.djoint, parts.steady
    share_noise(joint.share, djoint.share, room.u, room.du, noise, dnoise)
    advance(joint, djoint, room, parts.at)
    settled = steady.known and not met and _near(here, steady)
    if settled:
        here.P[:], here.dP[:] = steady.P, steady.dP[:, :, : here.dP.shape[2]]
    weigh(joint, djoint, room)
    return settled


@njit(cache=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)
def _leave(course: Course, here: Covariance, i: int, t: int, known: bool) -> None:
    """One trial leaves at a sample, with the covariance before it."""
    course.reached[i], course.known[i] = t, known
    course.P[i], course.dP[i] = here.P, here.dP


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
