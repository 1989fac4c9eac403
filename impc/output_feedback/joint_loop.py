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
from impc.output_feedback.kalman import filter_changes
from impc.output_feedback.observer import LEVELS, believed_filter, believed_matrices

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


class PlantMoves(NamedTuple):
    """Derivatives of a plant along k directions (first axis)."""

    A: Array  # (k, n, n)
    B: Array  # (k, n, m)
    E: Array  # (k, n, d)
    C: Array  # (k, p, n)


def joint_loop(plant: Plant, person: Observer, recorder: Array) -> JointLoop:
    """Assemble the system of `person` and `plant`, with `recorder` noise SDs (p,)."""
    L = believed_filter(plant, person).L if person.estimates else None
    body = PlantMoves(plant.A, plant.B, plant.E, plant.C)
    found = _assembled(body, person, [*_levels(person), np.asarray(recorder)], L)
    P0, own = np.zeros_like(found.F), _apart(plant, person)
    if person.estimates:
        P0[own] = lyapunov_series(found.F[own], found.Q[own][None])[0]
    return found._replace(P0=P0)


def joint_directions(
    plant: Plant, person: Observer, recorder: Array, moves: PlantMoves, levels: Array
) -> JointLoop:
    """Derivatives of `joint_loop` along k directions; the subject's model follows the plant.

    The equations, except two, are products: a complex step is exact (Squire and Trapp 1998).
    `recorder` (p,); `levels` (k, levels + p).
    """
    count, n, own = len(levels), plant.n, _apart(plant, person)
    each = [*_levels(person), np.asarray(recorder)]
    moved = np.split(levels, np.cumsum([len(level) for level in each])[:-1], axis=1)
    body = PlantMoves(
        *(part + _STEP * change for part, change in
          zip((plant.A, plant.B, plant.E, plant.C), moves, strict=True))
    )  # fmt: skip
    changed = [level + _STEP * change for level, change in zip(each, moved, strict=True)]
    L: Array | None = None
    if person.estimates:
        F, C, _, _ = believed_matrices(plant, person)
        dF, dQ = np.zeros((2, count, *F.shape))
        dF[:, :n, :n], dF[:, :n, n:] = moves.A, moves.E[:, :, : len(F) - n]
        dQ[:, :n, :n] = _moving(body.B, changed[0], changed[2]).imag / _STEP.imag
        if person.walk is not None:
            dQ[:, n:, n:] = _diagonal(2 * person.walk * moved[4])
        dV, believed = _diagonal(2 * person.sensory * moved[3]), believed_filter(plant, person)
        dC = np.zeros((count, *C.shape))
        L = believed.L + _STEP * filter_changes(believed, (F, C), dF, dC, dQ, dV).L
    found = _assembled(body, person, changed, L)
    change = JointLoop(*(np.ascontiguousarray(part.imag / _STEP.imag) for part in found))
    if person.estimates:
        here, rows = (
            joint_loop(plant, person, recorder),
            (np.arange(count)[:, None, None], own[0][None], own[1][None]),
        )
        turned = change.F[rows] @ here.P0[own] @ here.F[own].T
        right = turned + turned.transpose(0, 2, 1) + change.Q[rows]
        change.P0[rows] = lyapunov_series(here.F[own], right)
    return change


def _levels(person: Observer) -> list[Array]:
    return [person.level(name) for name in LEVELS]


def _apart(plant: Plant, person: Observer) -> tuple[Array, ...]:
    """Indices of z that no command affects: error and perturbation estimate."""
    n, d = plant.n, 0 if person.walk is None else plant.E.shape[1]
    return np.ix_(*[np.r_[:n, 2 * n : 2 * n + d]] * 2)


def _moving(B: Array, motor: Array, process: Array) -> Array:
    """Covariance of process and motor noise."""
    return np.asarray(B @ _diagonal(motor**2) @ np.swapaxes(B, -1, -2) + _diagonal(process**2))


def _assembled(
    body: PlantMoves, person: Observer, levels: list[Array], L: Array | None
) -> JointLoop:
    """Assemble the system without P0; arrays may be complex, with k directions as first axis."""
    (A, B, E, C), (motor, share, process, sensory, _, white) = body, levels
    moved, R = _moving(B, motor, process), _diagonal(white**2)
    if L is None:
        return _contiguous(A, B, E, B, C, moved, R, np.zeros_like(moved), share)
    n, d = A.shape[-1], 0 if person.walk is None else E.shape[-1]
    error, estimate, walk = slice(0, n), slice(n, 2 * n), slice(2 * n, 2 * n + d)

    def zeros(rows: int, columns: int) -> Array:
        return np.zeros((*A.shape[:-2], rows, columns), dtype=A.dtype)

    size, m = 2 * n + d, B.shape[-1]
    entry, F, into = zeros(size, len(person.C)), zeros(size, size), zeros(size, E.shape[-1])
    entry[..., error, :], entry[..., estimate, :] = -L[..., :n, :], L[..., :n, :]
    entry[..., walk, :] = L[..., n:, :]
    F[..., error] = entry @ person.C
    F[..., error, error] += A
    F[..., estimate, estimate] = A
    if person.walk is None:
        into[..., estimate, :] = E
    else:
        into[..., error, :] = E
        F[..., error, walk], F[..., estimate, walk] = -E, E
        F[..., walk, walk] = np.diag(person.persistence)
    commanded, noisy, seen = zeros(size, m), zeros(size, m), zeros(C.shape[-2], size)
    commanded[..., estimate, :], noisy[..., error, :] = B, B
    seen[..., error], seen[..., estimate] = C, C
    Q = entry @ _diagonal(sensory**2) @ np.swapaxes(entry, -1, -2)
    Q[..., error, error] += moved
    return _contiguous(F, commanded, into, noisy, seen, Q, R, np.zeros_like(Q), share)


def _diagonal(values: Array) -> Array:
    """Diagonal matrices (..., a, a) from rows (..., a)."""
    return np.asarray(values[..., None] * np.eye(values.shape[-1]))


def _contiguous(*parts: Array) -> JointLoop:
    return JointLoop(*(np.array(part, order="C") for part in parts))
