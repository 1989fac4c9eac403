"""A simulated subject of `noisy_people` scored: least squares beside maximum likelihood."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from impc.assess.covariance import gain_covariance
from impc.inverse.methods import fit
from impc.output_feedback.covariance import person_covariance
from impc.output_feedback.fit import fit_output_feedback
from impc.output_feedback.prior import IDENTIFIED
from impc.output_feedback.profile import fallen
from impc.output_feedback.simulation import simulate_person

if TYPE_CHECKING:
    from experiments.noisy_people import Recorded, Subject
    from impc.arrays import Array
    from impc.output_feedback.covariance import PersonCovariance
    from impc.output_feedback.fit import OutputFeedbackFit
    from impc.output_feedback.observer import Observer

__all__ = [
    "FALLEN",
    "LIMITS",
    "Score",
    "above_truth",
    "blind",
    "falls",
    "passed_over",
    "score",
    "true_unknowns",
]

#: A limit that is not met, and one that is, of each body at each VAF.
LIMITS = {
    ("cart", 90.0): (5.0, 0.7),
    ("cart", 70.0): (5.0, 0.7),
    ("pair", 90.0): (5.0, 0.7),
    ("pair", 70.0): (5.0, 0.7),
    ("seat", 90.0): (70.0, 6.0),
    ("seat", 70.0): (70.0, 9.0),
}
# Who on the seat is at a limit that is met in fewer samples, or more, is no subject, nor who falls
# in any trial that is not recorded, from this number on: of people who fall now and then, those who
# did not have had other noise than the model says.
_SHARES, _UNSEEN, _SIMULATED = (0.12, 0.40), 1000, 60
#: An angle that is a fall, rad.
FALLEN = 1.0


@dataclass(frozen=True)
class Score:
    """A subject.

    Attributes
    ----------
    study : str
        Body, noise, VAF and limit.
    seed : int
    saturated : float
        Share of the samples at the limit.
    vaf : float
        Of the motion without noise, %.
    above : float
        What the search makes largest, at its end minus at the truth, nats.
    converged : bool
    evaluations : int
    least_error, likely_error : float
        Of the gain, as a share of it, in natural coordinates.
    least, likely, expected : list of pairs
        Error and deviation along each direction that the method says, the best first: of least
        squares, and of maximum likelihood by the sandwich and as expected.
    entries : list of pairs
        Intervals of the entries of the gain by the sandwich, less the truth, as shares of the
        entry: as printed.
    fell : list of float
        Where asked for, by how many nats the likelihood falls with each of the directions of
        `likely` held at the truth.
    levels, found : list of float
        Motor, senses, recorder: true, and found.
    level_intervals : list of pairs
        By the sandwich, as printed.
    seconds : list of float
        Of processor time: least squares, likelihood, what falls.
    """

    study: str
    seed: int
    saturated: float
    vaf: float
    above: float
    converged: bool
    evaluations: int
    least_error: float
    likely_error: float
    least: list[tuple[float, float]]
    likely: list[tuple[float, float]]
    expected: list[tuple[float, float]]
    entries: list[tuple[float, float]]
    fell: list[float]
    levels: list[float]
    found: list[float]
    level_intervals: list[tuple[float, float]]
    seconds: list[float]


def score(
    who: Subject,
    trials: Recorded,
    study: str,
    seed: int,
    *,
    profiled: bool = False,
) -> Score:
    """Both fits of a subject and, asked for, what falls."""
    truth = np.array(who.controller.K)
    clock = [time.process_time()]
    first = fit(trials.problem)
    gain, metric = np.array(first.gain), np.array(first.metric)
    least = gain_covariance(first.problem, gain, metric, curvature=True)
    clock.append(time.process_time())
    likely = fit_output_feedback(first, blind(who))
    clock.append(time.process_time())
    expected = person_covariance(likely, "expected")
    robust = person_covariance(likely)
    true = truth.reshape(-1, 1)
    entries = (robust.entry_intervals(likely.K) - true) / np.abs(true)
    fell = _fell(likely, robust, who) if profiled else []
    clock.append(time.process_time())
    size = float(np.linalg.norm(truth @ least.T))
    return Score(
        study,
        seed,
        trials.saturated,
        trials.vaf,
        above_truth(likely, who),
        likely.converged,
        likely.evaluations,
        float(np.linalg.norm((gain - truth) @ least.T)) / size,
        float(np.linalg.norm((likely.K - truth) @ least.T)) / size,
        _pairs(
            least.directions,
            least.deviations,
            np.asarray(np.linalg.solve(least.G, (gain - truth) @ least.T)),
        ),
        _steps(likely, robust, truth),
        _steps(likely, expected, truth),
        entries.tolist(),
        fell,
        [*who.person.levels[who.person.levels > 0], *who.recorder],
        likely.levels.tolist(),
        robust.level_intervals(likely.levels).tolist(),
        np.diff(clock).tolist(),
    )


def blind(who: Subject) -> Observer:
    """Levels to start from that know nothing of the subject but which there are."""
    return who.person.with_levels(np.where(who.person.levels > 0, 0.1, 0.0))


def above_truth(likely: OutputFeedbackFit, who: Subject) -> float:
    """What the search makes largest, at the fit minus at the subject as simulated, nats."""
    return likely.value - likely.prior.at(true_unknowns(likely, who)).value


def true_unknowns(likely: OutputFeedbackFit, who: Subject) -> Array:
    """The subject as simulated, in the coordinates of the fit (q,)."""
    space = likely.space
    own, theta = space.space, np.array(space.start)
    truth = own.natural(np.array(who.controller.K))
    theta[: space.gain] = np.tensordot(own.natural(own.gains), truth, 2)
    starts = np.array([trial.x0 for trial in own.problem.recordings])
    theta[space.shared : space.after] = np.ravel(-np.linalg.solve(own.own_unit, starts.T).T)
    levels = np.concatenate([who.person.levels, who.recorder])
    theta[space.own :] = np.log(levels[space.moving])
    return theta


def _steps(
    likely: OutputFeedbackFit, covariance: PersonCovariance, truth: Array
) -> list[tuple[float, float]]:
    own, space = likely.space.space, likely.space
    error = own.natural(np.array(likely.K) - truth)
    along = np.tensordot(own.natural(own.gains), error, 2)
    return _pairs(covariance.directions, covariance.deviations, along[: space.gain])


def _identified(directions: Array, deviations: Array) -> tuple[Array, Array]:
    """Determined directions and their deviations, the best identified first."""
    order = np.argsort(deviations, kind="stable")
    order = order[deviations[order] < IDENTIFIED]
    return directions[order], deviations[order]


def _aims(
    fit: OutputFeedbackFit, covariance: PersonCovariance, who: Subject
) -> tuple[Array, Array, Array]:
    """Determined directions, their deviations, and where the truth is along them."""
    directions, deviations = _identified(covariance.directions, covariance.deviations)
    return directions, deviations, directions @ true_unknowns(fit, who)[: fit.space.gain]


def _fell(likely: OutputFeedbackFit, covariance: PersonCovariance, who: Subject) -> list[float]:
    """What the likelihood falls by along each direction held at the truth, nats."""
    found, along = [], np.zeros(len(likely.theta))
    directions, _, aims = _aims(likely, covariance, who)
    for direction, aim in zip(directions, aims, strict=True):
        along[: likely.space.gain] = direction
        found.append(fallen(likely, along, float(aim)))
    return found


def _pairs(directions: Array, deviations: Array, error: Array) -> list[tuple[float, float]]:
    """Errors and deviations along determined directions, each turned to where it is largest."""
    found = []
    for direction, deviation in zip(*_identified(directions, deviations), strict=True):
        sign = np.sign(direction[np.argmax(np.abs(direction))])
        found.append((float(sign * direction @ np.ravel(error)), float(deviation)))
    return found


def passed_over(who: Subject, trials: Recorded, seed: int, *, met: bool) -> str:
    """Why somebody on the seat is no subject; empty for a subject."""
    low, high = _SHARES
    if trials.largest > FALLEN or (met and falls(who, seed)):
        return "falls"
    return "" if not met or low <= trials.saturated <= high else "not so often at the limit"


def falls(who: Subject, seed: int) -> int:
    """In how many of sixty trials that nobody records a subject falls."""
    found = 0
    for number in range(_SIMULATED):
        push = who.pushes[number % len(who.pushes)]
        drawn = [seed, _UNSEEN + number]
        outputs = simulate_person(who.controller, who.person, push, seed=drawn).outputs
        found += bool(np.any(np.abs(np.array(outputs)) > FALLEN))
    return found
