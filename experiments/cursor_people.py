"""Fit the sensorimotor model to people who follow a blurred target, and evaluate it held out.

The hand's velocity follows a command that arrives whole samples late (`plants.pursuit_plant`). The
person sees the error and feels the speed of the hand, both with noise, and knows that the target
moves by independent steps of known size. Commands follow from the estimate; the cost contains the
error and the command. Motor noise enters with the command, and process noise moves the cursor,
white from sample to sample. Maximum likelihood estimates everything except the delay, for each of
some delays (docs/why/output_feedback.md). People hold the cursor a few pixels off the target, so
the mean error is subtracted, and then replaced by the offset that maximises the likelihood.

A trial begins with the cursor on the target, whereas the filter assumes a stationary subject. The
first three seconds are therefore conditioned on. The score is the mean log-likelihood, in nats a
sample, of the next position of the cursor given all earlier ones and the target. It is compared
with a linear prediction with every coefficient free (`experiments.cursor_people_study`).
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

import plants
from experiments.cursor_data import RATE, Condition
from impc.checking import replace
from impc.inverse.noisy_fit import fit_controller
from impc.inverse.structured import fit_structured
from impc.inverse.unknowns import Point
from impc.model.plant import Plant
from impc.model.plant_family import PlantFamily
from impc.model.recordings import Recording
from impc.model.structure import Structure
from impc.output_feedback.fit import OutputFeedbackFit, fit_output_feedback
from impc.output_feedback.observer import Observer
from impc.output_feedback.unknowns import NoisyUnknowns, Request, gain_space
from impc.studies.fit.asked import fit_problem
from impc.studies.fit.settings import FitSettings

if TYPE_CHECKING:
    from impc.arrays import Array, IntArray
    from impc.inverse.problem import Problem

__all__ = [
    "DELAYS",
    "FIRST",
    "Follower",
    "fit_follower",
    "follower_problem",
    "judged",
    "nats",
    "regression_nats",
]

#: Delays that are tried, samples of 1/60 s, and the first sample that is scored.
DELAYS = (6, 8, 10, 12, 14)
FIRST = 180
_LAG = 0.03
# Starting noise SDs: px, px/s. At a blur of 17 px a search from others can end lower.
_BESIDE, _MOTOR, _SEEN, _FELT, _RECORDER = 0.3, 60.0, 10.0, 20.0, 0.2
# Prior SD of the logarithm of the cost weight about its start.
_SPREAD = 5.0


@dataclass(frozen=True)
class Follower:
    """Model fitted to some trials.

    Attributes
    ----------
    delay : int
        Delay, samples.
    offset : float
        Mean distance of the cursor from the target, px.
    fit : OutputFeedbackFit
    """

    delay: int
    offset: float
    fit: OutputFeedbackFit


def follower_problem(condition: Condition, which: IntArray, delay: int, offset: float) -> Problem:
    """Inverse problem of some trials (k,): the error starts as recorded, the hand at rest."""

    def make(values: Array) -> Plant:
        return Plant(plants.pursuit_plant(delay, float(values[0])), ["command"])

    plant, trials = make(np.array([_LAG])), []
    for target, response in zip(condition.target[which], condition.response[which], strict=True):
        error = response - target - offset
        increments = np.append(np.diff(target), 0.0) * RATE
        trials.append(Recording(plant, error, increments, [error[0], *np.zeros(plant.n - 1)]))
    family = PlantFamily(make, ["lag"], [_LAG])
    return replace(fit_problem(plant, trials, FitSettings(), family), unknown_start=False)


def fit_follower(
    condition: Condition,
    which: IntArray,
    delays: tuple[int, ...] = DELAYS,
    counted: int = FIRST,
) -> Follower:
    """Most likely model of some trials (k,) over some delays.

    Samples before `counted` are conditioned on.
    """
    error = (condition.response[which] - condition.target[which])[:, FIRST:]
    offset = float(np.mean(error))
    tried = [(delay, _fitted(condition, which, delay, offset, counted)) for delay in delays]
    delay, found = max(tried, key=lambda one: one[1].log_likelihood)
    again = offset + _beside(Follower(delay, offset, found), condition, which)
    return Follower(delay, again, _fitted(condition, which, delay, again, counted))


def _fitted(
    condition: Condition, which: IntArray, delay: int, offset: float, counted: int
) -> OutputFeedbackFit:
    problem = follower_problem(condition, which, delay, offset)
    near = fit_controller(problem)
    structure = Structure(near.problem.plant, ["error"])
    least_squares = fit_structured(problem, structure, near)
    plant = least_squares.problem.plant
    beside = np.zeros(plant.n)
    beside[0] = _BESIDE
    person = Observer(
        plant,
        ["error", "velocity"],
        motor=_MOTOR,
        process=beside,
        sensory=[_SEEN, _FELT],
        walk=float(np.std([trial.disturbance for trial in problem.recordings])),
        persistence=0.0,
    )
    return fit_output_feedback(
        least_squares,
        person,
        recorder=np.array([_RECORDER]),
        spread=_SPREAD,
        held=["walk"],
        counted=counted,
    )


def judged(follower: Follower, condition: Condition, which: IntArray) -> OutputFeedbackFit:
    """The fit applied to other trials (k,)."""
    fit = follower.fit
    other = follower_problem(condition, which, follower.delay, follower.offset)
    there = other.at(np.array(other.starts), np.array(fit.problem.logarithms))
    posed = replace(there, structure=fit.problem.structure)
    cost_weights = gain_space(Point(np.array(fit.K), np.array(fit.S), posed), fit.cost_weights)
    asked = Request(fit.observer, np.array(fit.recorder), counted=fit.space.request.counted)
    space = NoisyUnknowns(cost_weights, asked)
    identified = space.identified(space.start)
    return dataclasses.replace(
        fit, problem=there, identified=identified, log_likelihood=identified.value
    )


def nats(fit: OutputFeedbackFit) -> float:
    """Mean log-likelihood of a sample, without the first three seconds."""
    return float(np.mean([trial.identified[FIRST:] for trial in fit.identified.trials]))


def _beside(follower: Follower, condition: Condition, which: IntArray) -> float:
    """Change of the offset that maximises the likelihood; innovations are linear in it."""
    step = 1.0
    moved = dataclasses.replace(follower, offset=follower.offset + step)
    here, there = (judged(one, condition, which).identified.trials for one in (follower, moved))
    first = np.concatenate([one.innovations[FIRST:, 0] for one in here])
    other = np.concatenate([one.innovations[FIRST:, 0] for one in there])
    spread = np.concatenate([one.spreads[FIRST:, 0, 0] for one in here])
    slope = (other - first) / step
    return -float(np.sum(slope * first / spread) / np.sum(slope**2 / spread))


# Lags of the free regression.
_POSITIONS, _TARGETS = 20, 60


def regression_nats(condition: Condition, mine: IntArray, others: IntArray) -> float:
    """Held-out log-likelihood of a free linear prediction, nats a sample.

    A regression on 20 earlier positions, 60 samples of the target and a constant, fitted to the
    trials `mine` (k,) and evaluated on `others` (j,).
    """

    def tables(which: IntArray) -> tuple[Array, Array]:
        rows = []
        for target, response in zip(
            condition.target[which], condition.response[which], strict=True
        ):
            windows = np.lib.stride_tricks.sliding_window_view
            before = windows(response, _POSITIONS)[FIRST - _POSITIONS : -1]
            seen = windows(target, _TARGETS)[FIRST - _TARGETS + 1 :]
            rows.append(np.hstack([before, seen, np.ones((len(before), 1))]))
        return np.concatenate(rows), condition.response[which][:, FIRST:].ravel()

    columns, position = tables(mine)
    found = np.linalg.lstsq(columns, position, rcond=None)[0]
    variance = float(np.mean((position - columns @ found) ** 2))
    columns, position = tables(others)
    left = (position - columns @ found) ** 2 / variance
    return -float(np.mean(np.log(2 * np.pi * variance) + left)) / 2
