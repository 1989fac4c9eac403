"""The sensitivity recursion as the dissertation writes it, (A.3): Kronecker products; a check."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from impc.arrays import Array
    from impc.studies.selection.linear import Discrete

__all__ = ["kronecker_sensitivity"]


def kronecker_sensitivity(found: Discrete, given: Array) -> Array:
    """(A.3) with Kronecker products: derivative of the outputs (samples, p, k); slow.

    `given` (samples, d).
    """
    k, n, d = len(found.dA), found.A.shape[0], found.B.shape[1]
    dA, dB, dC = (np.hstack(list(item)) for item in (found.dA, found.dB, found.dC))
    x, X = np.zeros((n, 1)), np.zeros((n, k))
    eye = np.eye(k)
    rows = np.empty((len(given), found.C.shape[0], k))
    for sample, r in enumerate(np.asarray(given).reshape(len(given), d, 1)):
        rows[sample] = dC @ np.kron(eye, x) + found.C @ X
        X = dA @ np.kron(eye, x) + found.A @ X + dB @ np.kron(eye, r)
        x = found.A @ x + found.B @ r
    return rows
