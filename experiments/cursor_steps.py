"""How a cursor moves beside what a controller says: it stands still, or steps by whole pixels.

A filter expects the next position with a mean m and a deviation s. A mouse reports whole pixels,
and in most samples the cursor stands. So of the position k, with the last one k', one may say

    p(k) = w [k = k'] + (1 - w) T((k - m) / (a s)),      w = 1 / (1 + exp(b + c |m - k'| / s)),

T Student's distribution of n degrees of freedom over the pixel. Its four numbers a, b, c and n say
nothing of control: what they are worth, in nats a sample, stands apart from what a model of the
person is worth (docs/cursor-tracking.md).
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
    """Positions, and what was expected of them; one number a sample (samples,).

    Attributes
    ----------
    position, last : Array
        Of the cursor now and a sample before, whole px.
    mean, deviation : Array
        Expected, px.
    """

    position: Array
    last: Array
    mean: Array
    deviation: Array


def fit_steps(seen: Expected) -> Array:
    """The likeliest numbers (4,) of the distribution of steps: log a, b, c, log n."""

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
