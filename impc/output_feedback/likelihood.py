"""Log-likelihood of recordings under output-feedback MPC, with exact derivatives.

With z of `joint_loop` (plant and estimate) and the innovation e_t = y_t - C z_t of a Kalman filter,

    -2 log L = sum_t  e_t' S_t^-1 e_t + log det S_t + p log 2 pi
    z_t|t = z_t + P_t C'S_t^-1 e_t,            P_t|t = P_t - P_t C'S_t^-1 C P_t
    z_t+1 = F z_t|t + B u_t + E d_t,           P_t+1 = F_t P_t|t F_t' + Q,     F_t = F + B D_t H

with u_t = MPC(H z_t|t) and D_t its slope there: H selects the estimate from z. Away from bounds the
system is linear and the likelihood exact; near them the moments of the clipped command are used
with one input (`clipped`), an extended Kalman filter with several (docs/why/output_feedback.md).
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from impc.arrays import Array
from impc.control.aims import aim_of
from impc.control.closed_loop import PreparedLoop, prepare_loop
from impc.control.compiled_values import RowDirections, Rows, workspace
from impc.control.constraint_rows import Directions
from impc.control.controller import Controller
from impc.control.simulation import Scenario, Status
from impc.errors import SolverError
from impc.model.bounds import bound_rows
from impc.model.recordings import Recording
from impc.output_feedback.compiled_filter import (
    Belief,
    Clip,
    FilterParts,
    JointLoop,
    Likelihood,
    run_filter,
)
from impc.output_feedback.observer import Body, Observer, filter_changes, stationary_filter
from impc.output_feedback.simulation import joint_directions, joint_loop

# Status of samples at which the likelihood is undefined.
_FAILED = (Status.INFEASIBLE, Status.UNSOLVED, Status.DIVERGED)


@dataclass(frozen=True)
class NoiseDirections:
    """Further derivatives along q directions (last axis), in addition to `Directions`."""

    levels: Array  # (levels + p, q), noise SDs of the subject, then of the recording
    covariances: int  # number of leading directions that change more than the first state


@dataclass(frozen=True)
class PreparedFilter:
    """Everything that recordings share; made by `prepare_filter`."""

    law: PreparedLoop  # with one input without its bounds at the present sample, see `Clip`
    parts: FilterParts


def prepare_filter(
    controller: Controller,
    person: Observer,
    recorder: Array,
    along: Directions,
    noise: NoiseDirections,
) -> PreparedFilter:
    """Build everything that does not depend on a recording; `recorder` (p,)."""
    plant = controller.plant
    law, clip = unclipped(prepare_loop(controller, along, whole=True))
    count = along.count if np.any(person.share) or clip.used else noise.covariances
    given = (along.A, along.B, along.E, along.C, noise.levels)
    *first, levels = (np.moveaxis(part[..., :count], -1, 0) for part in given)
    joint = joint_loop(plant, person, recorder)
    moves = joint_directions(plant, person, recorder, Body(*first), levels)
    at = plant.n if person.estimates else 0
    parts = FilterParts(
        law.matrices,
        law.matrix_directions,
        law.rows,
        law.row_directions,
        law.unit,
        clip,
        joint,
        moves,
        any(bool(np.any(part)) for part in (moves.B, moves.C, moves.E, moves.G)),
        np.any(moves.F, axis=(1, 2)) | np.any(moves.Q, axis=(1, 2)),
        *_stationary(controller, joint, moves, along.K[..., :count], at),
        at,
        noise.covariances,
    )
    return PreparedFilter(law, parts)


def joint_likelihoods(
    prepared: PreparedFilter, recordings: Sequence[Recording], counted: int = 0
) -> list[Likelihood]:
    """Likelihood of each recording, in parallel threads."""
    with ThreadPoolExecutor(min(len(recordings), os.cpu_count() or 1)) as pool:
        return list(pool.map(lambda trial: _filtered(prepared, trial, counted), recordings))


def _filtered(prepared: PreparedFilter, trial: Recording, counted: int) -> Likelihood:
    """Likelihood of one recording; its first state forgotten, along the other directions."""
    law, parts = prepared.law, prepared.parts
    plant, q, N = law.controller.plant, law.along.count, trial.samples
    size, p, start = len(parts.joint.F), len(plant.C), slice(parts.at, parts.at + plant.n)
    z, dz = np.zeros(size), np.zeros((size, q))
    z[start], dz[start] = trial.x0, law.along.x0
    status = np.full(N, Status.NOT_REACHED, dtype=np.int8)
    shapes = (N,), (N, q), (q, q), (N, p), (N, p, p), (N, size)
    result = Likelihood._make([*map(np.zeros, shapes), status, counted])
    outputs, disturbance = np.array(trial.outputs), np.array(trial.disturbance)
    drive = Scenario(trial.x0, trial.disturbance, trial.target, trial.signals)
    aim = aim_of(law.controller, drive, law.along)
    P, dP, first = parts.joint.P0.copy(), parts.djoint.P0.copy(), 0
    while first < N and status[first] not in _FAILED:
        belief = Belief(z, dz, P, dP)
        work = workspace(parts.rows, parts.drows, len(parts.unit))
        try:
            first = run_filter(parts, outputs, disturbance, aim, belief, result, first, work)
        except np.linalg.LinAlgError:  # a factorisation of numbers that are not finite
            raise SolverError(
                "filter", "its covariance is not finite", "use another starting point"
            ) from None
        dz, dP = np.ascontiguousarray(dz[:, : parts.lasting]), dP[: parts.lasting]
    failed = np.flatnonzero(np.isin(status, _FAILED))
    if len(failed):
        why = f"{Status(int(status[failed[0]])).sentence}, in the prediction of the filter"
        raise SolverError(f"sample {failed[0]}", why, "use another starting point")
    return result


def unclipped(law: PreparedLoop) -> tuple[PreparedLoop, Clip]:
    """With one input, split the law into one without present bounds, and the clip; else as is."""
    controller, rows, moved = law.controller, law.rows, law.row_directions
    low, high = (float(side[0]) for side in (controller.bounds.u_min, controller.bounds.u_max))
    if controller.plant.m > 1 or not (np.isfinite(low) or np.isfinite(high)):
        return law, Clip(used=False, low=-np.inf, high=np.inf, unit=1.0)
    of_state = np.any(bound_rows(controller.bounds, controller.plant).E, axis=1)
    kept = np.flatnonzero((rows.stage > 0) | of_state[rows.family])
    inner = Rows._make(part[kept] for part in rows)
    inner = inner._replace(gram=np.ascontiguousarray(inner.gram[:, kept]))
    others = RowDirections._make(part[kept] for part in moved)
    inside = dataclasses.replace(law, rows=inner, row_directions=others)
    return inside, Clip(used=True, low=low, high=high, unit=min(-low, high))


def _stationary(
    controller: Controller, joint: JointLoop, moves: JointLoop, dK: Array, at: int
) -> tuple[bool, Array, Array]:
    """Whether a stationary filter without bounds exists, its covariance and derivatives."""
    K, estimate = controller.K, slice(at, at + controller.plant.n)
    F, dF = np.array(joint.F), np.array(moves.F)
    F[:, estimate] -= joint.B @ K
    dF[:, :, estimate] -= moves.B @ K + joint.B @ np.moveaxis(dK, -1, 0)
    if np.any(joint.share):
        return False, joint.P0, moves.P0
    try:
        found = stationary_filter(F, joint.C, joint.Q, joint.R)
    except SolverError:  # the gain does not stabilise: the covariance diverges
        return False, joint.P0, moves.P0
    changes = filter_changes(found, (F, joint.C), (dF, moves.C, moves.Q, moves.R))
    return True, np.ascontiguousarray(found.P), np.ascontiguousarray(changes.P)
