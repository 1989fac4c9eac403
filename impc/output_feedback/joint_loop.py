"""A person who senses with noise, and what is recorded, as one system of plant and estimate.

With the error e = x - xh of the estimate the state is z = (e, xh, dh), or z = x for a person who
sees every state, and

    z+ = F z + B u + E d + G w + noise of covariance Q,    u = MPC(xh),    y = C z + noise of R

where nothing but u depends on the controller. An error that nobody commands keeps F in blocks:

    e+  = (A - L C_s) e - E dh + E d + B w + p - L v      (with a known perturbation: without E)
    xh+ = A xh + E dh + B u + L C_s e + L v
    dh+ = r dh + L_d C_s e + L_d v      (r the persistence that is believed, 1 for a random walk)

At the first sample the estimate is a value to be given, and the error has the covariance that it
keeps: the person has been at it for some time (docs/noisy-people.md).
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


# Of a derivative: its square is nothing beside one.
_STEP = 1e-30j


class JointLoop(NamedTuple):
    """The system, or its derivatives along k directions, which are then a first axis.

    A named tuple because compiled code takes it as it is.
    """

    F: Buffer  # (z, z), (z, m), (z, d) and (z, m): transition, commands, perturbations, motor noise
    B: Buffer
    E: Buffer
    G: Buffer
    C: Buffer  # (p, z)
    # Covariances of the noise (z, z), of the recorder's (p, p) and of the first state (z, z)
    Q: Buffer
    R: Buffer
    P0: Buffer
    share: Buffer  # Of the command that is motor noise (m,)


class PlantMoves(NamedTuple):
    """Changes of a plant along k directions, which are the first axis."""

    A: Array  # (k, n, n)
    B: Array  # (k, n, m)
    E: Array  # (k, n, d)
    C: Array  # (k, p, n)


def joint_loop(plant: Plant, person: Observer, recorder: Array) -> JointLoop:
    """The system of a `person` at a `plant`, with the `recorder`'s noise (p,)."""
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
    """Derivatives of `joint_loop` along k directions, for a person who believes what is true.

    All but two equations are products, of which a complex step is exact (Squire and Trapp 1998).

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
    """What no command moves, rows and columns of z: error and believed perturbation."""
    n, d = plant.n, 0 if person.walk is None else plant.E.shape[1]
    return np.ix_(*[np.r_[:n, 2 * n : 2 * n + d]] * 2)


def _moving(B: Array, motor: Array, process: Array) -> Array:
    """Covariance of what moves the body."""
    return np.asarray(B @ _diagonal(motor**2) @ np.swapaxes(B, -1, -2) + _diagonal(process**2))


def _assembled(
    body: PlantMoves, person: Observer, levels: list[Array], L: Array | None
) -> JointLoop:
    """The system without P0, of arrays that may be complex and have k directions before all."""
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
    """Diagonal matrices (..., a, a) of rows (..., a)."""
    return np.asarray(values[..., None] * np.eye(values.shape[-1]))


def _contiguous(*parts: Array) -> JointLoop:
    return JointLoop(*(np.array(part, order="C") for part in parts))
