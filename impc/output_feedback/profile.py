"""Profile likelihood intervals (docs/why/output_feedback.md).

The 95 % interval of v'theta is where, with v'theta fixed, 2 (max F - max_fixed F) <= 1.96^2. F is
the fit objective, without the prior of a noise SD that is fixed: its interval is open to zero if F
never falls by enough.
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

# Standard error of a log noise SD above which it counts as weakly identified.
_HARDLY = 0.25
# Root of half of 1.96^2 nats, and the tolerance at an end of an interval.
_FALLEN, _CLOSE = 1.385903, 0.04
#: Largest distance of an end, in coordinates or log noise SDs; beyond it nothing is identified.
FARTHEST = 9.0
# Largest step.
_LONGEST = 2.0
# Largest number of points tried for an end, and evaluation budget at each.
_TRIES, _BUDGET = 12, 25


def level_intervals(fit: OutputFeedbackFit, covariance: PersonCovariance) -> Array:
    """95 % intervals of all noise SDs (l, 2), in their units: profile if weakly identified."""
    found = np.array(covariance.level_intervals(fit.levels))
    for k in np.flatnonzero(covariance.levels > _HARDLY):
        found[k] = level_interval(fit, int(k))
    return frozen(found)


def entry_intervals(fit: OutputFeedbackFit, covariance: PersonCovariance) -> Array:
    """95 % profile intervals of the gain entries (entries, 2), in their units."""
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
    """95 % profile interval of a noise SD."""
    low, high = profile(fit, np.eye(len(fit.theta))[fit.space.own + index])
    return float(np.exp(low)), float(np.exp(high))


def profile(fit: OutputFeedbackFit, along: Array) -> tuple[float, float]:
    """95 % profile interval of along'theta; `along` (q,)."""
    low, high = (_end(fit, along, side) for side in (-1, 1))
    return low, high


def fallen(fit: OutputFeedbackFit, along: Array, value: float) -> float:
    """Drop of the objective with along'theta fixed at `value`, maximised over all else.

    `along` (q,).
    """
    prior, unseen = fit.prior.freed(along), np.array(fit.unseen)
    top = prior.placed(np.array(fit.theta), fit.identified)
    found = held_person(prior, top, along, value - float(along @ top.theta), unseen, _BUDGET)
    return np.inf if found is None else top.value - found[0].value


def _end(fit: OutputFeedbackFit, along: Array, side: int) -> float:
    """Point at which the profile has fallen by enough on one side, by local quadratics."""
    prior, begin = fit.prior.freed(along), float(along @ fit.theta)
    here, unseen = prior.placed(np.array(fit.theta), fit.identified), np.array(fit.unseen)
    top, inside, outside, value = here.value, begin, side * np.inf, begin
    for _ in range(_TRIES):
        gradient, curvature = prior.parabola(here, unseen)
        ridge = np.asarray(np.linalg.solve(curvature, along), dtype=np.float64)
        spread, peak = float(along @ ridge), value + float(ridge @ gradient)
        # There the profile is (value - peak)^2 / (2 spread) below its maximum.
        room = 2 * spread * (_FALLEN**2 - top + here.value) + (value - peak) ** 2
        goal = peak + side * np.sqrt(room) if room > 0 else inside
        goal = side * min(side * goal, side * value + _LONGEST, side * begin + FARTHEST)
        if not side * inside < side * goal < side * outside:
            goal = (inside + outside) / 2 if np.isfinite(outside) else inside + side * _LONGEST
        found = held_person(prior, here, along, goal - value, unseen, _BUDGET)
        if found is None:  # undefined: treat as beyond the end
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
    """Maximise the objective with along'theta shifted by `off` and fixed."""
    # Start on the ridge of the local quadratic, or along the direction itself if that is higher: a
    # straight ridge may leave the stabilising gains, and moves a very small noise SD too far.
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
    """Basis (q, q - 1) of the complement of a direction, with unit vectors if possible."""
    mine = np.flatnonzero(along)
    turned = np.zeros((len(along), len(mine) - 1))
    turned[mine] = scipy.linalg.null_space(along[None, mine])
    return np.hstack([np.delete(np.eye(len(along)), mine, axis=1), turned])
