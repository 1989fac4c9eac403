"""Whether the response follows the perturbation: no effect before its cause.

Both are averaged to 20 samples per second. An autoregression turns the perturbation into white
noise and is applied to the response as well (Box and Jenkins, Time Series Analysis, section 11.2);
their cross-correlation

    c(l) = sum_t d(t) y(t + l) / sqrt(sum d^2 sum y^2)

is then proportional to the impulse response between them, and of standard deviation 1/sqrt(n) where
there is none. Of 100 simulated pairs without a connection, at 30 s and at 120 s, none exceeded 4
deviations. A lead is seen once it reaches half the rise time of the response: 0.2 s for a natural
frequency of 0.5 Hz.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import scipy.linalg

if TYPE_CHECKING:
    from impc.arrays import Array

_RATE = 20.0  # samples per second: sway has little above 5 Hz, and differences raise noise
_ORDER = 1.0  # s, of the autoregression
_LONGEST = 3.0  # s, of the lags that are looked at
_DEVIATIONS = 4.0  # of chance that a correlation must exceed
_BEFORE = 0.5  # largest before the cause over largest behind it, from which it is a finding
_REPEATS = 0.5  # autocorrelation from which the perturbation repeats itself within the lags
_SHORTEST = 400  # samples below which a missing connection says nothing


def misaligned(disturbance: Array, response: Array, dt: float) -> str:
    """What is wrong with the order of cause and effect, as the end of a sentence; or nothing.

    The `disturbance` (samples,) and the `response` (samples,) are on the plant's clock of `dt` s.
    """
    width = max(1, round(1 / (_RATE * dt)))
    step = width * dt
    cause, effect = (_averaged(values, width) for values in (disturbance, response))
    order = min(round(_ORDER / step), len(cause) // 10)
    if order < 2 or np.ptp(cause) == 0 or np.ptp(effect) == 0:
        return ""  # too short to tell
    cause, effect = _whitened(cause, effect, order)
    lags = min(round(_LONGEST / step), len(cause) // 4)
    if np.abs(_correlation(cause, cause, 2 * lags)[2 * lags + 1 :]).max() > _REPEATS:
        return ""  # a sinusoid: a lead cannot be told from a lag
    strength = np.abs(_correlation(cause, effect, lags)) * np.sqrt(len(cause))
    before, behind = strength[:lags], strength[lags:]
    if strength.max() < _DEVIATIONS:
        if len(cause) < _SHORTEST:
            return ""
        return "has nothing in common with it beyond chance: a wrong column or trial?"
    if before.max() < max(_DEVIATIONS, _BEFORE * behind.max()):
        return ""
    lead = (lags - int(np.argmax(before))) * step
    return (
        f"comes before it: their correlation is {before.max():.1f} deviations from chance at a "
        f"lead of {lead:.2g} s and at most {behind.max():.1f} behind it; shift one of the two, or "
        "name the right column"
    )


def _averaged(values: Array, width: int) -> Array:
    """Means over `width` samples, without their mean."""
    count = len(values) // width
    means = values[: count * width].reshape(count, width).mean(axis=1)
    return np.asarray(means - means.mean())


def _whitened(cause: Array, effect: Array, order: int) -> tuple[Array, Array]:
    """Both through the filter that makes the cause white: Yule and Walker's equations."""
    size = len(cause)
    covariance = np.array([cause[: size - lag] @ cause[lag:] for lag in range(order + 1)])
    covariance[0] *= 1 + 1e-6  # a perturbation of few frequencies is predicted exactly
    past = scipy.linalg.solve_toeplitz(covariance[:order], covariance[1:])
    whitening = np.concatenate([[1.0], -past])
    white = [np.convolve(values, whitening)[order:size] for values in (cause, effect)]
    return np.asarray(white[0] - white[0].mean()), np.asarray(white[1] - white[1].mean())


def _correlation(cause: Array, effect: Array, lags: int) -> Array:
    """c(l) for l from -lags to lags."""
    full = np.correlate(effect, cause, "full") / np.sqrt((cause @ cause) * (effect @ effect))
    middle = len(cause) - 1
    return np.asarray(full[middle - lags : middle + lags + 1])
