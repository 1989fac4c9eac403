"""Compiled code: sums of columns over the few lags that noise is correlated at.

The lags are those of Andrews (Econometrica 59, 1991, 817), `long_run_covariance` has the rest.
"""

from __future__ import annotations

import numpy as np

from impc.arrays import Buffer
from impc.jit import njit

__all__ = ["coloured_nearby"]


@njit(cache=True, nogil=True)
def coloured_nearby(columns: Buffer, gammas: Buffer) -> Buffer:
    """sum_s Gamma_{t-s} columns_s, Gamma_{-l} = Gamma_l'.

    `columns` (samples, p, k); `gammas` (lags, p, p); returns (samples, p, k).
    """
    samples, outputs, count = columns.shape
    result = np.zeros((samples, outputs, count))
    for lag in range(min(len(gammas), samples)):
        for t in range(lag, samples):
            for i in range(outputs):
                for j in range(outputs):
                    ahead, behind = gammas[lag, i, j], gammas[lag, j, i] if lag else 0.0
                    for c in range(count):
                        result[t, i, c] += ahead * columns[t - lag, j, c]
                        result[t - lag, i, c] += behind * columns[t, j, c]
    return result
