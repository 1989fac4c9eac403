"""Coefficient of multiple correlation of transfer functions, within and between visits.

Kadaba et al. (1989) for curves that are complex: |.| is the complex modulus, so that real and
imaginary parts are two coordinates of each frequency. Y_ijt at visit i of M, trial j of N,
frequency t of T:

    within   1 - [sum |Y_ijt - mean_j|^2 / (M T (N - 1))]
                 / [sum |Y_ijt - mean_jt|^2 / (M (N T - 1))]
    between  1 - [sum |Y_ijt - mean_ij|^2 / (T (M N - 1))]
                 / [sum |Y_ijt - mean_ijt|^2 / (M N T - 1)]

(the mean over the named indices) and the square root. Where the difference is negative there is no
root: NaN, which says that curves differ more than frequencies do.
"""

from __future__ import annotations

import numpy as np

from impc.errors import DataError
from impc.studies.reliability.transfer import ComplexArray

__all__ = ["cmc_between", "cmc_within"]


def cmc_within(curves: ComplexArray) -> float:
    """Within visits; curves (visits, trials, frequencies)."""
    M, N, T = _shape(curves, trials=2)
    own = np.sum(np.abs(curves - curves.mean(axis=1, keepdims=True)) ** 2)
    all_of_visit = np.sum(np.abs(curves - curves.mean(axis=(1, 2), keepdims=True)) ** 2)
    return _root(own / (M * T * (N - 1)), all_of_visit / (M * (N * T - 1)))


def cmc_between(curves: ComplexArray) -> float:
    """Between visits; curves (visits, trials, frequencies)."""
    M, N, T = _shape(curves, visits=2)
    own = np.sum(np.abs(curves - curves.mean(axis=(0, 1), keepdims=True)) ** 2)
    everything = np.sum(np.abs(curves - curves.mean()) ** 2)
    return _root(own / (T * (M * N - 1)), everything / (M * N * T - 1))


def _shape(curves: ComplexArray, visits: int = 1, trials: int = 1) -> tuple[int, int, int]:
    if curves.ndim != 3:
        raise DataError(
            "curves", f"have {curves.ndim} dimensions", "give visits, trials, frequencies"
        )
    M, N, T = curves.shape
    for count, least, name in ((M, visits, "visits"), (N, trials, "trials"), (T, 2, "frequencies")):
        if count < least:
            raise DataError("curves", f"are of {count} {name}", f"a CMC needs {least} or more")
    return M, N, T


def _root(own: float, total: float) -> float:
    if total == 0:
        return float("nan")
    share = 1 - own / total
    return float(np.sqrt(share)) if share >= 0 else float("nan")
