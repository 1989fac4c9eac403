"""Columns of a derivative by trials: triangular factors, and projections on them.

Trial-specific columns are zero outside their trial, so that time and memory of a factorisation grow
linearly with the number of trials.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg

from impc.arrays import Array
from impc.inverse.problem import Problem

# Rows of one block: a few thousand fit into the cache of the processor.
_BLOCK = 4096


def triangular_rows(columns: list[Array]) -> Array:
    """Triangular factor R (w, w) of `columns`, arrays (r, k) side by side, by row blocks.

    R has the norms and inner products of the columns, and fewer rows if r < w. Blocks of a few
    thousand rows fit into the cache of the processor.
    """
    width = sum(part.shape[1] for part in columns)
    triangle = np.zeros((0, width))
    for first in range(0, len(columns[0]), _BLOCK):
        block = np.hstack([part[first : first + _BLOCK] for part in columns])
        # mode "r" would also copy all rows below the triangle.
        _, upper = scipy.linalg.qr(np.vstack([triangle, block]), mode="raw", check_finite=False)
        triangle = np.asarray(upper, dtype=np.float64)
    return triangle


# Columns that the others explain up to this share of their norm count as dependent.
_ROUNDING = 1e-10


@dataclass(frozen=True)
class TrialSpan:
    """Orthonormal basis of trial-specific and shared columns."""

    own: tuple[Array, ...]  # Per trial (rows, k), k <= n; zero outside the trial
    shared: Array  # Remaining columns (r, c), orthogonal to `own`

    def without(self, columns: Array) -> Array:
        """Residual of `columns` (r, k) after projection on the basis."""
        left = _without(self.own, columns)
        return np.asarray(left - self.shared @ (self.shared.T @ left))

    def recorded(self, problem: Problem) -> TrialSpan:
        """Restriction to the rows of recorded values."""
        pairs = zip(self.own, problem.trial_sizes, strict=False)
        own = tuple(basis[:size] for basis, size in pairs)
        return TrialSpan(own, self.shared[problem.recorded_rows])

    def plus(self, columns: Array) -> TrialSpan:
        """Basis extended by orthonormal `columns` (r, k) orthogonal to it."""
        return TrialSpan(self.own, np.hstack([self.shared, columns]))


def trial_span(own: Array, sizes: Sequence[int], shared: Array) -> TrialSpan:
    """Basis of the scaled columns `own` (r, n) by trial and `shared` (r, c), to 1e-10."""
    parts = np.split(own, np.cumsum(sizes)[:-1])
    bases = tuple(_basis(_of_length_one(part)) for part in parts)
    return TrialSpan(bases, _basis(_without(bases, _of_length_one(shared))))


def _of_length_one(columns: Array) -> Array:
    size = np.linalg.norm(columns, axis=0)
    return np.asarray(columns[:, size > 0] / size[size > 0])


def _basis(columns: Array) -> Array:
    if columns.size == 0:
        return np.zeros((len(columns), 0))
    left, values, _ = np.linalg.svd(columns, full_matrices=False)
    return np.asarray(left[:, values > _ROUNDING])


def _without(bases: Sequence[Array], columns: Array) -> Array:
    left, row = np.array(columns), 0
    for basis in bases:
        mine = slice(row, row + len(basis))
        row = mine.stop
        left[mine] -= basis @ (basis.T @ left[mine])
    return left
