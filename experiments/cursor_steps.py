"""Distribution of cursor positions that rest or move by whole pixels, given a prediction.

A filter predicts the next position with mean m and standard deviation s. A mouse reports whole
pixels, and in most samples the cursor rests. With last position k', position k has probability

    p(k) = w [k = k'] + (1 - w) T((k - m) / (a s)),      w = 1 / (1 + exp(b + c |m - k'| / s)),

where T is Student's distribution with n degrees of freedom, integrated over the pixel. The four
numbers a, b, c and n do not describe control, so their log-likelihood is reported separately
(experiments/cursor_tracking.md).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.optimize
import scipy.special
import scipy.stats

if TYPE_CHECKING:
    from impc.arrays import Array

__all__ = ["Expected", "fit_steps", "step_nats"]

_LEAST = 1e-300


@dataclass(frozen=True)
class Expected:
    """Recorded and predicted positions, one number a sample (samples,).

    Attributes
    ----------
    position, last : Array
        Position now and one sample before, whole px.
    mean, deviation : Array
        Predicted mean and standard deviation, px.
    """

    position: Array
    last: Array
    mean: Array
    deviation: Array


def fit_steps(seen: Expected) -> Array:
    """Maximum-likelihood numbers (4,) of the distribution: log a, b, c, log n."""

    def objective(theta: Array) -> float:
        return -step_nats(theta, seen)

    found = scipy.optimize.minimize(
        objective, np.array([0.0, 0.0, 1.0, 1.0]), method="Nelder-Mead",
        options={"xatol": 1e-4, "fatol": 1e-7, "maxiter": 2000},
    )  # fmt: skip
    return np.asarray(found.x)


def step_nats(theta: Array, seen: Expected) -> float:
    """Mean log-probability of the positions, nats a sample, for the numbers theta (4,)."""
    wide = np.exp(theta[0]) * seen.deviation
    student = scipy.stats.t(float(np.exp(np.clip(theta[3], -2.0, 6.0))))
    ends = [(seen.position + side - seen.mean) / wide for side in (-0.5, 0.5)]
    moved = student.cdf(ends[1]) - student.cdf(ends[0])
    away = np.abs(seen.mean - seen.last) / seen.deviation
    still = scipy.special.expit(-(theta[1] + theta[2] * away))
    every = still * (seen.position == seen.last) + (1 - still) * moved
    return float(np.mean(np.log(np.maximum(every, _LEAST))))
