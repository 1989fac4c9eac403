"""Simulated subjects: the bounded controller (3.1) in closed loop with a nonlinear plant.

At its own rate, the controller receives the true state, or the state estimate of an observer, and
holds its command until the next sample; the plant runs at the rate of the recording. Motor noise is
added to the held command, recording noise to the outputs; both are white at their rates. A trial
contains clock, outputs and disturbance.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Array, Frozen, finite_array, frozen
from impc.assess.variance_accounted_for import saturated_share
from impc.control.body_steps import body_tape
from impc.control.closed_loop import prepare_loop, run_loop
from impc.control.compiled_body import states_from
from impc.control.constraint_rows import directions
from impc.control.controller import Controller
from impc.control.simulation import Scenario, Status
from impc.errors import InputError
from impc.model.body import Body, read_body
from impc.model.plant import Plant

if TYPE_CHECKING:
    import casadi as ca
    from numpy.typing import ArrayLike

    from impc.output_feedback.observer import Observer


@dataclass(frozen=True)
class SubjectTrial(Frozen):
    """One simulated trial at the rate of the recording."""

    time: Array  # s (samples,)
    outputs: Array  # With recording noise (samples, p), in the plant's units
    disturbance: Array  # (samples, d)
    states: Array  # True states (samples, n)
    commands: Array  # Commands without motor noise (samples, m)
    saturated: float  # Share of the controller's samples at which its command is at its bound
    # Time in s at which no command kept the bounds or an output exceeded `largest`; all later
    # samples repeat the last state
    fell: float | None


def simulate_subject(
    controller: Controller,
    step: ca.Function,
    disturbance: ArrayLike,
    *,
    rate: float = 1000.0,
    motor: ArrayLike = 0.0,
    sensor: ArrayLike = 0.0,
    person: Observer | None = None,
    largest: float = 1e3,
    seed: int | np.random.SeedSequence = 0,
) -> SubjectTrial:
    """Simulate from rest; `disturbance` (samples, d), `rate` in Hz, SDs `motor`, `sensor`."""
    plant, dt = controller.plant, controller.plant.dt
    within = round(rate * dt)  # Recorded samples per sample of the controller
    if within < 1 or abs(within / (rate * dt) - 1) > 1e-9:
        raise InputError("rate", f"got {rate:g} per s", f"pass a multiple of {1 / dt:g} per s")
    columns = np.asarray(disturbance, dtype=np.float64)
    d = finite_array(
        "disturbance", columns[:, None] if columns.ndim == 1 else columns, (None, plant.E.shape[1])
    )
    if person is None:
        from impc.output_feedback.observer import Observer  # noqa: PLC0415  # optional

        person = Observer(plant, motor=motor)
    if np.any(person.process):
        raise InputError("process", "process noise cannot be simulated", "set process=0")
    rng = np.random.default_rng(seed)
    body = read_body(step, range(plant.m + d.shape[1]), plant.n)
    x, u, end = _moved(controller, body, d, within, person, rng, largest)
    limits = controller.bounds
    sensed = np.asarray(sensor) * rng.standard_normal((len(d), len(plant.outputs)))
    return SubjectTrial(
        frozen(np.arange(len(d)) / rate),
        frozen(x @ plant.C.T + sensed),
        frozen(d),
        frozen(x),
        frozen(u),
        saturated_share(u[::within], np.array(limits.u_min), np.array(limits.u_max)),
        None if end is None else end / rate,
    )


def _moved(
    controller: Controller,
    body: Body,
    d: Array,
    within: int,
    person: Observer,
    rng: np.random.Generator,
    largest: float,
) -> tuple[Array, Array, int | None]:
    """States (samples, n) and commands (samples, m) from rest; sample of a fall or None."""
    plant, samples = controller.plant, len(d)
    prepared = prepare_loop(controller, directions(controller, 0))
    observe = _filter(plant, person, rng) if person.estimates else None
    width, still = d.shape[1], np.zeros((1, plant.E.shape[1]))
    tape = body_tape(body, plant.n, plant.n + plant.m + width, moving=False)
    x, u = np.zeros((samples, plant.n)), np.zeros((samples, plant.m))
    ahead = np.zeros((within + 1, plant.n))
    state: Array = np.zeros(plant.n)
    seen = state
    for first in range(0, samples, within):
        run, _ = run_loop(prepared, Scenario(seen, still))
        last = min(first + within, samples)
        if run.status[0] > Status.SOFTENED:
            x[first:], u[first:] = state, u[first - 1]
            return x, u, first
        command = run.u[0]
        noise = np.hypot(person.motor, person.share * command) * rng.standard_normal(plant.m)
        pushed = np.resize(d[first:last], (within, width))
        ahead[0] = state
        states_from(tape, np.tile(command + noise, (within, 1)), pushed, ahead)
        x[first:last] = ahead[: last - first]
        u[first:last] = command
        before, state = state, ahead[-1].copy()
        seen = (
            state if observe is None else observe(before, command, np.mean(d[first:last], axis=0))
        )
        if not np.all(np.isfinite(state)) or np.max(np.abs(plant.C @ state)) > largest:
            x[last:], u[last:] = x[last - 1], command
            return x, u, last
    return x, u, None


def _filter(
    plant: Plant, person: Observer, rng: np.random.Generator
) -> Callable[[Array, Array, Array], Array]:
    """Function (state, command, disturbance) -> state estimate (n,) at the next sample."""
    from impc.output_feedback.observer import believed_filter, believed_matrices  # noqa: PLC0415

    F, C, _, _ = believed_matrices(plant, person)
    L, found = believed_filter(plant, person).L, np.zeros(len(F))

    def observe(state: Array, command: Array, push: Array) -> Array:
        nonlocal found
        noise = person.sensory * rng.standard_normal(len(C))
        found = F @ found + L @ (person.C @ state + noise - C @ found)
        found[: plant.n] += plant.B @ command
        if person.walk is None:
            found[: plant.n] += plant.E @ push
        return np.array(found[: plant.n])

    return observe
