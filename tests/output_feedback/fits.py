"""Subjects on a cart, recorded and fitted; each fit is made once for all tests."""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np

import impc
from impc.arrays import Array
from impc.output_feedback.fit import OutputFeedbackFit
from impc.output_feedback.simulation import simulate_person
from tests import support
from tests.support import named_plant, regulator


def cart() -> impc.Plant:
    A, B = [[1, 0.05], [0, 0.98]], [[0, 0], [0.05, 0.05]]
    return named_plant(A, B, [[1, 0]], 0.05, "x v", "u d", "x")


def law(limit: float) -> impc.Controller:
    return regulator(cart(), np.diag([8.0, 1.0]), limit, 5)


def trials(
    person: impc.Observer, recorder: float, limit: float, count: int = 2
) -> list[impc.Recording]:
    rng, found = np.random.default_rng(3), []
    for seed in range(count):
        push = np.repeat(rng.choice([-0.7, 0.0, 0.7], 40), 10)
        run = simulate_person(law(limit), person, push, recorder=recorder, seed=seed)
        assert run.reached == len(push)
        found.append(impc.Recording(cart(), run.outputs, push))
    return found


def posed(person: impc.Observer, recorder: float, limit: float, count: int = 2) -> impc.Problem:
    recordings = trials(person, recorder, limit, count)
    return support.posed(law(limit), *recordings, terminal_set=False, unknown_start=True)


class Case(NamedTuple):
    """A subject, and how it is recorded."""

    motor: float
    sensory: float | tuple[float, ...]
    limit: float
    trials: int = 2
    sensed: tuple[str, ...] = ("x",)
    start: tuple[float, ...] | None = None  # noise SDs at which the fit starts

    def person(self) -> impc.Observer:
        return impc.Observer(cart(), self.sensed, motor=self.motor, sensory=self.sensory)


CASES = {
    "limited": Case(0.15, 0.02, 0.9),
    "free": Case(0.4, 0.05, 3.0, 4),
    # Motor noise is well identified; the noise of a sensed state that is also recorded is not.
    "vague": Case(0.4, 0.01, 3.0),
    # The sensory noise is so small that it is not identified.
    "sliding": Case(0.4, (0.002, 0.004), 0.9, 2, ("x", "v"), (0.1, 0, 0, 0, 0.1, 0.1)),
}


@functools.cache
def least_squares(name: str) -> tuple[impc.Observer, impc.Estimate]:
    person = CASES[name].person()
    return person, impc.fit(posed(person, 0.01, CASES[name].limit, CASES[name].trials))


@functools.cache
def fitted(name: str) -> OutputFeedbackFit:
    (person, first), start = least_squares(name), CASES[name].start
    return impc.fit_output_feedback(first, person.with_levels(np.array(start)) if start else person)


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
