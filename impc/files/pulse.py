"""A single pulse in a column that is not used: possibly the start of the trial."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from impc.arrays import Array

# Noise beside the pulse relative to its height, and longest pulse relative to the recording.
_FLAT, _LONGEST = 0.1, 0.5


def pulse(values: Array) -> tuple[int, float] | None:
    """First sample and height of the only pulse of a column; None if it is no such column."""
    if len(values) < 3 or not np.all(np.isfinite(values)):  # before, in, after
        return None
    away = values - np.median(values)
    height = float(away[np.argmax(np.abs(away))])
    high = away / height > 0.5 if height else np.zeros(len(values), dtype=bool)
    edges = np.flatnonzero(np.diff(high.astype(np.int8)))
    low = np.abs(away[~high])
    # The samples next to an edge may be between both levels.
    flat = np.count_nonzero(low > _FLAT * abs(height)) <= len(edges)
    single = len(edges) == 2 and not high[0] and np.mean(high) < _LONGEST
    return (int(edges[0]) + 1, height) if single and flat else None
