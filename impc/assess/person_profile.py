"""Intervals of a person's gain and levels of noise by profile: they need no parabola.

Where half of a gain is hardly told the other half bends with it, by many of its deviations, and the
logarithm of a level that is weakly told is not normal, for its likelihood falls on one side and
stays on the other. The interval of 95 % of v'theta is where, with v'theta held,

    2 (max F - max_held F) <= 1.96^2

F is what the search makes largest, but that of a level that is held nothing is expected: it is
open to zero where F never falls, and the level is then at most its upper end.

What the noise of one sense explains that of another may explain as well, so that F has hills for
people with other senses, each almost as high: each search for an end begins at the place farthest
out of all that are known to be likely enough, those of such hills and those that searches for other
ends have been at among them (docs/noisy-people.md).
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import scipy.linalg

from impc.arrays import Array, frozen
from impc.inverse.likelihood_search import boxed_step, climb, longest

if TYPE_CHECKING:
    from impc.assess.person_covariance import PersonCovariance
    from impc.inverse.likelihood_fit import PersonFit
    from impc.inverse.person_prior import Place, Prior

__all__ = [
    "FARTHEST",
    "Known",
    "entry_intervals",
    "entry_ways",
    "hills",
    "level_interval",
    "level_intervals",
    "profiles",
]

# A level whose logarithm has a larger deviation is weakly told, and an entry of the gain with one
# in natural coordinates (`Coordinates`) not by itself.
_HARDLY = 0.25
# Root of half of 1.96^2, of nats, and how near to it a place is from which an end is told: where
# the parabola there has fallen by enough, if that is no farther than this share of the way, or of
# a deviation. Where the likelihood jumps no end is known better.
_FALLEN, _CLOSE, _SHARE, _LEAST = 1.385903, 0.15, 0.15, 0.05
#: No end is looked for farther away, and what is told to no more is not told: some thousands of a
#: level, which is then none, or that of a sense which is not used.
FARTHEST = 9.0
# A step is no longer than this; where it lowers what is to be largest by more nats it is halved, so
# many times at most.
_LONGEST, _DROP, _HALVES = 2.0, 20.0, 6
# Places at which an end is looked for, and likelihoods with derivatives at each; all else is at its
# best when no more is promised, nats.
_TRIES, _BUDGET, _SURE = 14, 20, 0.03
# Logarithm by which the noise of a sense that is all but exact is below what is expected, and
# likelihoods of a search that begins there.
_EXACT, _LOOK = 5.0, 15


class Known(NamedTuple):
    """A place where a search has been.

    Attributes
    ----------
    place : Place
    losing : Array
        Slope of what levels lose there (levels,), nats.
    """

    place: Place
    losing: Array


def entry_intervals(fit: PersonFit, covariance: PersonCovariance) -> Array:
    """Intervals of 95 % of the entries of the gain (entries, 2) by profile, in their units.

    Parameters
    ----------
    fit : PersonFit
        Where prices were searched, an entry is held along its slope.
    covariance : PersonCovariance
        An entry whose deviation is more than a quarter of a coordinate has no numbers, NaN: the
        recordings do not tell it by itself.
    """
    ways, lengths = entry_ways(fit, covariance)
    told = np.isfinite(lengths)
    found = np.full((len(ways), 2), np.nan)
    off = profiles(fit, ways[told], hills(fit)) - (ways[told] @ fit.theta)[:, None]
    found[told] = np.ravel(fit.K)[told, None] + lengths[told, None] * off
    return frozen(found)


def entry_ways(fit: PersonFit, covariance: PersonCovariance) -> tuple[Array, Array]:
    """Directions of the unknowns along which the entries of the gain change (entries, q).

    Beside them by how much they change (entries,): NaN for one that is not told by itself.

    Parameters
    ----------
    fit, covariance
        As in `entry_intervals`.
    """
    dK, _ = fit.space.changes(fit.theta)
    slopes = np.zeros((fit.K.size, len(fit.theta)))
    slopes[:, : len(dK)] = dK.reshape(len(dK), -1).T
    lengths = np.linalg.norm(slopes, axis=1)
    told = np.ravel(covariance.entries) < _HARDLY * lengths
    return slopes / np.where(told, lengths, 1.0)[:, None], np.where(told, lengths, np.nan)


def level_intervals(fit: PersonFit, covariance: PersonCovariance) -> Array:
    """Intervals of 95 % of all levels (l, 2), in their units: by profile if weakly told.

    Parameters
    ----------
    fit : PersonFit
    covariance : PersonCovariance
        Gives the intervals of levels that are well told.
    """
    values = np.exp(fit.theta[fit.space.own :])
    return frozen(
        [
            level_interval(fit, k)
            if covariance.levels[k] > _HARDLY
            else covariance.level_interval(k, float(value))
            for k, value in enumerate(values)
        ]
    )


def level_interval(fit: PersonFit, index: int) -> tuple[float, float]:
    """Interval of 95 % of a level by profile, about the hill of the fit.

    Parameters
    ----------
    fit : PersonFit
    index : int
        Of the level among `fit.space.names`.

    Returns
    -------
    low, high : float
        In the level's unit; 0 or infinite where the likelihood does not fall as far as a level is
        searched.
    """
    way = np.eye(len(fit.theta))[fit.space.own + index]
    low, high = profiles(fit, way[None], [_first(fit)])[0]
    return float(np.exp(low)), float(np.exp(high))


def profiles(fit: PersonFit, ways: Array, known: list[Known]) -> Array:
    """Intervals of 95 % of ways @ theta (k, 2), infinite where no end is found.

    Parameters
    ----------
    fit : PersonFit
    ways : Array
        Directions of the unknowns of the fit (k, q), of length one.
    known : list of Known
        Where searches may begin; those that they have been at are added.
    """
    found = np.array([(-_end(fit, -way, known), _end(fit, way, known)) for way in ways])
    for way, ends in zip(ways, found, strict=True):
        # The search for the end of another may have come farther.
        likely, _ = _likely(fit.prior.freed(way), known)
        values = [float(way @ one.place.theta) for one in likely]
        ends[:] = min(ends[0], *values), max(ends[1], *values)
    return frozen(found.reshape(-1, 2))


def hills(fit: PersonFit) -> list[Known]:
    """The fit, and where searches end that begin with one of the senses all but exact.

    Parameters
    ----------
    fit : PersonFit
    """
    found = [_first(fit)]
    for index in fit.space.senses:
        exact = np.array(fit.theta)
        exact[index] = fit.prior.scales[index - fit.space.own] - _EXACT
        if there := fit.prior.tried(exact):
            place, losing, _, _ = climb(fit.prior, there, _LOOK, losing=np.array(fit.losing))
            found.append(Known(_light(place), losing))
    return found


def _first(fit: PersonFit) -> Known:
    return Known(_light(fit.prior.placed(np.array(fit.theta), fit.told)), np.array(fit.losing))


def _likely(prior: Prior, known: list[Known]) -> tuple[list[Known], float]:
    """Places inside an interval, by this prior, and the largest value of all."""
    places = [prior.placed(place.theta, place.told) for place, _ in known]
    top = max(place.value for place in places)
    inside = [
        Known(place, losing)
        for place, (_, losing) in zip(places, known, strict=True)
        if _root(top, place) <= _FALLEN
    ]
    return inside, top


def _end(fit: PersonFit, way: Array, known: list[Known]) -> float:
    """Where the profile of way'theta has fallen by enough, upwards.

    With all else at its best the slope along the value is that of the profile, and the information
    its curvature: the next value is where a parabola with both has fallen by enough, and the next
    search begins where that has all else. The likelihood jumps, so that an end is not looked for
    any nearer than a parabola from a place beside it tells.
    """
    prior, across = fit.prior.freed(way), _across(way)
    likely, top = _likely(prior, known)
    here, losing = max(likely, key=lambda one: float(way @ one.place.theta))
    begin, inside, outside = float(way @ fit.theta), -np.inf, np.inf
    for _ in range(_TRIES):
        here, losing, _, _ = climb(prior, here, _BUDGET, across, losing, _SURE)
        known.append(Known(_light(here), losing))
        value, root = float(way @ here.theta), _root(top, here)
        slope, bend = prior.parabola(here, losing)
        goal, deviation = _goal(slope, bend, way, value, root)
        near = max(_SHARE * (value - begin), _LEAST * deviation)
        if abs(root - _FALLEN) < _CLOSE and abs(goal - value) < near:
            return goal
        if root > _FALLEN:
            outside = min(value, outside)
        elif value - begin >= FARTHEST:
            return np.inf
        else:
            inside = max(value, inside)
        if outside - inside < near:
            break
        goal = min(goal, value + _LONGEST, begin + FARTHEST)
        if not inside < goal < outside:
            goal = (inside + outside) / 2 if np.isfinite(outside) else inside + _LONGEST
        there = _moved(prior, here, slope, bend, way, across, goal - value)
        if there is None:  # there is nobody beyond
            return value
        here = there
    return outside


def _light(place: Place) -> Place:
    """A place that can be kept by the hundred: without what is told of each sample."""
    return place._replace(told=dataclasses.replace(place.told, scores=[], trials=[]))


def _root(top: float, place: Place) -> float:
    """Root of how far a place is below the highest, nats."""
    return float(np.sqrt(max(top - place.value, 0.0)))


def _goal(slope: Array, bend: Array, way: Array, value: float, root: float) -> tuple[float, float]:
    """Where a profile with a slope (q,) and curvature (q, q) along `way` has fallen by enough.

    Its parabola falls by (v - peak)^2 / (2 spread) of its largest, and has fallen by root^2 at
    `value`; minus infinity where it never falls so little. And the deviation that it tells.
    """
    ridge = np.asarray(np.linalg.solve(bend, way), dtype=np.float64)
    spread, peak = float(way @ ridge), value + float(ridge @ slope)
    room = 2 * spread * (_FALLEN**2 - root**2) + (value - peak) ** 2
    goal = peak + float(np.sqrt(room)) if room > 0 else -np.inf
    return goal, float(np.sqrt(spread))


def _moved(
    prior: Prior, here: Place, slope: Array, bend: Array, way: Array, across: Array, off: float
) -> Place | None:
    """A place so far off, all else where the parabola puts it; None where there is no filter.

    All else keeps to a box: the ridge may leave the gains that stabilise, and that of a recorder's
    noise moves a level that is all but none by twenty powers of e for one of its own.
    """
    radius = longest(prior, across)
    for share in 0.5 ** np.arange(_HALVES):
        pull = across.T @ (slope - share * off * (bend @ way))
        step, _ = boxed_step(pull, across.T @ bend @ across, radius)
        there = prior.tried(here.theta + share * off * way + across @ step)
        if there is not None and there.value > here.value - _DROP:
            return there
    return None


def _across(along: Array) -> Array:
    """All that is orthogonal to a direction (q, q - 1); coordinates it leaves alone, as such."""
    mine = np.flatnonzero(along)
    turned = np.zeros((len(along), len(mine) - 1))
    turned[mine] = scipy.linalg.null_space(along[None, mine])
    return np.hstack([np.delete(np.eye(len(along)), mine, axis=1), turned])
