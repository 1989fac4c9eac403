"""The slope of what a search for a person makes largest, as far as scores do not have it.

Levels lose with all else fitted to the same noise (`person_prior`); of that the likelihoods on the
way tell, and differences where a search ends.

With bounds the likelihood jumps: where a later stage of a plan meets one the slope of the command
changes, and with it all that the filter expects. A derivative follows the active sets and sees no
jump. But jumps have a direction. On the seat they add up to one nat and more for each deviation of
the gain, so that where the gradient is none is a deviation and more beside the highest place. What
is not seen along the gain is what values a deviation to either side say beside the gradient
(docs/noisy-people.md).
"""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING

import numpy as np

from impc.control.simulation import Status
from impc.errors import ImpcError

if TYPE_CHECKING:
    from impc.arrays import Array
    from impc.inverse.person_prior import Place, Prior

# Step of the differences along a level, of its logarithm; square of one that teaches half.
_DIFFERENCE, _DAMPING = 0.1, 0.1
# A direction of the gain that is hardly told has no longer step, of a coordinate.
_LONGEST = 0.25


def unseen_slope(prior: Prior, here: Place) -> Array:
    """What scores do not have (q,), nats, by differences about a place; none without a prior."""
    slope = np.zeros(len(here.theta))
    if prior.used:
        slope[prior.space.own :] = _lost(prior, here)
        if any(np.any(trial.status != Status.FREE) for trial in here.told.trials):
            slope[: prior.space.gain] = jumps(prior, here)
    return slope


def learned_slope(prior: Prior, slope: Array, here: Place, there: Place) -> Array:
    """What scores do not have (q,) after a step, by Broyden's update along the levels, damped.

    Short steps tell little. Of the gain a step tells nothing: a jump more or less is as much.

    `slope` (q,).
    """
    own, slope = prior.space.own, slope.copy()
    moved = (there.theta - here.theta)[own:]
    missed = here.lost - there.lost - float(slope[own:] @ moved)
    slope[own:] += missed * moved / (float(moved @ moved) + _DAMPING)
    # Twice the noise are half the deviations, and no level is more than all of it.
    slope[own:] = np.clip(slope[own:], 0.0, float(own))
    return slope


def _lost(prior: Prior, here: Place) -> Array:
    """What levels lose, along each (levels,).

    All else follows a level along its ridge, for `Place.lost` changes along that too. Where neither
    way has a likelihood the slope is taken for zero.
    """
    own, slopes = prior.space.own, np.zeros(len(prior.scales))
    information = here.told.information + prior.slopes(here.theta)[1]
    ridges = -np.linalg.solve(information[:own, :own], information[:own, own:])
    ways = _DIFFERENCE * np.hstack([ridges.T, np.eye(len(slopes))])
    for (index, way), sign in itertools.product(enumerate(ways), (1, -1)):
        there = prior.tried(here.theta + sign * way) if slopes[index] == 0.0 else None
        if there is not None:
            slopes[index] = sign * (here.lost - there.lost) / _DIFFERENCE
    return slopes


def jumps(prior: Prior, here: Place) -> Array:
    """What jumps add up to along the coordinates of the gain (g,), initial states on their ridge.

    From one deviation below to one above along each direction that is told apart from the others:
    from a quarter to one and a half they say the same, and a longer step is less rough. Where there
    is no likelihood a step away the slope is taken for zero.
    """
    own, gain = prior.space.own, prior.space.gain
    gradient, curvature = prior.parabola(here, np.zeros(len(here.theta)))
    covariance = np.linalg.inv(curvature[:own, :own])
    variances, directions = np.linalg.eigh(covariance[:gain, :gain])
    step, slope = np.zeros(len(here.theta)), np.zeros(gain)
    for variance, direction in zip(variances, directions.T, strict=True):
        length = min(np.sqrt(variance), _LONGEST)
        step[:own] = length / variance * covariance[:, :gain] @ direction
        try:
            low, high = (
                prior.space.value(there) + prior.value(there)
                for there in (here.theta - step, here.theta + step)
            )
        except ImpcError:
            continue
        if np.isfinite(low) and np.isfinite(high):
            slope += ((high - low) / 2 - float(gradient @ step)) / length * direction
    return slope
