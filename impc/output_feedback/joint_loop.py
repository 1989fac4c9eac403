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
import scipy.linalg

from impc.arrays import Array, Buffer
from impc.model.riccati import lyapunov_series
from impc.output_feedback.kalman import filter_changes
from impc.output_feedback.observer import LEVELS, believed_filter, believed_matrices

if TYPE_CHECKING:
    from impc.model.plant import Plant
    from impc.output_feedback.observer import Observer


class JointLoop(NamedTuple):
    """The system, or its derivatives along k directions, which are then a last axis.

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


def joint_loop(
    plant: Plant, person: Observer, recorder: Array, believes: Observer | None = None
) -> JointLoop:
    """The system of a `page` at a `plant`.

    `recorder` (p,).
    """
    R = np.diag(np.asarray(recorder) ** 2)
    share = np.array(person.share)
    moved = plant.B @ np.diag(person.motor**2) @ plant.B.T + np.diag(person.process**2)
    if not person.estimates:
        parts = plant.A, plant.B, plant.E, plant.B, plant.C, moved, R, np.zeros_like(moved)
        return _contiguous(*parts, share)
    L = believed_filter(plant, person if believes is None else believes).L
    rows = _Rows(plant.n, len(L) - plant.n)
    F, E = _transition(plant, person, L)
    B, G, C = rows.zeros(plant.m), rows.zeros(plant.m), rows.zeros(len(plant.C)).T
    B[rows.estimate], G[rows.error] = plant.B, plant.B
    C[:, rows.error], C[:, rows.estimate] = plant.C, plant.C
    V = np.diag(person.sensory**2)
    entry = _entry(rows, L)
    Q = entry @ V @ entry.T
    Q[rows.error, rows.error] += moved
    apart = np.ix_(rows.wandering, rows.wandering)
    P0 = np.zeros_like(F)
    P0[apart] = lyapunov_series(F[apart], Q[apart][None])[0]
    return _contiguous(F, B, E, G, C, Q, R, P0, share)


def joint_directions(
    plant: Plant, person: Observer, recorder: Array, moves: PlantMoves, levels: Array
) -> JointLoop:
    """Derivatives of `joint_loop` along k directions, for a person who believes what is true.

    `recorder` (p,); `levels` (k, levels + p).
    """
    count, sizes = len(levels), [len(person.level(name)) for name in LEVELS]
    motor, share, process, sensory, walk, white = np.split(levels, np.cumsum(sizes), axis=1)
    dR = _diagonals(2 * np.asarray(recorder) * white)
    turned = moves.B @ np.diag(person.motor**2) @ plant.B.T
    moved = turned + turned.transpose(0, 2, 1) + _diagonals(2 * person.process * process)
    moved += plant.B @ _diagonals(2 * person.motor * motor) @ plant.B.T
    if not person.estimates:
        still = np.zeros_like(moved)
        return _last(moves.A, moves.B, moves.E, moves.B, moves.C, moved, dR, still, share)
    dV = _diagonals(2 * person.sensory * sensory)
    F, C, _, V = believed_matrices(plant, person)
    n, h = plant.n, len(F)
    dF, dQ = np.zeros((count, h, h)), np.zeros((count, h, h))
    dF[:, :n, :n], dF[:, :n, n:] = moves.A, moves.E[:, :, : h - n]
    dQ[:, :n, :n] = moved
    if person.walk is not None:
        dQ[:, n:, n:] = _diagonals(2 * person.walk * walk)
    believed = believed_filter(plant, person)
    dL = filter_changes(believed, (F, C), dF, np.zeros((count, *C.shape)), dQ, dV).L
    return _estimated(plant, person, (believed.L, V), moves, (dL, moved, dV, dR, share))


def _estimated(
    plant: Plant,
    person: Observer,
    given: tuple[Array, Array],
    moves: PlantMoves,
    changes: tuple[Array, Array, Array, Array, Array],
) -> JointLoop:
    """Derivatives for a person who estimates, by the product rule."""
    (L, V), (dL, moved, dV, dR, share) = given, changes
    rows, count = _Rows(plant.n, len(L) - plant.n), len(dL)
    dF, dE = rows.zeros(rows.size, count), rows.zeros(plant.E.shape[1], count)
    dB, dG = rows.zeros(plant.m, count), rows.zeros(plant.m, count)
    dC = rows.zeros(len(plant.C), count).transpose(0, 2, 1)
    entry, dentry = _entry(rows, L), _entry(rows, dL)
    dF[:, :, rows.error] = dentry @ person.C
    dF[:, rows.error, rows.error] += moves.A
    dF[:, rows.estimate, rows.estimate] = moves.A
    if person.walk is None:
        dE[:, rows.estimate] = moves.E
    else:
        dE[:, rows.error] = moves.E
        dF[:, rows.error, rows.walk] = -moves.E
        dF[:, rows.estimate, rows.walk] = moves.E
    dB[:, rows.estimate], dG[:, rows.error] = moves.B, moves.B
    dC[:, :, rows.error], dC[:, :, rows.estimate] = moves.C, moves.C
    turned = dentry @ V @ entry.T
    dQ = turned + turned.transpose(0, 2, 1) + entry @ dV @ entry.T
    dQ[:, rows.error, rows.error] += moved
    F, _ = _transition(plant, person, L)
    apart, own = np.ix_(rows.wandering, rows.wandering), rows.wandering
    P0 = lyapunov_series(F[apart], (entry @ V @ entry.T)[apart][None] + _moved(plant, person, rows))
    turned = dF[:, own[:, None], own] @ P0 @ F[apart].T
    dP0 = np.zeros_like(dF)
    dP0[:, own[:, None], own] = lyapunov_series(
        F[apart], turned + turned.transpose(0, 2, 1) + dQ[:, own[:, None], own]
    )
    return _last(dF, dB, dE, dG, dC, dQ, dR, dP0, share)


class _Rows:
    """Where error, estimate and believed perturbation stand in z."""

    def __init__(self, n: int, d: int) -> None:
        self.size = 2 * n + d
        self.error, self.estimate = slice(0, n), slice(n, 2 * n)
        self.walk = slice(2 * n, self.size)
        self.wandering = np.r_[0:n, 2 * n : self.size]  # what no command moves

    def zeros(self, columns: int, *count: int) -> Array:
        return np.zeros((*count, self.size, columns))


def _entry(rows: _Rows, L: Array) -> Array:
    """How sensory noise enters z, of a gain (h, s) or of changes of one (k, h, s)."""
    entry = np.zeros((*L.shape[:-2], rows.size, L.shape[-1]))
    n = rows.error.stop
    entry[..., rows.error, :] = -L[..., :n, :]
    entry[..., rows.estimate, :] = L[..., :n, :]
    entry[..., rows.walk, :] = L[..., n:, :]
    return entry


def _transition(plant: Plant, person: Observer, L: Array) -> tuple[Array, Array]:
    """F and E of a person who estimates."""
    rows = _Rows(plant.n, len(L) - plant.n)
    F, E = rows.zeros(rows.size), rows.zeros(plant.E.shape[1])
    F[:, rows.error] = _entry(rows, L) @ person.C
    F[rows.error, rows.error] += plant.A
    F[rows.estimate, rows.estimate] = plant.A
    if person.walk is None:
        E[rows.estimate] = plant.E
    else:
        E[rows.error] = plant.E
        F[rows.error, rows.walk], F[rows.estimate, rows.walk] = -plant.E, plant.E
        F[rows.walk, rows.walk] = np.diag(person.persistence)
    return F, E


def _moved(plant: Plant, person: Observer, rows: _Rows) -> Array:
    """Covariance of what moves the body, among what no command moves."""
    found = plant.B @ np.diag(person.motor**2) @ plant.B.T + np.diag(person.process**2)
    return scipy.linalg.block_diag(found, np.zeros((rows.size - rows.walk.start,) * 2))


def _diagonals(values: Array) -> Array:
    """Diagonal matrices (k, a, a) of rows (k, a)."""
    return np.asarray(values[:, :, None] * np.eye(values.shape[1]))


def _contiguous(*parts: Array) -> JointLoop:
    return JointLoop(*(np.array(part, order="C") for part in parts))


def _last(*parts: Array) -> JointLoop:
    """Directions from the first axis to the last."""
    return _contiguous(*(np.moveaxis(part, 0, -1) for part in parts))
