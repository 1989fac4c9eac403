"""Holm's correction of p-values (1979)."""

from __future__ import annotations

import numpy as np

from impc.arrays import Array


def holm(p: Array) -> Array:
    """Holm-corrected p-values (k,) of `p` (k,); NaN stay NaN.

    statsmodels' version runs a full garbage collection at every call.
    """
    order = np.argsort(p)[: np.count_nonzero(np.isfinite(p))]
    corrected = np.full(len(p), np.nan)
    grown = np.maximum.accumulate(p[order] * np.arange(len(order), 0, -1))
    corrected[order] = np.minimum(grown, 1.0)
    return corrected
