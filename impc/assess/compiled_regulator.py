"""Compiled code: the gain of a regulator by doubling, thousands of times over."""

from __future__ import annotations

import numpy as np

from impc.arrays import Buffer
from impc.jit import njit

__all__ = ["doubled_gain"]

_MOST = 60


@njit(cache=True, nogil=True)
def doubled_gain(A: Buffer, B: Buffer, Q: Buffer, R: Buffer, enough: float) -> tuple[bool, Buffer]:
    """K (m, n) by doubling (Chu et al. 2004), and whether that converged.

    A singular matrix on the way is numpy's error.

    `A` (n, n); `B` (n, m); `Q` (n, n); `R` (m, m).
    """
    n = len(A)
    driven, unit, first = np.ascontiguousarray(B.T), np.eye(n), A
    G, P = B @ np.linalg.solve(R, driven), Q.copy()
    for _ in range(_MOST):
        turned = unit + G @ P
        if not (np.all(np.isfinite(turned)) and np.all(np.isfinite(A)) and np.all(np.isfinite(G))):
            break
        right = np.linalg.solve(turned, np.hstack((A, G)))
        ahead, beside = right[:, :n].copy(), right[:, n:].copy()
        back = np.ascontiguousarray(A.T)
        more = back @ P @ ahead
        A, G, P = A @ ahead, G + A @ beside @ back, P + more
        size = np.max(np.abs(P))
        if not np.isfinite(size):
            break
        if np.max(np.abs(more)) <= enough * size:
            seen = driven @ P
            return True, np.linalg.solve(R + seen @ B, seen @ first)
    return False, np.zeros((B.shape[1], n))
