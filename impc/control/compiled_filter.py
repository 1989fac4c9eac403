"""Compiled code: the filter of plant and estimate together, with its exact derivatives.

The filter is that of `joint_likelihood` (docs/noisy-people.md), a sample of it that of
`compiled_sample`. numba's cache looks at this file only: a change of another one whose functions
are called must change `COMPILED_WITH` below, which tests/control/test_joint_likelihood.py asks for.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from impc.arrays import Buffer
from impc.borrowed import borrowed
from impc.control.compiled_arrays import DIVERGED, LARGEST, SOFTENED, LoopMatrices
from impc.control.compiled_clip import Clip
from impc.control.compiled_covariance import advance, weigh
from impc.control.compiled_law import law
from impc.control.compiled_room import Covariance, Room
from impc.control.compiled_sample import FilterResult, ahead, clip_command, share_noise, update
from impc.control.compiled_slope import slope_of_law
from impc.control.constraint_rows import RowDirections, Rows
from impc.control.joint_loop import JointLoop
from impc.jit import njit

__all__ = ["COMPILED_WITH", "Steady", "run_filter"]

#: First digits of the SHA-256 of each file whose functions are called.
COMPILED_WITH = {
    "borrowed": "f9ef79e3bd6dacdb",
    "compiled_arrays": "f9299fe715d0d2a3",
    "compiled_clip": "4b317b8d6c67db13",
    "compiled_covariance": "7d75cf433740ec3c",
    "compiled_law": "fb4d0617cbd31619",
    "compiled_room": "45595e764d61fc2a",
    "compiled_sample": "8872ef9655abd297",
    "compiled_slope": "1be8607182549482",
}

# The covariance is taken for the stationary one when no entry differs by more than this, of the
# deviations of its row and column; nor its derivative by more than the second.
_STEADY, _STEADY_SLOPE = 1e-10, 1e-8


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
    work, lam, du, here = room.work, room.lam, room.du, room.here
    n, k = loop.K.shape[1], here.dP.shape[2]
    settled, quiet = False, 0
    weigh(joint, djoint, room)
    for t in range(first, len(outputs)):
        if quiet > 2 * len(z) and dz.shape[1] > shared:
            return t
        forgotten = update(joint, djoint, room, outputs[t], z, dz, result, t, shared)
        quiet = quiet + 1 if forgotten else 0
        u, x, dx = result.u[t], z[at : at + n], dz[at : at + n]
        status, _, _ = law(loop, dloop, rows, drows, unit, work, x, dx, lam, False, u, du)
        if status > SOFTENED:
            result.status[t] = status
            return t
        slope_of_law(loop, dloop, rows, drows, work, room.slope, room.dslope)
        met = status > 0
        if clip.used:
            beyond, near = clip_command(clip, joint, djoint, room, at, u)
            status, met = max(status, beyond), met or near
        result.status[t] = status
        if not settled or met:
            share_noise(joint.share, djoint.share, u, du, room.noise[1], room.dnoise[1])
            advance(joint, djoint, room, at)
            settled = steady.known and not met and _near(here, steady)
            if settled:
                here.P[:], here.dP[:] = steady.P, steady.dP[:, :, :k]
            weigh(joint, djoint, room)
        ahead(joint, djoint, room, u, disturbance[t], z, dz)
        if not np.max(np.abs(z)) < LARGEST:
            result.status[t] = DIVERGED
            return t
    return len(outputs)


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
