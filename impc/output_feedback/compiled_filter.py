"""Compiled code: the filter of plant and estimate of one trial, with its derivatives.

The filter is that of `likelihood` (docs/noisy-people.md), a sample of it that of
`compiled_sample`. While no bound is near the covariance, which is most of what a filter costs,
soon stands still.
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
    first: int,
) -> int:
    """Filter one trial from the first sample on; returns the sample at which it ends.

    It ends after the last sample; at one whose status has been written, at which the law has no
    answer or the state leaves every range; and at the first one that remembers nothing of the first
    state, from where `lasting` directions are enough. Until there the room has the covariance.

    `outputs` (samples, p); `disturbance` (samples, d); `z` (z,); `dz` (z, q).
    """
    u, joint, djoint, at = room.u, parts.joint, parts.djoint, parts.at
    n = parts.loop.K.shape[1]
    settled, quiet = False, 0
    weigh(joint, djoint, room)
    for t in range(first, len(outputs)):
        if quiet > 2 * len(z) and dz.shape[1] > parts.lasting:
            return t
        forgotten = update(joint, djoint, room, outputs[t], z, dz, result, t, parts.lasting)
        quiet = quiet + 1 if forgotten else 0
        status, near = _command(parts, room, z[at : at + n], dz[at : at + n])
        result.u[t], result.status[t] = u, status
        if status > SOFTENED:
            return t
        ahead(joint, djoint, room, u, disturbance[t], z, dz)
        if not np.max(np.abs(z)) < LARGEST:
            result.status[t] = DIVERGED
            return t
        if not settled or near:
            settled = _advanced(parts, room, near)
    return len(outputs)


@njit(cache=True, inline="always")
def _command(parts: FilterParts, room: Room, x: Buffer, dx: Buffer) -> tuple[int, bool]:
    """The room has what is expected of a command.

    The estimate x (n,) and its derivatives (n, q) are those that are expected. Returns the status,
    and whether a bound is near.
    """
    loop, dloop, rows, drows, unit = parts.loop, parts.dloop, parts.rows, parts.drows, parts.unit
    work, lam, u, du = room.work, room.lam, room.u, room.du
    status, _, _ = law(loop, dloop, rows, drows, unit, work, x, dx, lam, False, u, du)
    near = status > 0
    if status > SOFTENED:
        return status, near
    slope_of_law(loop, dloop, rows, drows, work, room.slope, room.dslope)
    if parts.clip.used:
        found, s = expected_command(parts.clip, room, parts.at, u)
        near = near or found.near
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
