"""Signals that switch between levels on a lattice: edges, and exact means over a sample.

A recorded pseudorandom push is constant between jumps, which lie at t_0 + n T. A sample says only
between which two instants a jump lies, and a mean of samples moves it by up to half of one: at
100 Hz the fitted gain then follows the export and not the person. All jumps together determine T
almost exactly, and t_0 within a part of a sample; within that part the latest is taken, since most
devices hold a value until the next sample.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import scipy

if TYPE_CHECKING:
    from impc.arrays import Array, IntArray

# Least number of jumps, and least distance between them, samples.
_JUMPS, _APART = 10, 3
# Tolerance of positions, samples.
_CLOSE = 1e-6


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
