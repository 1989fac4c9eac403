"""Offset and drift of a response, and rows of a perturbation that act earlier or later.

One step ahead, by least squares, with L lags and k/N from -1/2 to 1/2,

    y_k = c_0 + c_1 k/N + sum_i a_i y_(k-i) + sum_j b_j d_(k-j) + e_k.

Where the sensor's zero is the equilibrium, c = 0, wherever the perturbation moves the loop. The
first effects of a perturbation, C E, C A E and C A^2 E, are those of the plant alone; with later
ones free, the residual is least at the lag at which it acts.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from impc.arrays import Array, IntArray

_LAGS, _ROW_LAGS = 6, 8  # for offset and drift, and for rows
_KNOWN = 3  # effects that the plant alone decides: no controller reacts before
_REACH = 4  # rows by which lags are tried; the outermost are no answer
_SAMPLES = 5  # for each unknown, below which nothing is said
_CERTAIN = 2.5  # standard errors
_MARGIN = 25.0  # of 2 log likelihood, by which one lag beats all others
_SHARE = 0.04  # of the variance of the residual, which one lag saves compared with all others


def departures(response: Array, disturbances: Sequence[Array]) -> tuple[float, float]:
    """Offset and drift over the trial of a `response` (samples,), in its unit; 0 if not certain.

    The `disturbances` are (samples,) each.
    """
    count = len(response)
    now = np.arange(_LAGS, count)
    size = float(np.std(response))
    terms = [np.ones(len(now)), now / count - 0.5, *_past(response, now, 1, _LAGS)]
    for values in disturbances:
        terms += _past(values, now, 0, _LAGS) if np.ptp(values) > 0 else []
    if len(now) < _SAMPLES * len(terms) or size == 0:
        return 0.0, 0.0
    system = np.column_stack(terms)
    scale = np.abs(system).max(axis=0, initial=0.0)
    scale[scale == 0] = 1.0
    inverse = np.linalg.pinv(system / scale)
    found = inverse @ response[now] / scale
    left = response[now] - system @ found
    errors = np.sqrt(np.sum(inverse**2, axis=1) * (left @ left) / (len(now) - len(terms))) / scale
    gain = 1 - float(np.sum(found[2 : 2 + _LAGS]))
    certain = np.abs(found[:2]) > _CERTAIN * errors[:2] + 1e-9 * size * abs(gain)
    offset, drift = np.where(certain & (gain > 0), found[:2] / (gain if gain > 0 else 1.0), 0.0)
    return float(offset), float(drift)


def rows_later(outputs: Array, disturbance: Array, effects: Array) -> int:
    """By how many rows a `disturbance` (samples,) acts later than recorded; 0 where none is better.

    `outputs` is (samples, p); `effects` (3, p) those of one unit of it one to three samples later.
    """
    lags = range(-_REACH, _REACH + 1)
    now = np.arange(_ROW_LAGS + _REACH, len(outputs) - _REACH)
    if len(now) < 2 * _SAMPLES * _ROW_LAGS or np.ptp(disturbance) == 0:
        return 0
    cause = disturbance - disturbance.mean()
    likely, free = np.zeros(len(lags)), np.zeros(len(lags))
    for response, first in zip(outputs.T - outputs.mean(axis=0)[:, None], effects.T, strict=True):
        past = _past(response, now, 0, _ROW_LAGS)
        for place, lag in enumerate(lags):
            shifted = _past(cause, now - lag, 0, _ROW_LAGS)
            known = [values - _known(shifted, first, ago) for ago, values in enumerate(past)]
            likely[place] += _likelihood(known[0], [*known[1:], *shifted[_KNOWN + 1 :]])
            free[place] += _likelihood(past[0], [*past[1:], *shifted[1:]])
    best, second = np.argsort(likely)[[-1, -2]]
    margin = likely[best] - likely[second]
    # The plant's own effects must explain more than effects unlike them would add.
    clear = margin > max(_MARGIN, _SHARE * len(now), free[best] - likely[best])
    return lags[best] if clear and abs(lags[best]) < _REACH else 0


def _likelihood(values: Array, terms: Sequence[Array]) -> float:
    """Twice the logarithm of the likelihood of `values` as a combination of terms."""
    system = np.column_stack(terms)
    left = values - system @ np.linalg.lstsq(system, values, rcond=None)[0]
    return float(-len(values) * np.log(left @ left + 1e-12 * (values @ values)))


def _past(values: Array, now: IntArray, first: int, last: int) -> list[Array]:
    return [values[now - lag] for lag in range(first, last + 1)]


def _known(shifted: Sequence[Array], first: Array, ago: int) -> Array:
    """What of a sample `ago` samples ago is the effect of the disturbance by the plant alone."""
    parts = [first[i - ago - 1] * shifted[i] for i in range(ago + 1, _KNOWN + 1)]
    return np.sum(parts, axis=0) if parts else np.zeros(len(shifted[0]))
