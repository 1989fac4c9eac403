"""What the score of a person is on average where that person is the truth: zero, were it exact.

At a limit the filter takes a clipped command for a normal number, and later samples of a plan for
what the estimate that is expected makes of them. Its likelihood is then nearly, and not wholly,
that of the recordings, and its slope has a mean: half a deviation and more along some directions
of a seat's gain. That mean is found by simulation, with the whole law and its bounds, of the score
and of what jumps add to it (`unseen_slope`; docs/noisy-people.md, section "Without bias").
"""

from __future__ import annotations

import copy
import os
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from impc.arrays import Array
from impc.checking import replace
from impc.control.noisy_person import simulate_person
from impc.errors import SolverError
from impc.inverse.problem import controller_for
from impc.inverse.unseen_slope import jumps

if TYPE_CHECKING:
    from collections.abc import Sequence

    from impc.control.controller import Controller
    from impc.inverse.person_coordinates import Person
    from impc.inverse.person_prior import Prior
    from impc.inverse.problem import Problem
    from impc.model.recordings import Recording

# Times the largest recorded output: who falls from a seat at .16 rad is at 1.6 rad soon after.
_FAR = 10.0
# Jumps are asked of one set in so many: they scatter a third as much as scores, and take twice as
# long.
_JUMPS = 4
# Trials that run away, one after the other, before there is none like the recorded ones.
_AGAIN = 20


class SimulatedScore(NamedTuple):
    """The mean slope of sets of trials of one person, as many in each as were recorded."""

    mean: Array  # Along the unknowns (q,), nats
    spread: Array  # Covariance of that mean, for the sets are drawn (q, q)


def simulated_score(prior: Prior, theta: Array, seed: int, sets: int) -> SimulatedScore:
    """The mean score at a point, with jumps along the gain, over trials that are simulated there.

    Trials that run away are drawn anew, as those were that are recorded.

    `theta` (q,).
    """
    person = prior.space.unpack(theta)
    law = controller_for(person.point.problem, person.point.K, person.point.S)

    def one(number: int) -> tuple[Array, Array | None]:
        trials = _simulated(prior.space.space.problem, law, person, [seed, number])
        other = _of(prior, trials)
        told = other.space.told(theta)
        if number % _JUMPS:
            return told.gradient, None
        jumped = np.zeros(len(theta))
        jumped[: prior.space.gain] = jumps(other, other.placed(theta, told))
        return told.gradient, jumped

    # Compiled code lets other threads run.
    with ThreadPoolExecutor(min(sets, os.cpu_count() or 1)) as pool:
        scores, asked = zip(*pool.map(one, range(sets)), strict=True)
    jumped = [each for each in asked if each is not None]
    mean = np.mean(scores, axis=0) + np.mean(jumped, axis=0)
    return SimulatedScore(mean, _spread(scores) + _spread(jumped))


def _spread(found: Sequence[Array]) -> Array:
    """Covariance of the mean of what was drawn."""
    return np.asarray(np.cov(np.array(found).T)) / len(found)


def left_behind(trials: tuple[Recording, ...]) -> Array:
    """The size of each output (p,) beyond which a trial has run away from all that was recorded."""
    largest = np.max([np.max(np.abs(trial.outputs), axis=0) for trial in trials], axis=0)
    # An output that never moved has no size to leave behind.
    return np.where(largest > 0, _FAR * largest, np.inf)


def _simulated(
    recorded: Problem, law: Controller, person: Person, seed: list[int]
) -> tuple[Recording, ...]:
    """The recorded trials with other noise; each begins where the person's does."""
    beyond, found = left_behind(recorded.recordings), []
    for number, trial in enumerate(recorded.recordings):
        first = np.array(person.point.problem.recordings[number].x0)
        for again in range(_AGAIN):
            made = simulate_person(
                law,
                person.observer,
                np.array(trial.disturbance),
                recorder=np.array(person.recorder),
                x0=first,
                seed=[*seed, number, again],
            )
            if not np.any(np.abs(made.outputs) > beyond):
                break
        else:
            raise SolverError("person", "runs away in every simulated trial", "start elsewhere")
        found.append(replace(trial, outputs=made.outputs))
    return tuple(found)


def _of(prior: Prior, trials: tuple[Recording, ...]) -> Prior:
    """The same of other recordings."""
    found = copy.copy(prior)
    found.space = copy.copy(prior.space)
    found.space.space = copy.copy(prior.space.space)
    found.space.space.problem = replace(prior.space.space.problem, recordings=trials)
    return found
