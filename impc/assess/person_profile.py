"""Profiles of a person's levels of noise and of the gain: intervals that need no parabola.

The logarithm of a level that is weakly told is not normal, for its likelihood falls on one side and
stays on the other; and where half of a gain is hardly told the other half bends with it, by many of
its deviations. The interval of 95 % of v'theta is where, with v'theta held,

    2 (max F - max_held F) <= 1.96^2

F is what the search makes largest, but that of a level that is held nothing is expected: it is
open to zero where F never falls, and the level is then at most its upper end
(docs/noisy-people.md).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import scipy.linalg

from impc.arrays import Array, frozen
from impc.errors import ImpcError
from impc.inverse.likelihood_search import climb

if TYPE_CHECKING:
    from impc.assess.person_covariance import PersonCovariance
    from impc.inverse.likelihood_fit import PersonFit

__all__ = ["entry_intervals", "fallen", "level_interval", "level_intervals", "profile"]

# Root of half of 1.96^2, of nats, and how near to it an end of an interval is found.
_FALLEN, _CLOSE = 1.385903, 0.04
_NORMAL = 1.959964
# A first step is no longer than this, and no end is looked for farther away: some thousands of a
# level, which is then none, or that of a sense which is not used.
_LONGEST, _FARTHEST = 2.0, 9.0
# Places at which an end is looked for, and likelihoods with derivatives at each.
_TRIES, _BUDGET = 12, 15
# Keeps a covariance finite: of a coordinate that nothing tells the deviation is ten.
_FLAT = 1e-2
# A level whose logarithm has a larger deviation is given a profile, an entry of the gain that has
# one is not told by itself: of a natural coordinate (`Coordinates`).
_WEAK = 0.25


def level_intervals(fit: PersonFit, covariance: PersonCovariance, *, weak: float = _WEAK) -> Array:
    """Intervals of 95 % of all levels (l, 2), in their units.

    Parameters
    ----------
    fit : PersonFit
    covariance : PersonCovariance
        Gives the intervals of levels that are well told.
    weak : float
        A level whose logarithm has a larger deviation has its interval by profile.
    """
    values = np.exp(fit.theta[fit.space.own :])
    return frozen(
        [
            level_interval(fit, k)
            if covariance.levels[k] > weak
            else covariance.level_interval(k, float(value))
            for k, value in enumerate(values)
        ]
    )


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
    dK, _ = fit.space.changes(fit.theta)
    found = []
    for value, slopes, deviation in zip(
        np.ravel(fit.K), dK.reshape(len(dK), -1).T, np.ravel(covariance.entries), strict=True
    ):
        length = float(np.linalg.norm(slopes))
        if not deviation < _WEAK * length:
            found.append((np.nan, np.nan))
            continue
        along = np.zeros(len(fit.theta))
        along[: len(dK)] = slopes / length
        ends = np.array(profile(fit, along)) - float(along @ fit.theta)
        found.append(tuple(value + length * ends))
    return frozen(found)


def level_interval(fit: PersonFit, index: int) -> tuple[float, float]:
    """Interval of 95 % of a level by profile.

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
    low, high = profile(fit, np.eye(len(fit.theta))[fit.space.own + index])
    return float(np.exp(low)), float(np.exp(high))


def profile(fit: PersonFit, along: Array) -> tuple[float, float]:
    """Interval of 95 % of along'theta by profile.

    Parameters
    ----------
    fit : PersonFit
    along : Array
        A direction of the unknowns of the fit (q,), of length one.

    Returns
    -------
    low, high : float
        Infinite where the likelihood does not fall as far as is searched.
    """
    low, high = (_end(fit, along, side) for side in (-1, 1))
    return low, high


def fallen(fit: PersonFit, along: Array, value: float) -> float:
    """By how much the likelihood falls with along'theta held at a value, all else at its best.

    Parameters
    ----------
    fit : PersonFit
    along : Array
        As in `profile` (q,).
    value : float
        In the coordinates of the fit.

    Returns
    -------
    float
        Nats; infinite where nothing was found.
    """
    ridge = _covariance(fit) @ along
    return _held(fit, np.array(fit.theta), along, ridge, value)[1]


def _end(fit: PersonFit, along: Array, side: int) -> float:
    """Where the profile has fallen by enough on one side.

    The root of what has fallen is straight where the likelihood is that of a normal number, so the
    next guess lies on a line.
    """
    theta, ridge = np.array(fit.theta), _covariance(fit) @ along
    spread = float(np.sqrt(along @ ridge))
    begin = float(along @ theta)
    border, step = begin + side * _FARTHEST, min(_NORMAL * spread, _LONGEST)
    inside, outside = (begin, 0.0), (np.nan, np.inf)
    value = begin + side * step
    for _ in range(_TRIES):
        value = border if side * (value - border) >= 0 else value
        theta, nats = _held(fit, theta, along, ridge, value)
        root = float(np.sqrt(max(nats, 0.0)))
        if abs(root - _FALLEN) < _CLOSE:
            return value
        if root < _FALLEN and value == border:
            return side * np.inf
        if root < _FALLEN:
            inside = value, root
        else:
            outside = value, root
        if np.isfinite(outside[0]):
            share = (_FALLEN - inside[1]) / (outside[1] - inside[1])
            value = inside[0] + min(max(share, 0.1), 0.9) * (outside[0] - inside[0])
        else:
            value += side * min(_LONGEST, step * max(_FALLEN / max(root, 0.3) - 1, 0.5))
    return outside[0] if np.isfinite(outside[0]) else side * np.inf


def _covariance(fit: PersonFit) -> Array:
    """Of all unknowns (q, q), at most ten squared along what nothing tells."""
    information = fit.told.information + fit.prior.slopes(np.array(fit.theta))[1]
    return np.asarray(np.linalg.inv(information + _FLAT * np.eye(len(information))))


def _held(
    fit: PersonFit, theta: Array, along: Array, ridge: Array, value: float
) -> tuple[Array, float]:
    """The best of all else with along'theta at a value, and how far the likelihood fell."""
    off = value - float(along @ theta)
    # A straight line along the ridge may leave the gains that stabilise.
    starts = (theta + ridge * (off / float(along @ ridge)), theta + along * off)
    start = next((each for each in starts if np.isfinite(fit.prior.value(each))), starts[1])
    try:
        found, _, _ = climb(fit.prior, start, _BUDGET, _across(along))
    except ImpcError:  # no filter there: as far as an end may be
        return theta, np.inf
    # Of a level that is held nothing is expected.
    level = np.abs(along[fit.space.own :])
    freed = fit.prior.unlike(np.array(fit.theta)) - fit.prior.unlike(found.theta)
    return found.theta, fit.value - found.value + float(level @ freed)


def _across(along: Array) -> Array:
    """All that is orthogonal to a direction (q, q - 1); coordinates it leaves alone, as such."""
    mine = np.flatnonzero(along)
    turned = np.zeros((len(along), len(mine) - 1))
    turned[mine] = scipy.linalg.null_space(along[None, mine])
    return np.hstack([np.delete(np.eye(len(along)), mine, axis=1), turned])
