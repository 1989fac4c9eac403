"""Profiles of a person's levels of noise: intervals that hold where a level is all but none.

The logarithm of a level that is weakly told is not normal: its likelihood falls on one side and
stays on the other. The interval of 95 % is where the largest likelihood with the level held there,

    2 (max log L - max_held log L) <= 1.96^2

and open to zero where that never falls: the level is then at most its upper end
(docs/noisy-people.md).

Where one level slid to none another took its part, and its own deviation is that of a person
without the first. So all levels have a profile then, and with one of them held the slid ones are
looked for from where they began, too.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Array, BoolArray, frozen
from impc.errors import ImpcError
from impc.inverse.likelihood_search import climb

if TYPE_CHECKING:
    from impc.assess.person_covariance import PersonCovariance
    from impc.inverse.likelihood_fit import PersonFit

__all__ = ["level_interval", "level_intervals"]

# Root of half of 1.96^2, of nats, and how near to it an end of an interval is found.
_FALLEN, _CLOSE = 1.385903, 0.04
_NORMAL = 1.959964
# A step is no longer than this, of the logarithm of a level.
_LONGEST = 2.0
# Searches for one end, and likelihoods with derivatives in each.
_TRIES, _BUDGET = 12, 15
# Keeps a covariance finite: of a coordinate that nothing tells the deviation is ten.
_FLAT = 1e-2
# A level whose logarithm has a larger deviation is given a profile.
_WEAK = 0.25
# A level whose logarithm has a deviation as large is none: the likelihood does not answer to it.
_NONE = 3.0


def level_intervals(fit: PersonFit, covariance: PersonCovariance, *, weak: float = _WEAK) -> Array:
    """Intervals of 95 % of all levels (l, 2), in their units.

    Parameters
    ----------
    fit : PersonFit
    covariance : PersonCovariance
        Gives the intervals of levels that are well told.
    weak : float
        A level whose logarithm has a larger deviation has its interval by profile; all have where
        one slid to none.
    """
    values = np.exp(fit.theta[fit.space.own :])
    slid = bool(np.any(_slid(fit, _covariance(fit))))
    return frozen(
        [
            level_interval(fit, k)
            if slid or covariance.levels[k] > weak
            else covariance.level_interval(k, float(value))
            for k, value in enumerate(values)
        ]
    )


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
    low, high = (float(np.exp(_end(fit, fit.space.own + index, side))) for side in (-1, 1))
    return low, high


def _end(fit: PersonFit, held: int, side: int) -> float:
    """Logarithm of the level at which the profile has fallen by enough on one side.

    The root of what has fallen is straight where the likelihood is that of a normal number, so the
    next guess lies on a line.
    """
    theta, border = np.array(fit.theta), float(fit.box[(side + 1) // 2][held])
    covariance = _covariance(fit)
    slid = _slid(fit, covariance)
    slid[held] = False
    tangent = covariance[:, held] / covariance[held, held]
    step = min(_NORMAL * float(np.sqrt(covariance[held, held])), _LONGEST)
    inside, outside = (float(theta[held]), 0.0), (np.nan, np.inf)
    value = inside[0] + side * step
    for _ in range(_TRIES):
        value = border if side * (value - border) >= 0 else value
        theta, fallen = _held(fit, theta, tangent, slid, held, value)
        root = float(np.sqrt(max(fallen, 0.0)))
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


def _slid(fit: PersonFit, covariance: Array) -> BoolArray:
    """Which unknowns are levels that slid to none (q,)."""
    deviations = np.sqrt(np.diag(covariance))
    return np.asarray((deviations > _NONE) & (np.arange(len(deviations)) >= fit.space.own))


def _covariance(fit: PersonFit) -> Array:
    """Of all unknowns (q, q), at most ten squared along what nothing tells."""
    information = fit.told.information + fit.prior.slopes(np.array(fit.theta))[1]
    return np.asarray(np.linalg.inv(information + _FLAT * np.eye(len(information))))


def _held(
    fit: PersonFit, theta: Array, tangent: Array, slid: BoolArray, held: int, value: float
) -> tuple[Array, float]:
    """The best of all else with one unknown held at a value, and how far the likelihood fell."""
    low, high = (np.array(side) for side in fit.box)
    low[held] = high[held] = value
    straight = np.clip(theta + tangent * (value - theta[held]), low, high)
    # A straight line may leave the gains that stabilise.
    starts = [straight if np.isfinite(fit.prior.value(straight)) else np.clip(theta, low, high)]
    if np.any(slid):
        starts.append(np.clip(np.where(slid, fit.space.start, starts[0]), low, high))
    top, best = fit.log_likelihood + fit.prior.value(fit.theta), (theta, np.inf)
    for start in starts:
        try:
            found, told, _, _ = climb(fit.prior, start, (low, high), _BUDGET)
        except ImpcError:  # no filter there: as far as an end may be
            continue
        fallen = top - told.value - fit.prior.value(found)
        best = (found, fallen) if fallen < best[1] else best
    return best
