"""Check a trial for sensor offset, drift and misaligned columns by linear regression.

One-step prediction by least squares, with L lags and k/N from -1/2 to 1/2,

    y_k = c_0 + c_1 k/N + sum_i a_i y_(k-i) + sum_j b_j d_(k-j) + e_k.

If the sensor's zero is the equilibrium, c = 0 for any perturbation. The first effects of a
perturbation, C E, C A E and C A^2 E, depend on the plant alone; with later effects free, the
residual is smallest at the lag at which the perturbation acts.

Order of cause and effect: perturbation and response are averaged to 20 samples per second. An
autoregression that whitens the perturbation is applied to both (Box and Jenkins, Time Series
Analysis, section 11.2). Their cross-correlation

    c(l) = sum_t d(t) y(t + l) / sqrt(sum d^2 sum y^2)

is then proportional to the impulse response, with standard deviation 1/sqrt(n) if the two are
independent. A lead is detected once it reaches half the rise time of the response (0.2 s for a
natural frequency of 0.5 Hz).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy

from impc.arrays import Array, IntArray

_PAST, _PAST_ROWS = 6, 8  # lags in the tests of offset and drift, and of shifted rows
_KNOWN = 3  # effects that the plant alone determines: no controller reacts earlier
_REACH = 4  # largest lag tried, in rows; a best lag at either end is not accepted
_SAMPLES = 5  # samples needed for each unknown
_CERTAIN = 2.5  # standard errors
_MARGIN = 25.0  # by which 2 log-likelihood of one lag must exceed all others
_SHARE = 0.04  # share of residual variance that one lag must save over all others


def departures(response: Array, disturbances: Sequence[Array]) -> tuple[float, float]:
    """Offset of `response` (samples,), and its drift over the trial; 0 if not significant."""
    count = len(response)
    now = np.arange(_PAST, count)
    size = float(np.std(response))
    terms = [np.ones(len(now)), now / count - 0.5, *_past(response, now, 1, _PAST)]
    for values in disturbances:
        terms += _past(values, now, 0, _PAST) if np.ptp(values) > 0 else []
    if len(now) < _SAMPLES * len(terms) or size == 0:
        return 0.0, 0.0
    system = np.column_stack(terms)
    scale = np.abs(system).max(axis=0, initial=0.0)
    scale[scale == 0] = 1.0
    inverse = np.linalg.pinv(system / scale)
    found = inverse @ response[now] / scale
    left = response[now] - system @ found
    errors = np.sqrt(np.sum(inverse**2, axis=1) * (left @ left) / (len(now) - len(terms))) / scale
    gain = 1 - float(np.sum(found[2 : 2 + _PAST]))
    certain = np.abs(found[:2]) > _CERTAIN * errors[:2] + 1e-9 * size * abs(gain)
    offset, drift = np.where(certain & (gain > 0), found[:2] / (gain if gain > 0 else 1.0), 0.0)
    return float(offset), float(drift)


def rows_later(outputs: Array, disturbance: Array, effects: Array) -> int:
    """Rows by which a `disturbance` (samples,) acts later than recorded; 0 if undecided.

    `outputs` (samples, p); `effects` (3, p): response to a unit disturbance 1 to 3 samples later.
    """
    lags = range(-_REACH, _REACH + 1)
    now = np.arange(_PAST_ROWS + _REACH, len(outputs) - _REACH)
    if len(now) < 2 * _SAMPLES * _PAST_ROWS or np.ptp(disturbance) == 0:
        return 0
    cause = disturbance - disturbance.mean()
    likely, free = np.zeros(len(lags)), np.zeros(len(lags))
    for response, first in zip(outputs.T - outputs.mean(axis=0)[:, None], effects.T, strict=True):
        past = _past(response, now, 0, _PAST_ROWS)
        for place, lag in enumerate(lags):
            shifted = _past(cause, now - lag, 0, _PAST_ROWS)
            known = [values - _known(shifted, first, ago) for ago, values in enumerate(past)]
            likely[place] += _likelihood(known[0], [*known[1:], *shifted[_KNOWN + 1 :]])
            free[place] += _likelihood(past[0], [*past[1:], *shifted[1:]])
    best, second = np.argsort(likely)[[-1, -2]]
    margin = likely[best] - likely[second]
    # The plant's known effects must explain more than unrestricted effects gain.
    clear = margin > max(_MARGIN, _SHARE * len(now), free[best] - likely[best])
    return lags[best] if clear and abs(lags[best]) < _REACH else 0


def _likelihood(values: Array, terms: Sequence[Array]) -> float:
    """Twice the log-likelihood of `values` regressed on `terms`."""
    system = np.column_stack(terms)
    left = values - system @ np.linalg.lstsq(system, values, rcond=None)[0]
    return float(-len(values) * np.log(left @ left + 1e-12 * (values @ values)))


def _past(values: Array, now: IntArray, first: int, last: int) -> list[Array]:
    return [values[now - lag] for lag in range(first, last + 1)]


def _known(shifted: Sequence[Array], first: Array, ago: int) -> Array:
    """Part of a sample, `ago` samples back, that the plant's known effects explain."""
    parts = [first[i - ago - 1] * shifted[i] for i in range(ago + 1, _KNOWN + 1)]
    return np.sum(parts, axis=0) if parts else np.zeros(len(shifted[0]))


