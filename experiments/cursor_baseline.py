"""Baseline of the cursor experiment: delayed feedback of error and velocity.

    c''(t) = -k_1 e(t - tau) - k_2 c'(t - tau),   tau a whole number of samples,

simulated from the target alone. The two gains are fitted by least squares for every delay, and the
delay is selected, on the trials that are not predicted.
"""

from __future__ import annotations

import numpy as np
import scipy.optimize
import scipy.signal

from experiments.cursor_data import RATE
from impc.arrays import Array

__all__ = ["delayed_feedback", "fit_delayed_feedback"]

_DELAYS = range(1, 31)
_START = np.log([15.0, 6.0])


def delayed_feedback(target: Array, gains: Array, delay: int) -> Array:
    """Cursor (trials, samples) from the target (trials, samples), both relative to their start."""
    k1, k2 = gains
    dt = 1 / RATE
    # (1 - z)^2 c + k2 dt z^(d+1) (1 - z) c + k1 dt^2 z^(d+1) c = k1 dt^2 z^(d+1) target
    denominator = np.zeros(delay + 3)
    denominator[:3] = [1.0, -2.0, 1.0]
    denominator[delay + 1 : delay + 3] += k2 * dt * np.array([1.0, -1.0])
    denominator[delay + 1] += k1 * dt**2
    numerator = np.zeros(delay + 2)
    numerator[delay + 1] = k1 * dt**2
    moved = target - target[:, :1]
    return np.asarray(scipy.signal.lfilter(numerator, denominator, moved, axis=1))


def fit_delayed_feedback(target: Array, response: Array) -> tuple[Array, int]:
    """Least-squares gains and delay over all given trials."""
    moved = response - response[:, :1]
    best: tuple[float, Array, int] | None = None
    start = _START
    for delay in _DELAYS:

        def residual(logarithms: Array, delay: int = delay) -> Array:
            simulated = delayed_feedback(target, np.exp(logarithms), delay)
            return np.ravel(np.clip(simulated - moved, -1e4, 1e4))

        found = scipy.optimize.least_squares(residual, start, max_nfev=40)
        start = found.x
        if best is None or found.cost < best[0]:
            best = (float(found.cost), np.exp(found.x), delay)
    assert best is not None
    return best[1], best[2]
