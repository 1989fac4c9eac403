"""Score the fits of a simulated subject: least squares and maximum likelihood."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from experiments.noisy_people import Recorded, Subject
from impc.arrays import Array
from impc.assess.covariance import gain_covariance
from impc.inverse.methods import fit
from impc.output_feedback.fit import OutputFeedbackFit, fit_output_feedback
from impc.output_feedback.intervals import IDENTIFIED, PersonCovariance, fallen, person_covariance
from impc.output_feedback.observer import Observer
from impc.output_feedback.simulation import simulate_person

__all__ = ["Score", "above_truth", "blind", "passed_over", "score"]

# Subjects on the seat are left out if they saturate outside this range, or if they fall in any of
# `_SIMULATED` further trials: the noise of trials without a fall differs from that of the model.
_SHARES, _UNSEEN, _SIMULATED = (0.12, 0.40), 1000, 60
# Angle that counts as a fall, rad.
_FALLEN = 1.0

Pairs = list[tuple[float, float]]


class Score(NamedTuple):
    """Scores of both fits of a subject."""

    saturated: float  # Share of the samples at the limit
    vaf: float  # VAF of the motion without noise, %
    above: float  # Objective of the search at its end minus that at the truth, nats
    converged: bool
    least_error: float  # Relative error of the gain of least squares, in whitened coordinates
    likely_error: float  # The same of maximum likelihood
    # Error and standard error along each determined direction, best first: of least squares, and of
    # maximum likelihood with sandwich and with expected covariance.
    least: Pairs
    likely: Pairs
    expected: Pairs
    # Fall of the likelihood with each direction of `likely` fixed at the truth, nats, if profiled.
    fell: list[float]
    levels: list[float]  # True noise SDs: motor, senses, recording
    found: list[float]  # Fitted noise SDs
    level_intervals: Pairs  # Their printed sandwich intervals


def score(who: Subject, trials: Recorded, *, profiled: bool = False) -> Score:
    """Fit a subject by both methods, with profiles on request."""
    truth = np.array(who.controller.K)
    first = fit(trials.problem)
    gain, metric = np.array(first.gain), np.array(first.metric)
    least = gain_covariance(first.problem, gain, metric, curvature=True)
    likely = fit_output_feedback(first, blind(who))
    robust = person_covariance(likely)
    size = float(np.linalg.norm(truth @ least.T))
    return Score(
        trials.saturated,
        trials.vaf,
        above_truth(likely, who),
        likely.converged,
        float(np.linalg.norm((gain - truth) @ least.T)) / size,
        float(np.linalg.norm((likely.K - truth) @ least.T)) / size,
        _pairs(
            least.directions,
            least.deviations,
            np.asarray(np.linalg.solve(least.G, (gain - truth) @ least.T)),
        ),
        _steps(likely, robust, truth),
        _steps(likely, person_covariance(likely, "expected"), truth),
        _fell(likely, robust, who) if profiled else [],
        [*who.person.levels[who.person.levels > 0], *who.recorder],
        likely.levels.tolist(),
        robust.level_intervals(likely.levels).tolist(),
    )


def blind(who: Subject) -> Observer:
    """Starting noise SDs that use only which of them are zero."""
    return who.person.with_levels(np.where(who.person.levels > 0, 0.1, 0.0))


def above_truth(likely: OutputFeedbackFit, who: Subject) -> float:
    """Objective of the search at the fit minus that at the true subject, nats."""
    return likely.value - likely.space.at(_true_unknowns(likely, who)).value


def _true_unknowns(likely: OutputFeedbackFit, who: Subject) -> Array:
    """The true subject in the coordinates of the fit, shape (q,)."""
    space = likely.space
    own, theta = space.space, np.array(space.start)
    truth = space.gain_law.natural(np.array(who.controller.K))
    theta[: space.gain] = np.tensordot(space.gain_law.natural(space.gain_law.gains), truth, 2)
    starts = np.array([trial.x0 for trial in own.problem.recordings])
    theta[space.shared : space.after] = np.ravel(-np.linalg.solve(own.own_unit, starts.T).T)
    levels = np.concatenate([who.person.levels, who.recorder])
    theta[space.own :] = np.log(levels[space.moving])
    return theta


def _steps(likely: OutputFeedbackFit, covariance: PersonCovariance, truth: Array) -> Pairs:
    space = likely.space
    error = space.gain_law.natural(np.array(likely.K) - truth)
    along = np.tensordot(space.gain_law.natural(space.gain_law.gains), error, 2)
    return _pairs(covariance.directions, covariance.deviations, along[: space.gain])


def _identified(directions: Array, deviations: Array) -> tuple[Array, Array]:
    """Determined directions and their standard errors, best first."""
    order = np.argsort(deviations, kind="stable")
    order = order[deviations[order] < IDENTIFIED]
    return directions[order], deviations[order]


def _fell(likely: OutputFeedbackFit, covariance: PersonCovariance, who: Subject) -> list[float]:
    """Fall of the likelihood with each determined direction fixed at the truth, nats."""
    found, along, size = [], np.zeros(len(likely.theta)), likely.space.gain
    truth = _true_unknowns(likely, who)[:size]
    for direction in _identified(covariance.directions, covariance.deviations)[0]:
        along[:size] = direction
        found.append(fallen(likely, along, float(direction @ truth)))
    return found


def _pairs(directions: Array, deviations: Array, error: Array) -> Pairs:
    """Errors and standard errors along determined directions, with a fixed sign convention."""
    found = []
    for direction, deviation in zip(*_identified(directions, deviations), strict=True):
        sign = np.sign(direction[np.argmax(np.abs(direction))])
        found.append((float(sign * direction @ np.ravel(error)), float(deviation)))
    return found


def passed_over(who: Subject, trials: Recorded, seed: int, *, met: bool) -> str:
    """Why a subject on the seat is left out; empty if kept."""
    low, high = _SHARES
    if trials.largest > _FALLEN or (met and _falls(who, seed)):
        return "falls"
    return "" if not met or low <= trials.saturated <= high else "not so often at the limit"


def _falls(who: Subject, seed: int) -> int:
    """Number of sixty further simulated trials that end in a fall."""
    found = 0
    for number in range(_SIMULATED):
        push = who.pushes[number % len(who.pushes)]
        drawn = [seed, _UNSEEN + number]
        outputs = simulate_person(who.controller, who.person, push, seed=drawn).outputs
        found += bool(np.any(np.abs(np.array(outputs)) > _FALLEN))
    return found
