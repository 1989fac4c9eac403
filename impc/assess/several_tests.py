"""Several tests at once: the correction of their p-values by Holm (1979)."""

from __future__ import annotations

import numpy as np

from impc.arrays import Array


def holm(p: Array) -> Array:
    """Return the p-values of several tests, each as if it were one of all that could be made.

    statsmodels has the same, and collects the garbage of the whole process at every call.

    `p` (k,); returns (k,).
    """
    order = np.argsort(p)[: np.count_nonzero(np.isfinite(p))]
    corrected = np.full(len(p), np.nan)
    grown = np.maximum.accumulate(p[order] * np.arange(len(order), 0, -1))
    corrected[order] = np.minimum(grown, 1.0)
    return corrected
