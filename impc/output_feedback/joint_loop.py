"""Plant, sensorimotor model and recording as one linear system of plant state and estimate.

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

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from impc.arrays import Array, Buffer
from impc.model.riccati import lyapunov_series
from impc.output_feedback.observer import (
    Body,
    believed_filter,
    believed_matrices,
    diagonal,
    filter_changes,
    moving_noise,
)

if TYPE_CHECKING:
    from impc.model.plant import Plant
    from impc.output_feedback.observer import Observer

# Complex step: its square vanishes next to 1.
_STEP = 1e-30j


class JointLoop(NamedTuple):
    """System matrices, or their derivatives along k directions (first axis)."""

    F: Buffer  # (z, z), transition
    B: Buffer  # (z, m), commands
    E: Buffer  # (z, d), perturbations
    G: Buffer  # (z, m), motor noise
    C: Buffer  # (p, z)
    Q: Buffer  # (z, z), covariance of the process noise
    R: Buffer  # (p, p), covariance of the recording noise
    P0: Buffer  # (z, z), covariance of the first state
    share: Buffer  # (m,), signal-dependent motor noise as a share of the command


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
