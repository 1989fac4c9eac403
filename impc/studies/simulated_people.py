"""Simulated subjects: the bounded controller (3.1) in closed loop with a nonlinear plant.

At its own rate, the controller receives the true state, or the state estimate of an observer, and
holds its command until the next sample; the plant runs at the rate of the recording. Motor noise is
added to the held command, recording noise to the outputs; both are white at their rates. A trial
contains clock, outputs and disturbance.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from impc.arrays import Array, Frozen, finite_array, frozen
from impc.assess.variance_accounted_for import saturated_share
from impc.control.closed_loop import prepare_loop, run_loop
from impc.control.constraint_rows import directions
from impc.control.simulation import Scenario, Status
from impc.errors import InputError

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from impc.control.controller import Controller
    from impc.model.plant import Plant
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
    step: Any,
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
    rng = np.random.default_rng(seed)
    senses = _Senses(plant, person, rng, np.asarray(motor))
    x, u, end = _moved(controller, step.mapaccum(within), d, within, senses, largest)
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


class _Senses:
    """State that the controller receives (true or estimated), and motor noise."""

    def __init__(
        self, plant: Plant, person: Observer | None, rng: np.random.Generator, motor: Array
    ) -> None:
        self.plant, self.person, self.rng, self.motor = plant, person, rng, motor
        if person is not None and np.any(person.process):
            raise InputError("process", "process noise cannot be simulated", "set process=0")
        self.estimating = person is not None and person.estimates
        if person is not None and self.estimating:
            from impc.output_feedback.observer import (  # noqa: PLC0415  # optional
                believed_filter,
                believed_matrices,
            )

            self.F, self.C, _, _ = believed_matrices(plant, person)
            self.L = believed_filter(plant, person).L
            self.found = np.zeros(len(self.F))

    def of(self, state: Array) -> Array:
        """State estimate (n,) at a true `state` (n,)."""
        return np.asarray(self.found[: self.plant.n]) if self.estimating else state

    def noise(self, command: Array) -> Array:
        """Motor noise that is added to a command (m,)."""
        deviation, person = self.motor, self.person
        if person is not None:
            deviation = np.hypot(person.motor, person.share * command)
        return np.asarray(deviation * self.rng.standard_normal(len(command)))

    def look(self, state: Array, command: Array, d: Array) -> None:
        """Update the estimate with a noisy observation of `state` (n,), then predict one sample."""
        if self.person is None or not self.estimating:
            return
        noise = self.person.sensory * self.rng.standard_normal(len(self.C))
        error = self.person.C @ state + noise - self.C @ self.found
        self.found = self.F @ self.found + self.L @ error
        self.found[: self.plant.n] += self.plant.B @ command
        if self.person.walk is None:
            self.found[: self.plant.n] += self.plant.E @ d


def _moved(
    controller: Controller, several: Any, d: Array, within: int, senses: _Senses, largest: float
) -> tuple[Array, Array, int | None]:
    """States (samples, n) and commands (samples, m) from rest; sample of a fall or None."""
    plant, samples = controller.plant, len(d)
    prepared = prepare_loop(controller, directions(controller, 0))
    still = np.zeros((1, plant.E.shape[1]))
    x, u = np.zeros((samples, plant.n)), np.zeros((samples, plant.m))
    state = np.zeros(plant.n)
    for first in range(0, samples, within):
        run, _ = run_loop(prepared, Scenario(senses.of(state), still))
        last = min(first + within, samples)
        if run.status[0] > Status.SOFTENED:
            x[first:], u[first:] = state, u[first - 1]
            return x, u, first
        command = run.u[0]
        moved = command + senses.noise(command)
        senses.look(state, command, np.mean(d[first:last], axis=0))
        inputs = np.hstack(
            [np.tile(moved, (within, 1)), np.resize(d[first:last], (within, d.shape[1]))]
        )
        ahead = np.asarray(several(state, inputs.T)).T
        x[first:last] = np.vstack([state, ahead[:-1]])[: last - first]
        u[first:last] = command
        state = ahead[-1]
        if not np.all(np.isfinite(state)) or np.max(np.abs(plant.C @ state)) > largest:
            x[last:], u[last:] = x[last - 1], command
            return x, u, last
    return x, u, None
