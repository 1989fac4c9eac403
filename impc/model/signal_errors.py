"""Errors of recorded signals: offset, drift, scale, time shift, and a clock of another rate.

With time in samples, a recorded output y_rec follows the true one y by

    y_rec(t) = (1 + scale) y(t - shift - clock t) + offset + drift t,

and the disturbance d that acts on the plant follows the recorded one d_rec by

    d(t) = (1 + scale) d_rec(t - shift - clock t) + offset + drift t.

A positive shift is a delay: a recorded output follows the movement, a disturbance acts later than
recorded. The model is moved, never a recorded output. Outputs are interpolated linearly between
samples; a disturbance is held over its sample, and a moved one is the mean over the new sample. A
further kind is a row of `KINDS`, an entry of `search_unit` and a term of `distorted`.
"""

from __future__ import annotations

import numpy as np

from impc.arrays import Array, IntArray

#: By name, in the order of the rows of `Recording.errors`: words for pages; unit, after that of the
#: signal if it begins with a space or is empty; its size; power of the sampling interval in it.
KINDS = {
    "offset": ("an offset", "", 1, 0),
    "drift": ("a drift", " /s", 1, -1),
    "scale": ("an error of scale", "%", 100, 0),
    "shift": ("a time shift", "ms", 1000, 1),
    "clock": ("a clock error", "%", 100, 0),
}
OFFSET, DRIFT, SCALE, SHIFT, CLOCK = range(len(KINDS))
# Scale of a relative error in a search.
_SCALE = 0.1


def search_unit(kind: int, size: float, samples: int) -> float:
    """Scale of an error in a search, for a signal of typical `size`."""
    return (size, size / samples, _SCALE, 1.0, 1 / samples)[kind]


def distorted(signal: Array, errors: Array, *, held: bool) -> Array:
    """Signal (samples, c) with `errors` (kinds, c)."""
    moved, time = signal, np.arange(len(signal))[:, None] + held / 2
    if np.any(errors[[SHIFT, CLOCK]]):
        moved = _moved(signal, errors, held=held)
    return np.asarray((1 + errors[SCALE]) * moved + errors[OFFSET] + errors[DRIFT] * time)


def distortion(signal: Array, errors: Array, *, held: bool) -> Array:
    """Derivatives (samples, c, kinds) of a signal (samples, c) with `errors` (kinds, c)."""
    moved = _moved(signal, errors, held=held)
    by_shift, by_clock = _slopes(signal, moved, errors, held=held)
    time = np.broadcast_to(np.arange(len(signal))[:, None] + held / 2, moved.shape)
    gain = 1 + errors[SCALE]
    slopes = np.ones_like(moved), time, moved, gain * by_shift, gain * by_clock
    return np.stack(slopes, axis=2)


def undistorted(signal: Array, errors: Array) -> Array:
    """Outputs (samples, c) without their `errors` (kinds, c); NaN where not recorded."""
    time = np.arange(len(signal))
    found = (signal - errors[OFFSET] - errors[DRIFT] * time[:, None]) / (1 + errors[SCALE])
    for column, error in enumerate(errors.T):
        if error[SHIFT] or error[CLOCK]:
            place = (time + error[SHIFT]) / (1 - error[CLOCK])
            values = found[:, column].copy()
            found[:, column] = np.interp(place, time, values, left=np.nan, right=np.nan)
    return np.asarray(found)


def resampled(table: Array, errors: Array) -> Array:
    """Derivatives (samples, c, k) of outputs, overwritten by those of outputs with `errors`."""
    for column, error in enumerate(errors.T):
        if error[SHIFT] or error[CLOCK]:
            place = _places(len(table), error)[:-1]
            before = _before(place, len(table))
            share, values = (place - before)[:, None], table[:, column]
            table[:, column] = (1 - share) * values[before] + share * values[before + 1]
        if error[SCALE]:
            table[:, column] *= 1 + error[SCALE]
    return table


def _places(samples: int, error: Array) -> Array:
    """Places (samples + 1,) in the signal at which it is read."""
    return np.asarray(np.arange(samples + 1) * (1 - error[CLOCK]) - error[SHIFT])


def _before(place: Array, samples: int) -> IntArray:
    """Sample before each place; at both ends the first and last intervals continue."""
    return np.asarray(np.clip(np.floor(place).astype(np.int64), 0, samples - 2))


def _read(values: Array, places: Array) -> Array:
    """Values (k,) at `places`, interpolated; at both ends the first and last lines continue."""
    last = len(values) - 1
    found = np.interp(places, np.arange(len(values)), values)
    found += np.minimum(places, 0.0) * (values[1] - values[0])
    return np.asarray(found + np.maximum(places - last, 0.0) * (values[last] - values[last - 1]))


def _moved(signal: Array, errors: Array, *, held: bool) -> Array:
    """Signal (samples, c) read at other times."""
    moved = np.empty_like(signal)
    for column, error in enumerate(errors.T):
        values, places = signal[:, column], _places(len(signal), error)
        if held:  # the integral of a held signal is piecewise linear
            integral = _read(np.concatenate([[0.0], np.cumsum(values)]), places)
            moved[:, column] = np.diff(integral) / np.diff(places)
        else:
            moved[:, column] = _read(values, places[:-1])
    return moved


def _slopes(signal: Array, moved: Array, errors: Array, *, held: bool) -> tuple[Array, Array]:
    """Derivatives (samples, c) of a `moved` signal by shift and clock."""
    by_shift, by_clock = np.empty_like(signal), np.empty_like(signal)
    count = np.arange(len(signal))
    for column, error in enumerate(errors.T):
        values, places = signal[:, column], _places(len(signal), error)
        if held:
            at = values[_before(places, len(values) + 1)]
            v, w, width = at[:-1], at[1:], np.diff(places)
            by_shift[:, column] = (v - w) / width
            by_clock[:, column] = (moved[:, column] - (count + 1) * w + count * v) / width
        else:
            before = _before(places[:-1], len(values))
            step = values[before + 1] - values[before]
            by_shift[:, column] = -step
            by_clock[:, column] = -count * step
    return by_shift, by_clock
