"""Resample from the recorded clock to the plant's: outputs at instants, disturbances as means.

The plant holds its inputs over a sample. An output is its anti-aliased value at the instant k dt; a
disturbance is its mean over [k dt, (k + 1) dt), so that the plant receives the same impulse. With
x_j recorded at t_j = j T,

    y_k = sum_j h(k dt - t_j) x_j / sum_j h(k dt - t_j)
    d_k = (1 / dt) integral of x from k dt to (k + 1) dt, x linear between its samples,
          or constant between jumps on a lattice (below)

where h is a sinc with a Kaiser window, which is even and adds no phase (docs/howto/recordings.md).
Beyond its ends x is continued by point reflection, 2 x_0 - x_j.

A recorded pseudorandom push is constant between jumps, which lie at t_0 + n T. A sample says only
between which two instants a jump lies, and a mean of samples moves it by up to half of one: at
100 Hz the fitted gain then follows the export and not the person. All jumps together determine T
almost exactly, and t_0 within a part of a sample; within that part the latest is taken, since most
devices hold a value until the next sample.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple, TypeVar

import numpy as np
import scipy

from impc.arrays import Array, IntArray

# Stopband attenuation in dB; the largest passband ripple is 10^(-70/20) = 3e-4.
_ATTENUATION = 70.0
# End of the passband as a fraction of the lower Nyquist frequency, where the stopband begins.
_PASS = 0.8
# Rates are equal if the clocks differ by less than this part of a sample at the end.
_SAME = 0.05
_CHUNK = 2_000_000  # numbers in memory at a time (16 MB)
# Least number of jumps, and least distance between them, samples.
_JUMPS, _APART = 10, 3
# Tolerance of positions, samples.
_CLOSE = 1e-6
Key = TypeVar("Key")


class Steps(NamedTuple):
    """A signal that is constant between jumps; positions in samples of the recording."""

    edges: Array  # (k,)
    levels: Array  # (k + 1,), before the first edge and after each
    dwell: float  # T
    jitter: float  # By how much the samples move some jumps more than others

    def delayed(self, samples: float) -> Steps:
        """The same signal, later by so many samples."""
        return self._replace(edges=self.edges + samples)

    def means(self, borders: Array) -> Array:
        """Means (s,) between neighbouring `borders` (s + 1,)."""
        ends = np.concatenate([[min(borders[0], self.edges[0])], self.edges, [np.inf]])
        ends[-1] = max(borders[-1], self.edges[-1]) + 1.0
        areas = np.concatenate([[0.0], np.cumsum(self.levels * np.diff(ends))])
        return np.asarray(np.diff(np.interp(borders, ends, areas)) / np.diff(borders))


def same_rate(samples: int, period: float, dt: float) -> bool:
    """Whether clocks with steps `period` and `dt` in s agree over so many `samples`."""
    return samples * abs(period - dt) <= _SAME * dt


def shifted(series: Mapping[Key, Array], samples: Mapping[Key, float]) -> dict[Key, Array]:
    """Delay `series` (samples,) by so many `samples` each, and cut to their common range.

    Fractions of a sample are interpolated linearly.
    """
    first = first_common(samples)
    size = min(map(len, series.values()))
    last = size - 1 + min(0, *map(math.floor, samples.values()))
    places = np.arange(first, last + 1)
    return {
        name: values[first : last + 1]
        if samples[name] == 0
        else np.interp(places - samples[name], np.arange(len(values)), values)
        for name, values in series.items()
    }


def first_common(samples: Mapping[Key, float]) -> int:
    """First sample at which all series, delayed by so many `samples`, are recorded."""
    return max(0, *map(math.ceil, samples.values()))


def resampled_samples(samples: int, period: float, dt: float) -> int:
    """Number of instants k dt within a recording; `period` and `dt` in s."""
    return int(np.floor((samples - 1) * period / dt + 1e-6)) + 1


def instants(values: Array, period: float, dt: float) -> Array:
    """Anti-aliased `values` (samples,), recorded every `period` s, at the instants k dt."""
    if same_rate(len(values), period, dt):
        return values
    half = int(np.ceil(_half_width(period, dt) / period))
    padded = _continued(values, half + 1)
    positions = np.arange(resampled_samples(len(values), period, dt)) * dt / period
    whole = np.floor(positions + 1e-9).astype(np.int64)
    # Equal phases share their weights; a rational ratio has few phases.
    phases, which = np.unique(np.round(positions - whole, 9), return_inverse=True)
    offsets = np.arange(-half, half + 2)
    result = np.empty(len(positions))
    for part in np.array_split(
        np.argsort(which, kind="stable"), 1 + len(positions) * len(offsets) // _CHUNK
    ):
        used, local = np.unique(which[part], return_inverse=True)
        weights = _kernel(np.asarray((phases[used, None] - offsets) * period), period, dt)
        weights /= weights.sum(axis=1, keepdims=True)  # keeps constants exactly
        taken = padded[whole[part, None] + offsets + half + 1]
        result[part] = np.einsum("ij,ij->i", weights[local], taken)
    return result


def held_means(values: Array, period: float, dt: float, steps: Steps | None = None) -> Array:
    """Means of `values` (samples,), recorded every `period` s, over [k dt, (k + 1) dt).

    The signal is linear between its samples, or has the `steps`. The last interval extends beyond
    the recording, where the last value is held.
    """
    same = same_rate(len(values), period, dt)
    if steps is not None:
        count = len(values) if same else resampled_samples(len(values), period, dt)
        return steps.means(np.asarray(np.arange(count + 1) * (1.0 if same else dt / period)))
    if same:
        return values
    extra = int(np.ceil(dt / period)) + 1
    held = np.concatenate([values, np.full(extra, values[-1])])
    areas = np.concatenate([[0.0], np.cumsum((held[1:] + held[:-1]) / 2)])
    borders = np.arange(resampled_samples(len(values), period, dt) + 1) * dt / period
    whole = np.minimum(np.floor(borders).astype(np.int64), len(held) - 2)
    part = borders - whole
    slope = held[whole + 1] - held[whole]
    integral = areas[whole] + held[whole] * part + slope * part**2 / 2
    return np.asarray(np.diff(integral) * period / dt)


def held_values(values: Array, period: float, dt: float) -> Array:
    """Last of the `values` (samples,), recorded every `period` s, at or before k dt."""
    if same_rate(len(values), period, dt):
        return values
    instant = np.arange(resampled_samples(len(values), period, dt)) * dt / period
    return np.asarray(values[np.floor(instant + 1e-6).astype(np.int64)])


def _half_width(period: float, dt: float) -> float:
    """Half the filter length in s (Kaiser's formula for attenuation and transition)."""
    nyquist = 0.5 / max(period, dt)
    transition = 2 * np.pi * (1 - _PASS) * nyquist  # rad/s
    return float((_ATTENUATION - 7.95) / (2.285 * transition) / 2)


def _kernel(time: Array, period: float, dt: float) -> Array:
    """h at these times: sinc with Kaiser window."""
    cut = (1 + _PASS) / 2 * 0.5 / max(period, dt)  # Hz, the middle of the transition
    inside = 1 - (time / _half_width(period, dt)) ** 2
    beta = scipy.signal.kaiser_beta(_ATTENUATION)
    window = np.where(inside > 0, np.i0(beta * np.sqrt(np.maximum(inside, 0))), 0.0)
    return np.asarray(np.sinc(2 * cut * time) * window)


def _continued(values: Array, width: int) -> Array:
    """Point reflection at both ends; a recording shorter than the filter is held beyond it."""
    inner = min(width, len(values) - 1)
    left = 2 * values[0] - values[inner:0:-1]
    right = 2 * values[-1] - values[-2 : -inner - 2 : -1]
    reflected = np.concatenate([left, values, right])
    return np.pad(reflected, width - inner, mode="edge")


def steps_of(values: Array) -> Steps | None:
    """Jumps of `values` (samples,) if they lie on a lattice; otherwise None."""
    after = np.flatnonzero(np.diff(values)) + 1  # first sample of each new level
    if len(after) < _JUMPS or len(after) * _APART > len(values):
        return None
    counts = _counted(after - after[0])
    if counts is None:
        return None
    # after - 1 <= t_0 + n T <= after, as late as possible
    lattice = np.column_stack([np.ones(len(after)), counts])
    late = scipy.optimize.linprog(
        -lattice.sum(axis=0),
        A_ub=np.vstack([lattice, -lattice]),
        b_ub=np.concatenate([after, 1.0 - after]),
        bounds=(None, None),
    )
    if late.x is None or late.status != 0 or late.x[1] < _APART:
        return None
    first, dwell = float(late.x[0]), float(late.x[1])
    edges, levels = np.array(first + dwell * counts), np.append(values[0], values[after])
    return Steps(edges, levels, dwell, float(np.ptp(after - edges)))


def _counted(gaps: IntArray) -> IntArray | None:
    """Number of dwells from the first jump to each, at `gaps` samples; None if there is none."""
    nearest = int(np.min(np.diff(gaps)))
    low, high, found = float(nearest - 1), float(nearest + 1), [0]
    for gap in gaps[1:]:
        if low <= 0:
            return None
        least, most = math.ceil((gap - 1) / high - _CLOSE), math.floor((gap + 1) / low + _CLOSE)
        count = max(least, 1)
        if least > most:
            return None
        if most > count:  # not yet known: the nearest one, which later jumps confirm or refute
            count = round(gap / ((low + high) / 2))
        low, high = max(low, (gap - 1) / count), min(high, (gap + 1) / count)
        if low > high + _CLOSE:
            return None
        found.append(count)
    return np.array(found)
