"""Simulate a trial of a subject with noisy senses: `joint_loop` with all bounds, compiled."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from impc.arrays import Array, Buffer, Frozen, finite_array, frozen
from impc.checking import checked
from impc.control.aims import aim_of
from impc.control.closed_loop import prepare_loop
from impc.control.compiled_kernel import LARGEST, deviate, law, return_to, workspace
from impc.control.compiled_values import (
    DIVERGED,
    SOFTENED,
    Aim,
    LoopMatrices,
    RowDirections,
    Rows,
)
from impc.control.constraint_rows import directions
from impc.control.simulation import Status, scenario
from impc.jit import njit
from impc.output_feedback.joint_loop import JointLoop, joint_loop

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import ArrayLike

    from impc.control.closed_loop import PreparedLoop
    from impc.control.controller import Controller
    from impc.output_feedback.observer import Observer


@dataclass(frozen=True)
class PersonTrial(Frozen):
    """Movement and recording of a simulated subject."""

    outputs: Array  # (samples, p), recorded, with recording noise
    states: Array  # (samples, n), true states
    estimates: Array  # (samples, n), states as the subject estimates them
    u: Array  # (samples, m), commands without motor noise
    status: np.ndarray[tuple[int], np.dtype[np.int8]]  # (samples,), `Status`

    @property
    def reached(self) -> int:
        """Number of samples with a command; later samples repeat the last."""
        return int(np.count_nonzero(self.status <= Status.SOFTENED))


class _Trace(NamedTuple):
    """What a simulation writes."""

    z: Buffer  # (steps + 1, z)
    u: Buffer  # (steps, m)
    status: Buffer  # (steps,)


@checked(steps=(1, 10_000_000))
def simulate_person(
    controller: Controller,
    person: Observer,
    disturbance: ArrayLike | None = None,
    *,
    steps: int | None = None,
    recorder: ArrayLike = 0.0,
    x0: ArrayLike | None = None,
    target: Mapping[str, Any] | None = None,
    seed: Any = 0,
) -> PersonTrial:
    """Simulate one trial; `recorder` noise SDs (p,); `x0` (n,)."""
    plant, m = controller.plant, controller.plant.m
    given = scenario(plant, np.zeros(plant.n) if x0 is None else x0, steps, disturbance, target)
    rng, p = np.random.default_rng(seed), len(plant.outputs)
    white = finite_array("recorder", np.full(p, recorder, dtype=np.float64), (p,))
    joint = joint_loop(plant, person, white)
    at = slice(plant.n, 2 * plant.n) if person.estimates else slice(0, plant.n)
    start = _root(joint.P0) @ rng.standard_normal(len(joint.F))
    start[at] += given.x0
    noise = rng.standard_normal((given.steps, len(joint.F))) @ _root(joint.Q).T
    shared = rng.standard_normal((given.steps, m))
    law = prepare_loop(controller, directions(controller, 0), whole=True)
    aim = aim_of(controller, given, law.along)
    pushes = np.array(given.disturbance)
    z, u, status = run_joint(law, joint, start, pushes, aim, (noise, shared))
    estimates = z[:-1, at]
    states = estimates + z[:-1, : plant.n] if person.estimates else estimates
    outputs = states @ plant.C.T + white * rng.standard_normal((len(u), p))
    return PersonTrial(frozen(outputs), frozen(states), frozen(estimates), frozen(u), status)


def run_joint(
    law: PreparedLoop,
    joint: JointLoop,
    start: Array,
    disturbance: Array,
    aim: Aim,
    noise: tuple[Array, Array],
) -> _Trace:
    """Simulate states of plant and estimate, and commands, for given noise samples."""
    steps, (m, n) = len(disturbance), law.controller.K.shape
    z, u = np.zeros((steps + 1, len(start))), np.zeros((steps, m))
    z[0] = start
    trace = _Trace(z, u, np.full(steps, Status.NOT_REACHED, dtype=np.int8))
    parts = law.matrices, law.matrix_directions, law.rows, law.row_directions, law.unit
    at = 0 if len(start) == n else n
    reached = _run(*parts, joint, at, (disturbance, *noise), aim, trace)
    z[reached + 1 :], u[reached:] = z[reached], u[max(reached - 1, 0)]
    return trace


def _root(covariance: Array) -> Array:
    """Symmetric A with A A' the covariance; unique, so that draws are reproducible."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T)


@njit(cache=True, nogil=True)
def _run(
    loop: LoopMatrices,
    dloop: LoopMatrices,
    rows: Rows,
    drows: RowDirections,
    unit: Buffer,
    joint: JointLoop,
    at: int,
    driven: tuple[Buffer, Buffer, Buffer],
    aim: Aim,
    trace: _Trace,
) -> int:
    """Simulate from z[0]; `driven`: disturbance, noise, and noise in proportion to commands."""
    (z, u, status), (disturbance, noise, shared), n = trace, driven, loop.K.shape[1]
    work = workspace(rows, drows, u.shape[1])
    lam, dx, du = np.zeros(len(rows.b)), np.zeros((n, 0)), np.zeros((u.shape[1], 0))
    for t in range(len(u)):
        x = z[t, at : at + n].copy()
        deviate(aim, rows, drows, work, t, x, dx)
        status[t], _, _ = law(loop, dloop, rows, drows, unit, work, x, dx, lam, False, u[t], du)
        if status[t] > SOFTENED:
            return t
        return_to(aim, t, u[t], du)
        z[t + 1] = joint.F @ z[t] + joint.B @ u[t] + joint.E @ disturbance[t] + noise[t]
        z[t + 1] += joint.G @ (joint.share * u[t] * shared[t])
        if not np.max(np.abs(z[t + 1])) < LARGEST:
            status[t] = DIVERGED
            return t
    return len(u)
