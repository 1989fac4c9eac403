"""What initial states, trial by trial, and other columns can explain of a residual.

Columns of initial states are zero outside of their trial. Side by side they would take the square
of the number of trials: 8 GB for 500 of 500 samples (docs/speed.md).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Array

if TYPE_CHECKING:
    from collections.abc import Sequence

# A column that the others explain to that of its length adds nothing but rounding.
_ROUNDING = 1e-10


@dataclass(frozen=True)
class TrialSpan:
    """An orthonormal basis."""

    own: tuple[Array, ...]  # Of each trial (rows, k), k at most n; zero in the rows of the others
    shared: Array  # Of the rest (r, c), orthogonal to those

    def without(self, columns: Array) -> Array:
        """What the basis does not explain of `columns` (r, k), of that shape."""
        left = _without(self.own, columns)
        return np.asarray(left - self.shared @ (self.shared.T @ left))

    def plus(self, columns: Array) -> TrialSpan:
        """With orthonormal `columns` (r, k) that are orthogonal to this basis."""
        return TrialSpan(self.own, np.hstack([self.shared, columns]))


def trial_span(own: Array, sizes: Sequence[int], shared: Array) -> TrialSpan:
    """Span of columns, each in its own scale, to 1e-10.

    `own` (r, n); `shared` (r, c).
    """
    parts = np.split(own, np.cumsum(sizes)[:-1])
    bases = tuple(_basis(_scaled(part)) for part in parts)
    return TrialSpan(bases, _basis(_without(bases, _scaled(shared))))


def _scaled(columns: Array) -> Array:
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
