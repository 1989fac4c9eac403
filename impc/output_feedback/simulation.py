"""Plant, sensorimotor model and recording as one linear system, and its simulation.

With the error e = x - xh of the estimate the state is z = (e, xh, dh), or z = x for a subject who
observes every state exactly, and

    z+ = F z + B u + E d + G w + noise of covariance Q,    u = MPC(xh),    y = C z + noise of R

where only u depends on the controller. As the command does not affect the error, F has blocks:

    e+  = (A - L C_s) e - E dh + E d + B w + p - L v      (with a known perturbation: without E)
    xh+ = A xh + E dh + B u + L C_s e + L v
    dh+ = r dh + L_d C_s e + L_d v      (r: assumed AR(1) coefficient, 1 for a random walk)

At the first sample the estimate is given, and the error has its stationary covariance
(docs/why/output_feedback.md).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from impc.arrays import Array, Frozen, finite_array, frozen
from impc.checking import checked
from impc.control.aims import aim_of
from impc.control.closed_loop import PreparedLoop, prepare_loop
from impc.control.compiled_values import Aim, workspace
from impc.control.constraint_rows import directions
from impc.control.controller import Controller
from impc.control.simulation import Status, scenario
from impc.model.plant import Plant
from impc.model.riccati import lyapunov_series
from impc.output_feedback.compiled_filter import JointLoop, Trace, run_noisy
from impc.output_feedback.observer import (
    Body,
    Observer,
    believed_filter,
    believed_matrices,
    diagonal,
    filter_changes,
    moving_noise,
)

# Complex step: its square vanishes next to 1.
_STEP = 1e-30j


def joint_loop(plant: Plant, person: Observer, recorder: Array) -> JointLoop:
    """Assemble the system of `person` and `plant`, with `recorder` noise SDs (p,)."""
    L = believed_filter(plant, person).L if person.estimates else None
    body = Body(plant.A, plant.B, plant.E, plant.C)
    found = _assembled(body, person, [*person.by_kind, np.asarray(recorder)], L)
    if person.estimates:
        own = _apart(plant, person)
        alone = lyapunov_series(own.T @ found.F @ own, (own.T @ found.Q @ own)[None])[0]
        found = found._replace(P0=own @ alone @ own.T)
    return found


def joint_directions(
    plant: Plant, person: Observer, recorder: Array, moves: Body, levels: Array
) -> JointLoop:
    """Derivatives of `joint_loop` along k directions; the subject's model follows the plant.

    The equations, except two, are products: a complex step is exact (Squire and Trapp 1998).
    `recorder` (p,); `levels` (k, levels + p).
    """
    each = [*person.by_kind, np.asarray(recorder)]
    moved = np.split(levels, np.cumsum([len(level) for level in each])[:-1], axis=1)
    given = plant.A, plant.B, plant.E, plant.C
    body = Body(*(part + _STEP * change for part, change in zip(given, moves, strict=True)))
    changed = [level + _STEP * change for level, change in zip(each, moved, strict=True)]
    if not person.estimates:
        return _slopes(_assembled(body, person, changed, None))
    F, C, _, _ = believed_matrices(plant, person)
    dF, _, dQ, dR = (
        np.imag(part) / _STEP.imag for part in believed_matrices(body, person, changed[:-1])
    )
    believed, dC = believed_filter(plant, person), np.zeros((len(levels), *C.shape))
    L = believed.L + _STEP * filter_changes(believed, (F, C), (dF, dC, dQ, dR)).L
    change, here = (
        _slopes(_assembled(body, person, changed, L)),
        joint_loop(plant, person, recorder),
    )
    own = _apart(plant, person)
    turned = own.T @ (change.F @ here.P0 @ here.F.T) @ own
    right = turned + turned.transpose(0, 2, 1) + own.T @ change.Q @ own
    alone = lyapunov_series(own.T @ here.F @ own, right)
    return change._replace(P0=own @ alone @ own.T)


def _apart(plant: Plant, person: Observer) -> Array:
    """Unit vectors of what no command affects in z: error and perturbation estimate."""
    n, d = plant.n, 0 if person.walk is None else plant.E.shape[1]
    return np.delete(np.eye(2 * n + d), np.s_[n : 2 * n], axis=1)


def _assembled(body: Body, person: Observer, levels: list[Array], L: Array | None) -> JointLoop:
    """Assemble the system without P0; arrays may be complex, with k directions as first axis."""
    (A, B, E, C), (motor, share, process, sensory, _, white) = body, levels
    moved, R = moving_noise(B, motor, process), diagonal(white**2)
    if L is None:
        return _contiguous(A, B, E, B, C, moved, R, np.zeros_like(moved), share)
    n, d = A.shape[-1], 0 if person.walk is None else E.shape[-1]
    error, estimate, walk = np.split(np.eye(2 * n + d), [n, 2 * n], axis=1)
    entry = (estimate - error) @ L[..., :n, :] + walk @ L[..., n:, :]
    F = entry @ person.C @ error.T + error @ A @ error.T + estimate @ A @ estimate.T
    if person.walk is not None:
        F += (estimate - error) @ E @ walk.T + walk @ np.diag(person.persistence) @ walk.T
    into = (estimate if person.walk is None else error) @ E
    Q = entry @ diagonal(sensory**2) @ np.swapaxes(entry, -1, -2) + error @ moved @ error.T
    seen = C @ (error + estimate).T
    return _contiguous(F, estimate @ B, into, error @ B, seen, Q, R, np.zeros_like(Q), share)


def _slopes(found: JointLoop) -> JointLoop:
    return _contiguous(*(part.imag / _STEP.imag for part in found))


def _contiguous(*parts: Array) -> JointLoop:
    return JointLoop(*(np.array(part, order="C") for part in parts))


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
) -> Trace:
    """Simulate states of plant and estimate, and commands, for given noise samples."""
    steps, (m, n) = len(disturbance), law.controller.K.shape
    z, u = np.zeros((steps + 1, len(start))), np.zeros((steps, m))
    z[0] = start
    trace = Trace(z, u, np.full(steps, Status.NOT_REACHED, dtype=np.int8))
    parts = law.matrices, law.matrix_directions, law.rows, law.row_directions, law.unit
    at = 0 if len(start) == n else n
    work = workspace(law.rows, law.row_directions, m)
    reached = run_noisy(*parts, joint, at, (disturbance, *noise), aim, trace, work)
    z[reached + 1 :], u[reached:] = z[reached], u[max(reached - 1, 0)]
    return trace


def _root(covariance: Array) -> Array:
    """Symmetric A with A A' the covariance; unique, so that draws are reproducible."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T)
