"""Upper bound of the cursor experiment: any fixed linear response to the target.

    c(t) - c(0) = sum_{j < J} s_j dr(t - j) + s_J (r(t - J) - r(0)),   dr(t) = r(t) - r(t - 1),

a step response free at every sample for 2 s and constant after, by ridge regression over trials. It
approximates the best held-out VAF of any linear controller that uses the target alone.
"""

from __future__ import annotations

import numpy as np

from impc.arrays import Array

__all__ = ["fit_step_response", "follow"]

_TAPS = 120
# Share of the largest squared singular value: neighbouring taps are almost collinear.
_RIDGE = 1e-6


def _regressors(target: Array) -> Array:
    """Regressors (samples, taps + 1): increments at each lag, and the target before them."""
    moved = target - target[0]
    steps = np.diff(moved, prepend=0.0)
    lagged = np.zeros((target.size, _TAPS + 1))
    for lag in range(_TAPS):
        lagged[lag:, lag] = steps[: target.size - lag]
    lagged[_TAPS:, _TAPS] = moved[: target.size - _TAPS]
    return lagged


def fit_step_response(target: Array, response: Array) -> Array:
    """Fit a step response (taps + 1) to target and cursor (trials, samples), px."""
    rows = np.vstack([_regressors(trial) for trial in target])
    moved = np.ravel(response - response[:, :1])
    gram = rows.T @ rows
    ridge = _RIDGE * float(np.linalg.norm(gram, 2)) * np.eye(_TAPS + 1)
    return np.asarray(np.linalg.solve(gram + ridge, rows.T @ moved))


def follow(target: Array, step_response: Array) -> Array:
    """Cursor (samples,) from one target (samples,), px relative to the start."""
    return np.asarray(_regressors(target) @ step_response)
