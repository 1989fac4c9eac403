"""Profiles of a person's levels of noise: intervals that hold where a level is all but none.

The logarithm of a level that is weakly told is not normal: its likelihood falls on one side and
stays on the other. The interval of 95 % is where the largest likelihood with the level held there,

    2 (max log L - max_held log L) <= 1.96^2

and open to zero where that never falls: the level is then at most its upper end
(docs/noisy-people.md).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from impc.inverse.likelihood_search import climb

if TYPE_CHECKING:
    from impc.arrays import Array
    from impc.inverse.likelihood_fit import PersonFit

__all__ = ["level_interval"]

# Half of 1.96^2, nats, and how near to it an end of an interval is: a fiftieth of a deviation.
_FALL, _CLOSE = 1.920729, 0.04
# A first step is no longer than this, of the logarithm of a level.
_LONGEST = 2.0
_TRIES, _BUDGET = 12, 15


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

    Raises
    ------
    ImpcError
        When there is no likelihood near the fit.
    """
    low, high = (float(np.exp(_end(fit, fit.space.own + index, side))) for side in (-1, 1))
    return low, high


def _end(fit: PersonFit, held: int, side: int) -> float:
    """Where the profile has fallen by enough on one side, as a logarithm."""
    theta = np.array(fit.theta)
    top = fit.log_likelihood + fit.prior.value(theta)
    covariance = np.linalg.inv(
        fit.told.information + fit.prior.slopes(theta)[1] + 1e-2 * np.eye(len(theta))
    )
    border = float(fit.box[(side + 1) // 2][held])
    at, root = float(theta[held]), 0.0
    step = min(1.96 * float(np.sqrt(covariance[held, held])), _LONGEST)
    tangent = covariance[:, held] / covariance[held, held]
    inside, outside = (at, 0.0), (np.nan, np.inf)
    wanted = float(np.sqrt(_FALL))
    for _ in range(_TRIES):
        value = at + side * step
        if side * (value - border) >= 0:
            value = border
        moved = np.clip(theta + tangent * (value - theta[held]), *fit.box)
        if np.isfinite(fit.prior.value(moved)):  # a straight line may leave what stabilises
            theta = moved
        theta[held] = value
        theta, fallen = _held(fit, theta, held, top)
        root = float(np.sqrt(max(fallen, 0.0)))
        if abs(root - wanted) < _CLOSE:
            return value
        if root < wanted:
            if value == border:
                return side * np.inf
            inside = (value, root)
        else:
            outside = (value, root)
        # The root of what has fallen is straight where the likelihood is that of a normal number.
        if np.isfinite(outside[0]):
            share = (wanted - inside[1]) / (outside[1] - inside[1])
            aim = inside[0] + min(max(share, 0.1), 0.9) * (outside[0] - inside[0])
        else:
            aim = inside[0] + side * min(_LONGEST, step * max(wanted / max(root, 0.3) - 1, 0.5))
        step = side * (aim - at)
    return outside[0] if np.isfinite(outside[0]) else side * np.inf


def _held(fit: PersonFit, theta: Array, held: int, top: float) -> tuple[Array, float]:
    """The best of all else with one unknown held, and how far the likelihood fell."""
    low, high = (np.array(side) for side in fit.box)
    low[held] = high[held] = theta[held]
    theta, told, _, _ = climb(fit.prior, theta, (low, high), _BUDGET)
    return theta, top - told.value - fit.prior.value(theta)
