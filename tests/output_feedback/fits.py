"""Subjects on a cart, recorded and fitted; each fit is made once for all tests."""

from __future__ import annotations

import functools
from typing import NamedTuple

import control
import numpy as np

from impc.arrays import Array
from impc.control.controller import Controller
from impc.inverse.estimates import Estimate
from impc.inverse.methods import fit
from impc.inverse.problem import Problem
from impc.model.bounds import Bounds
from impc.model.plant import Plant
from impc.model.recordings import Recording
from impc.model.weights import Weights
from impc.output_feedback.fit import OutputFeedbackFit, fit_output_feedback
from impc.output_feedback.observer import Observer
from impc.output_feedback.simulation import simulate_person


def cart() -> Plant:
    system = control.ss(
        [[1, 0.05], [0, 0.98]], [[0, 0], [0.05, 0.05]], [[1, 0]], 0, 0.05,
        states=["x", "v"], inputs=["u", "d"], outputs=["x"],
    )  # fmt: skip
    return Plant(system, ["u"])


def law(limit: float) -> Controller:
    bounds = Bounds(cart(), u_min=-limit, u_max=limit)
    return Controller(cart(), Weights(np.diag([8.0, 1.0]), 1), bounds, 5, terminal_set=False)


def trials(person: Observer, recorder: float, limit: float, count: int = 2) -> list[Recording]:
    rng, found = np.random.default_rng(3), []
    for seed in range(count):
        push = np.repeat(rng.choice([-0.7, 0.0, 0.7], 40), 10)
        run = simulate_person(law(limit), person, push, recorder=recorder, seed=seed)
        assert run.reached == len(push)
        found.append(Recording(cart(), run.outputs, push))
    return found


def posed(person: Observer, recorder: float, limit: float, count: int = 2) -> Problem:
    recordings, bounds = trials(person, recorder, limit, count), law(limit).bounds
    return Problem(cart(), bounds, 5, recordings, terminal_set=False, unknown_start=True)


class Case(NamedTuple):
    """A subject, and how it is recorded."""

    motor: float
    sensory: float | tuple[float, ...]
    limit: float
    trials: int = 2
    sensed: tuple[str, ...] = ("x",)
    start: tuple[float, ...] | None = None  # noise SDs at which the fit starts

    def person(self) -> Observer:
        return Observer(cart(), self.sensed, motor=self.motor, sensory=self.sensory)


CASES = {
    "limited": Case(0.15, 0.02, 0.9),
    "free": Case(0.4, 0.05, 3.0, 4),
    # Motor noise is well identified; the noise of a sensed state that is also recorded is not.
    "vague": Case(0.4, 0.01, 3.0),
    # The sensory noise is so small that it is not identified.
    "sliding": Case(0.4, (0.002, 0.004), 0.9, 2, ("x", "v"), (0.1, 0, 0, 0, 0.1, 0.1)),
}


@functools.cache
def least_squares(name: str) -> tuple[Observer, Estimate]:
    person = CASES[name].person()
    return person, fit(posed(person, 0.01, CASES[name].limit, CASES[name].trials))


@functools.cache
def fitted(name: str) -> OutputFeedbackFit:
    (person, first), start = least_squares(name), CASES[name].start
    return fit_output_feedback(first, person.with_levels(np.array(start)) if start else person)


def unknown_truth(found: OutputFeedbackFit, levels: list[float], limit: float) -> Array:
    """The true subject in the coordinates of a fit (q,), at its own initial states."""
    space, theta = found.space, np.array(found.space.start)
    own = space.space
    theta[: space.gain] = np.tensordot(
        space.gain_law.natural(space.gain_law.gains), space.gain_law.natural(law(limit).K), 2
    )
    starts = np.array([trial.x0 for trial in own.problem.recordings])
    theta[space.shared : space.after] = -np.linalg.solve(own.own_unit, starts.T).T.ravel()
    theta[space.own :] = np.log(levels)
    return theta