_RATE = 20.0  # samples per second: sway has little power above 5 Hz
_ORDER = 1.0  # s, of the autoregression
_LONGEST = 3.0  # s, largest lag
# Correlations must exceed this many standard deviations: of 100 simulated pairs without a
# connection, at 30 s and at 120 s, none exceeded 4.
_DEVIATIONS = 4.0
_BEFORE = 0.5  # ratio of the largest correlation at leads to that at lags, from which to report
_REPEATS = 0.5  # autocorrelation from which a perturbation counts as periodic within the lags
_SHORTEST = 400  # samples below which a missing correlation is not reported


def misaligned(disturbance: Array, response: Array, dt: float) -> str:
    """Problem in the order of `disturbance` and `response` (end of a sentence), or "".

    Both are (samples,), sampled with the plant's step `dt` in s.
    """
    width = max(1, round(1 / (_RATE * dt)))
    step = width * dt
    cause, effect = (_averaged(values, width) for values in (disturbance, response))
    order = min(round(_ORDER / step), len(cause) // 10)
    if order < 2 or np.ptp(cause) == 0 or np.ptp(effect) == 0:
        return ""  # too short
    cause, effect = _whitened(cause, effect, order)
    lags = min(round(_LONGEST / step), len(cause) // 4)
    if np.abs(_correlation(cause, cause, 2 * lags)[2 * lags + 1 :]).max() > _REPEATS:
        return ""  # periodic: leads and lags cannot be distinguished
    strength = np.abs(_correlation(cause, effect, lags)) * np.sqrt(len(cause))
    before, behind = strength[:lags], strength[lags:]
    if strength.max() < _DEVIATIONS:
        if len(cause) < _SHORTEST:
            return ""
        return "is not correlated with the disturbance beyond chance; check column and trial"
    if before.max() < max(_DEVIATIONS, _BEFORE * behind.max()):
        return ""
    lead = (lags - int(np.argmax(before))) * step
    return (
        f"precedes the disturbance: their correlation is {before.max():.1f} standard "
        f"deviations at a lead of {lead:.2g} s and at most {behind.max():.1f} at any lag; shift "
        "one of the two, or name the right column"
    )


def _averaged(values: Array, width: int) -> Array:
    """Block means over `width` samples, centred."""
    count = len(values) // width
    means = values[: count * width].reshape(count, width).mean(axis=1)
    return np.asarray(means - means.mean())


def _whitened(cause: Array, effect: Array, order: int) -> tuple[Array, Array]:
    """Filter both with the autoregression that whitens the cause (Yule-Walker equations)."""
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
