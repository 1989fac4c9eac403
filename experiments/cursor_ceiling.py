"""How far any fixed linear response to the target could go: the ceiling of the cursor experiment.

    c(t) - c(0) = sum_{j < J} s_j dr(t - j) + s_J (r(t - J) - r(0)),   dr(t) = r(t) - r(t - 1),

a step response free at every sample for 2 s and constant after, by ridge least squares over trials.
What it misses on a trial left out, no linear controller of the target alone can reach.
"""

from __future__ import annotations

import numpy as np

from impc.arrays import Array

__all__ = ["fit_step_response", "follow"]

_TAPS = 120
# Share of the largest singular value squared: 120 neighbouring taps are all but alike.
_RIDGE = 1e-6


def _regressors(target: Array) -> Array:
    """(samples, taps + 1): increments at each lag, and all that lies further back."""
    moved = target - target[0]
    steps = np.diff(moved, prepend=0.0)
    lagged = np.zeros((target.size, _TAPS + 1))
    for lag in range(_TAPS):
        lagged[lag:, lag] = steps[: target.size - lag]
    lagged[_TAPS:, _TAPS] = moved[: target.size - _TAPS]
    return lagged


def fit_step_response(target: Array, response: Array) -> Array:
    """Step response (taps + 1) of trials (trials, samples) of target and cursor, both in px."""
    rows = np.vstack([_regressors(trial) for trial in target])
    moved = np.ravel(response - response[:, :1])
    gram = rows.T @ rows
    ridge = _RIDGE * float(np.linalg.norm(gram, 2)) * np.eye(_TAPS + 1)
    return np.asarray(np.linalg.solve(gram + ridge, rows.T @ moved))


def follow(target: Array, step_response: Array) -> Array:
    """Cursor (samples,) from one target (samples,), px from where it starts."""
    return np.asarray(_regressors(target) @ step_response)
