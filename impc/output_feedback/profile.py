"""Intervals by profile likelihood: they need no parabola (docs/noisy-people.md).

The interval of 95 % of v'theta is where, with v'theta held, 2 (max F - max_held F) <= 1.96^2. F is
what the search makes largest, but that of a level that is held nothing is expected: its interval
is open to zero where F never falls.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import scipy.linalg

from impc.arrays import Array, frozen
from impc.output_feedback.prior import IDENTIFIED
from impc.output_feedback.search import climb

if TYPE_CHECKING:
    from impc.arrays import Array
    from impc.output_feedback.covariance import PersonCovariance
    from impc.output_feedback.fit import OutputFeedbackFit
    from impc.output_feedback.prior import Place, Prior

# A level whose logarithm has a larger deviation is weakly identified.
_HARDLY = 0.25
# Root of half of 1.96^2, of nats, and how near to it an end of an interval is found.
_FALLEN, _CLOSE = 1.385903, 0.04
#: No end is looked for farther away, and what is known to no more is not identified: some
#: thousands of a
#: level, which is then none, or that of a sense which is not used.
FARTHEST = 9.0
# A step is no longer than this.
_LONGEST = 2.0
# Places at which an end is looked for, and likelihoods with derivatives at each.
_TRIES, _BUDGET = 12, 25


def level_intervals(fit: OutputFeedbackFit, covariance: PersonCovariance) -> Array:
    """Intervals of 95 % of all levels (l, 2), in their units: by profile if weakly identified."""
    found = np.array(covariance.level_intervals(fit.levels))
    for k in np.flatnonzero(covariance.levels > _HARDLY):
        found[k] = level_interval(fit, int(k))
    return frozen(found)


def entry_intervals(fit: OutputFeedbackFit, covariance: PersonCovariance) -> Array:
    """Intervals of 95 % of the entries of the gain (entries, 2) by profile, in their units."""
    dK, _ = fit.space.changes(fit.theta)
    found = []
    for value, slopes, deviation in zip(
        np.ravel(fit.K), dK.reshape(len(dK), -1).T, np.ravel(covariance.entries), strict=True
    ):
        length = float(np.linalg.norm(slopes))
        if not deviation < IDENTIFIED * length:
            found.append((np.nan, np.nan))
            continue
        along = np.zeros(len(fit.theta))
        along[: len(dK)] = slopes / length
        ends = np.array(profile(fit, along)) - float(along @ fit.theta)
        found.append(tuple(value + length * ends))
    return frozen(found)


def level_interval(fit: OutputFeedbackFit, index: int) -> tuple[float, float]:
    """Interval of 95 % of a level by profile."""
    low, high = profile(fit, np.eye(len(fit.theta))[fit.space.own + index])
    return float(np.exp(low)), float(np.exp(high))


def profile(fit: OutputFeedbackFit, along: Array) -> tuple[float, float]:
    """Interval of 95 % of along'theta by profile; `along` (q,)."""
    low, high = (_end(fit, along, side) for side in (-1, 1))
    return low, high


def fallen(fit: OutputFeedbackFit, along: Array, value: float) -> float:
    """By how much the likelihood falls with along'theta held at a value, all else at its best.

    `along` (q,).
    """
    prior, unseen = fit.prior.freed(along), np.array(fit.unseen)
    top = prior.placed(np.array(fit.theta), fit.identified)
    found = held_person(prior, top, along, value - float(along @ top.theta), unseen, _BUDGET)
    return np.inf if found is None else top.value - found[0].value


def _end(fit: OutputFeedbackFit, along: Array, side: int) -> float:
    """Where the profile has fallen by enough on one side, found by parabolas."""
    prior, begin = fit.prior.freed(along), float(along @ fit.theta)
    here, unseen = prior.placed(np.array(fit.theta), fit.identified), np.array(fit.unseen)
    top, inside, outside, value = here.value, begin, side * np.inf, begin
    for _ in range(_TRIES):
        gradient, curvature = prior.parabola(here, unseen)
        ridge = np.asarray(np.linalg.solve(curvature, along), dtype=np.float64)
        spread, peak = float(along @ ridge), value + float(ridge @ gradient)
        # There the profile falls by (value - peak)^2 / (2 spread), of its largest.
        room = 2 * spread * (_FALLEN**2 - top + here.value) + (value - peak) ** 2
        goal = peak + side * np.sqrt(room) if room > 0 else inside
        goal = side * min(side * goal, side * value + _LONGEST, side * begin + FARTHEST)
        if not side * inside < side * goal < side * outside:
            goal = (inside + outside) / 2 if np.isfinite(outside) else inside + side * _LONGEST
        found = held_person(prior, here, along, goal - value, unseen, _BUDGET)
        if found is None:  # as far as an end may be
            outside = goal
            continue
        (here, unseen), value = found, goal
        root = float(np.sqrt(max(top - here.value, 0.0)))
        if abs(root - _FALLEN) < _CLOSE:
            return value
        if root > _FALLEN:
            outside = value
        elif side * (value - begin) >= FARTHEST:
            break
        else:
            inside = value
    return outside


def held_person(
    prior: Prior, here: Place, along: Array, off: float, unseen: Array, budget: int
) -> tuple[Place, Array] | None:
    """The best of all else with along'theta so far off."""
    # On the ridge of the parabola, or beside it where that is higher: a straight ridge may leave
    # the gains that stabilise, and moves a level that is all but none by many powers of e.
    _, curvature = prior.parabola(here, unseen)
    ridge = np.asarray(np.linalg.solve(curvature, along), dtype=np.float64)
    ways = ridge / float(along @ ridge), along
    starts = [place for way in ways if (place := prior.tried(here.theta + off * way))]
    if not starts:
        return None
    begin = max(starts, key=lambda place: place.value)
    found, unseen, _, _ = climb(prior, begin, budget, _across(along), unseen)
    return found, unseen


def _across(along: Array) -> Array:
    """All that is orthogonal to a direction (q, q - 1); coordinates it leaves alone, as such."""
    mine = np.flatnonzero(along)
    turned = np.zeros((len(along), len(mine) - 1))
    turned[mine] = scipy.linalg.null_space(along[None, mine])
    return np.hstack([np.delete(np.eye(len(along)), mine, axis=1), turned])
