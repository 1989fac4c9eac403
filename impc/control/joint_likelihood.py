"""The likelihood of a recording of a person who senses with noise, and its exact derivatives.

With z of `joint_loop` (plant and estimate) and the innovation e_t = y_t - C z_t of a Kalman filter,

    -2 log L = sum_t  e_t' S_t^-1 e_t + log det S_t + p log 2 pi
    z_t|t = z_t + P_t C'S_t^-1 e_t,            P_t|t = P_t - P_t C'S_t^-1 C P_t
    z_t+1 = F z_t|t + B u_t + E d_t,           P_t+1 = F_t P_t|t F_t' + Q,     F_t = F + B D_t H

with u_t = MPC(H z_t|t) and D_t its slope there: H picks the estimate out of z. The law is piecewise
affine, and its slope that of the active set. While no bound is near D_t = -K, all is linear and the
likelihood is exact. Elsewhere the filter is an approximation: for one input, whose bounds clip a
command that is only expected, u_t, D_t and some variance beside follow from the distribution of
that command (`Clip`); for several inputs it is the extended filter. Derivatives follow the active
sets, as those of a simulation do, and hold wherever none is about to change.

P_t does not depend on what is recorded while D_t stays. Once it has come as near to its stationary
value as rounding lets a derivative see it is taken for that value, until a bound is met
(docs/noisy-people.md).
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Array, Frozen, frozen
from impc.control.closed_loop import prepare_loop
from impc.control.compiled_clip import Clip
from impc.control.compiled_filter import Steady, run_filter
from impc.control.compiled_room import filter_room
from impc.control.compiled_sample import FilterResult
from impc.control.constraint_rows import RowDirections, Rows
from impc.control.joint_loop import PlantMoves, joint_directions, joint_loop
from impc.control.simulation import Status
from impc.errors import SolverError
from impc.model.bounds import bound_rows
from impc.model.kalman import filter_changes, stationary_filter

if TYPE_CHECKING:
    from impc.control.closed_loop import PreparedLoop
    from impc.control.constraint_rows import Directions
    from impc.control.controller import Controller
    from impc.control.joint_loop import JointLoop
    from impc.model.observer import Observer

__all__ = ["Likelihood", "NoiseDirections", "PreparedFilter", "joint_likelihood", "prepare_filter"]


@dataclass(frozen=True)
class NoiseDirections:
    """What else moves along q directions, beside what `Directions` has; the last axis of each.

    Attributes
    ----------
    C : Array
        Outputs of the plant (p, n, q).
    levels : Array
        Levels of the person's noise, then of the recorder's (levels + p, q).
    covariances : int
        How many of the directions, the first ones, move more than the first state.
    """

    C: Array
    levels: Array
    covariances: int


@dataclass(frozen=True)
class PreparedFilter:
    """All that recordings share; made by `prepare_filter`.

    Attributes
    ----------
    law : PreparedLoop
        Of one input without its bounds at the present sample, see `Clip`.
    clip : Clip
    joint, moves : JointLoop
        The system, and its derivatives along the first directions.
    steady : Steady
    at : int
        Where the estimate stands in z.
    shared : int
        How many of the directions, the first ones, move more than the first state.
    """

    law: PreparedLoop
    clip: Clip
    joint: JointLoop
    moves: JointLoop
    steady: Steady
    at: int
    shared: int


@dataclass(frozen=True)
class Likelihood(Frozen):
    """What a recording says, sample by sample.

    Attributes
    ----------
    told : Array
        Log-likelihood of each sample given those before (samples,), nats.
    score : Array
        Its derivatives along q directions (samples, q).
    information : Array
        Fisher's, expected (q, q).
    innovations : Array
        Recorded outputs minus what the filter expects (samples, p), in the outputs' units.
    spreads : Array
        Their covariances (samples, p, p).
    filtered : Array
        Expected z given the outputs so far (samples, z).
    u : Array
        Commands there (samples, m).
    status : Array
        `Status` of each sample (samples,).
    """

    told: Array
    score: Array
    information: Array
    innovations: Array
    spreads: Array
    filtered: Array
    u: Array
    status: np.ndarray[tuple[int], np.dtype[np.int8]]

    @property
    def value(self) -> float:
        """Log-likelihood, nats."""
        return float(np.sum(self.told))


def prepare_filter(
    controller: Controller,
    person: Observer,
    recorder: Array,
    along: Directions,
    noise: NoiseDirections,
) -> PreparedFilter:
    """Build all that does not depend on a recording.

    Parameters
    ----------
    controller : Controller
    person : Observer
    recorder : Array
        Standard deviations of the noise in the recorded outputs (p,), positive.
    along : Directions
        Of plant, controller and first state, q of them.
    noise : NoiseDirections
        What else moves along them.

    Raises
    ------
    SolverError
        When the person's filter has no stationary gain.
    """
    plant = controller.plant
    law, clip = _unclipped(prepare_loop(controller, along))
    count = along.count if np.any(person.share) or clip.used else noise.covariances
    first = [np.moveaxis(part[..., :count], -1, 0) for part in
             (along.A, along.B, along.E, noise.C, noise.levels)]  # fmt: skip
    joint = joint_loop(plant, person, recorder)
    moves = joint_directions(plant, person, recorder, PlantMoves(*first[:4]), first[4])
    at = plant.n if person.estimates else 0
    steady = _steady(controller, joint, moves, along.K[..., :count], at)
    return PreparedFilter(law, clip, joint, moves, steady, at, noise.covariances)


def joint_likelihood(
    prepared: PreparedFilter, outputs: Array, disturbance: Array, x0: Array, counted: int = 0
) -> Likelihood:
    """Likelihood of one recording.

    Parameters
    ----------
    prepared : PreparedFilter
    outputs, disturbance : Array
        (samples, p) and (samples, d).
    x0 : Array
        What the person takes for the state at the first sample (n,).
    counted : int
        The first sample that is told: the likelihood is that of it and the later ones given those
        before it.

    Raises
    ------
    SolverError
        When the command of a sample could not be told, or the expectation diverges.
    """
    law, n = prepared.law, prepared.law.controller.plant.n
    samples, p, q = len(outputs), outputs.shape[1], law.along.count
    size, m = len(prepared.joint.F), law.controller.plant.m
    z, dz = np.zeros(size), np.zeros((size, q))
    z[prepared.at : prepared.at + n] = x0
    dz[prepared.at : prepared.at + n] = law.along.x0
    result = FilterResult(
        np.zeros(samples),
        np.zeros((samples, q)),
        np.zeros((q, q)),
        np.zeros((samples, p)),
        np.zeros((samples, p, p)),
        np.zeros((samples, size)),
        np.zeros((samples, m)),
        np.full(samples, Status.NOT_REACHED, dtype=np.int8),
        counted,
    )
    given = np.array(outputs, order="C"), np.array(disturbance, order="C")
    reached = _filter(prepared, *given, z, dz, result)
    if reached < samples:
        status = Status(int(result.status[reached]))
        raise SolverError(
            f"sample {reached}", f"{status.sentence}, as the filter expects it", "start elsewhere"
        )
    return Likelihood(
        frozen(result.told),
        frozen(result.score),
        frozen(np.tril(result.information) + np.tril(result.information, -1).T),
        frozen(result.innovation),
        frozen(result.spread),
        frozen(result.filtered),
        frozen(result.u),
        result.status,
    )


def _filter(
    prepared: PreparedFilter,
    outputs: Array,
    disturbance: Array,
    z: Array,
    dz: Array,
    result: FilterResult,
) -> int:
    """Write the result from the expected first state (z,) and its derivatives (z, q).

    Once the first state is forgotten, all is followed along the directions that are left. Returns
    the sample at which the filter ended, or how many there are.
    """
    law, joint, moves, shared = prepared.law, prepared.joint, prepared.moves, prepared.shared
    n = law.controller.plant.n
    P, dP, first = joint.P0, moves.P0, 0
    while True:
        room = filter_room(law.rows, joint, moves, P, dP, n, dz.shape[1])
        first = run_filter(
            law.matrices,
            law.matrix_directions,
            law.rows,
            law.row_directions,
            law.unit,
            prepared.clip,
            joint,
            moves,
            prepared.steady,
            prepared.at,
            shared,
            outputs,
            disturbance,
            z,
            dz,
            room,
            result,
            first,
        )
        if first == len(outputs) or result.status[first] != Status.NOT_REACHED:
            return int(first)
        dz, P, dP = dz[:, :shared].copy(), room.here.P, room.here.dP[:, :, :shared].copy()


def _unclipped(law: PreparedLoop) -> tuple[PreparedLoop, Clip]:
    """The law of one input without its bounds at the present sample, and these; or the law."""
    controller, rows, moved = law.controller, law.rows, law.row_directions
    low, high = (float(side[0]) for side in (controller.bounds.u_min, controller.bounds.u_max))
    if controller.plant.m > 1 or not (np.isfinite(low) or np.isfinite(high)):
        return law, Clip(used=False, low=-np.inf, high=np.inf, unit=1.0)
    on_state = bound_rows(controller.bounds, controller.plant).on_state
    kept = np.flatnonzero((rows.stage > 0) | on_state[rows.family])
    inner = Rows(
        rows.T[kept],
        rows.M[kept],
        rows.N[kept],
        rows.W[kept],
        np.ascontiguousarray(rows.gram[np.ix_(kept, kept)]),
        rows.b[kept],
        rows.limit[kept],
        rows.family[kept],
        rows.stage[kept],
    )
    others = RowDirections(moved.T[kept], moved.M[kept], moved.b[kept])
    return (
        dataclasses.replace(law, rows=inner, row_directions=others),
        Clip(used=True, low=low, high=high, unit=min(-low, high)),
    )


def _steady(
    controller: Controller, joint: JointLoop, moves: JointLoop, dK: Array, at: int
) -> Steady:
    """The stationary filter without bounds, where there is one."""
    K, estimate = controller.K, slice(at, at + controller.plant.n)
    if np.any(joint.share):
        return Steady(joint.P0, moves.P0, known=False)
    F = np.array(joint.F)
    F[:, estimate] -= joint.B @ K
    parts = (np.moveaxis(part, -1, 0) for part in (moves.F, moves.B, moves.C, moves.Q, moves.R, dK))
    dF, dB, dC, dQ, dR, dgain = parts
    dF = np.array(dF)
    dF[:, :, estimate] -= dB @ K + joint.B @ dgain
    try:
        found = stationary_filter(F, joint.C, joint.Q, joint.R)
    except SolverError:  # a gain that does not stabilise: the covariance has no end
        return Steady(joint.P0, moves.P0, known=False)
    changes = filter_changes(found, (F, joint.C), dF, dC, dQ, dR)
    dP = np.ascontiguousarray(np.moveaxis(changes.P, 0, -1))
    return Steady(np.ascontiguousarray(found.P), dP, known=True)
