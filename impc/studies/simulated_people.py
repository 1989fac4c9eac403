"""A subject for everybody without data: a constrained controller that holds a nonlinear plant.

The controller sees the true state at its own rate and holds its command until the next sample; the
plant runs at the rate of the recording. Motor noise is added to the held command, white from one
sample of the controller to the next; sensor noise to the recorded outputs, white from one recorded
sample to the next. What is recorded is what a laboratory would have: clock, outputs, disturbance.
The controller is that of (3.1); docs/fitting.md has what a fit makes of such subjects.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from impc.arrays import Array, Frozen, finite_array, frozen
from impc.assess.variance_accounted_for import saturated_share
from impc.control.closed_loop import Scenario, Status, prepare_loop, run_loop
from impc.control.constraint_rows import directions
from impc.errors import InputError

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from impc.control.controller import Controller

__all__ = ["SubjectTrial", "simulate_subject"]


@dataclass(frozen=True)
class SubjectTrial(Frozen):
    """One simulated trial at the recording's rate.

    Attributes
    ----------
    time : Array
        s (samples,).
    outputs : Array
        With sensor noise (samples, p), in the plant's units.
    disturbance : Array
        (samples, d).
    states : Array
        True states (samples, n).
    commands : Array
        What the controller asked for, without motor noise, (samples, m).
    saturated : float
        Share of the controller's samples at which its command stands on a bound.
    fell : float or None
        Time in s at which no command kept the bounds or an output went beyond `largest`; what
        follows repeats the last state.
    """

    time: Array
    outputs: Array
    disturbance: Array
    states: Array
    commands: Array
    saturated: float
    fell: float | None


def simulate_subject(
    controller: Controller,
    step: Any,
    disturbance: ArrayLike,
    *,
    rate: float = 1000.0,
    motor: ArrayLike = 0.0,
    sensor: ArrayLike = 0.0,
    largest: float = 1e3,
    seed: int | np.random.SeedSequence = 0,
) -> SubjectTrial:
    """Simulate one trial from rest.

    Parameters
    ----------
    controller : Controller
        On the linear plant, at its sample time.
    step : casadi.Function
        (state (n), inputs (m + d), controls first) -> next state, one sample of the recording on.
    disturbance : array_like
        (samples, d) at the recording's rate.
    rate : float
        Samples per second of the recording, a whole multiple of the controller's.
    motor : array_like
        Standard deviation of the motor noise, in the commands' units, one or (m,).
    sensor : array_like
        Standard deviation of the sensor noise, in the outputs' units, one or (p,).
    largest : float
        An output beyond this, in its unit, is a fall.
    seed : int or SeedSequence
        All numbers drawn follow from it.

    Raises
    ------
    InputError
        When the rate is no whole multiple of the controller's.
    """
    plant = controller.plant
    within = round(rate * plant.dt)
    if within < 1 or abs(within / (rate * plant.dt) - 1) > 1e-9:
        raise InputError(
            "rate", f"got {rate:g} per s", f"give a multiple of {1 / plant.dt:g} per s"
        )
    columns = np.asarray(disturbance, dtype=np.float64)
    d = finite_array(
        "disturbance", columns[:, None] if columns.ndim == 1 else columns, (None, plant.E.shape[1])
    )
    rng = np.random.default_rng(seed)
    samples = len(d)
    prepared = prepare_loop(controller, directions(controller, 0))
    several = step.mapaccum(within)
    still = np.zeros((1, plant.E.shape[1]))
    x, u = np.zeros((samples, plant.n)), np.zeros((samples, plant.m))
    fell: float | None = None
    state = np.zeros(plant.n)
    for first in range(0, samples, within):
        run, _ = run_loop(prepared, Scenario(state, still))
        last = min(first + within, samples)
        if run.status[0] > Status.SOFTENED:
            fell = first / rate
            x[first:], u[first:] = state, u[first - 1]
            break
        command = run.u[0]
        moved = command + np.asarray(motor) * rng.standard_normal(plant.m)
        inputs = np.hstack(
            [np.tile(moved, (within, 1)), np.resize(d[first:last], (within, d.shape[1]))]
        )
        ahead = np.asarray(several(state, inputs.T)).T
        x[first:last] = np.vstack([state, ahead[:-1]])[: last - first]
        u[first:last] = command
        state = ahead[-1]
        if not np.all(np.isfinite(state)) or np.max(np.abs(plant.C @ state)) > largest:
            fell = last / rate
            x[last:], u[last:] = x[last - 1], command
            break
    limits = controller.bounds
    noise = np.asarray(sensor) * rng.standard_normal((samples, len(plant.outputs)))
    return SubjectTrial(
        frozen(np.arange(samples) / rate),
        frozen(x @ plant.C.T + noise),
        frozen(d),
        frozen(x),
        frozen(u),
        saturated_share(u[::within], np.array(limits.u_min), np.array(limits.u_max)),
        fell,
    )
