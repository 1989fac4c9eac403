"""Compiled code: a person who senses with noise, simulated (docs/noisy-people.md)."""

from __future__ import annotations

import numpy as np

from impc.arrays import Buffer
from impc.control.compiled_kernel import DIVERGED, LARGEST, SOFTENED, LoopMatrices, law, workspace
from impc.control.constraint_rows import RowDirections, Rows
from impc.control.joint_loop import JointLoop
from impc.jit import njit

__all__ = ["run_person"]


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

    `loop, dloop, rows, drows, unit, joint, at` (m,); `disturbance` (samples, d); `noise`
    (samples, z); `shared` (samples, m); `z` (samples + 1, z); `u` (samples, m); `status`
    (samples,).
    """
    n = loop.K.shape[1]
    work = workspace(rows, u.shape[1], 0)
    lam, dx, du = np.zeros(len(rows.b)), np.zeros((n, 0)), np.zeros((u.shape[1], 0))
    for t in range(len(u)):
        x = z[t, at : at + n]
        status[t], _, _ = law(loop, dloop, rows, drows, unit, work, x, dx, lam, False, u[t], du)
        if status[t] > SOFTENED:
            return t
        z[t + 1] = joint.F @ z[t] + joint.B @ u[t] + joint.E @ disturbance[t] + noise[t]
        z[t + 1] += joint.G @ (joint.share * u[t] * shared[t])
        if not np.max(np.abs(z[t + 1])) < LARGEST:
            status[t] = DIVERGED
            return t
    return len(u)
