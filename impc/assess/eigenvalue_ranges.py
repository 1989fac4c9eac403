"""How far each eigenvalue of Q can go over all weights with a gain (`weights_set`).

The largest eigenvalue is a convex function of Q and the least a concave one, so that two ends are
programs and proved:

    min over members of lambda_max(Q),        max over members of lambda_min(Q).

The others are not convex. They are searched: from the ends along the centre's eigenvectors, the
derivative v_i v_i' of an eigenvalue leads to the extreme member in that direction, as long as that
gains. A member with that eigenvalue exists; one that goes farther may. Source:
docs/equivalent-weights.md, section 2.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from impc.assess.extreme_weights import extreme_eigenvalue, linear_maxima, linear_ranges

if TYPE_CHECKING:
    from collections.abc import Sequence

    from impc.arrays import Array
    from impc.assess.bounded_weights import WeightsSet

__all__ = ["EigenvalueRange", "eigenvalue_ranges"]

_STEPS = 3
# Distance to the dual bound, relative, at which an end counts as proved: 1e-7 on the seat.
_PROOF = 1e-4
_SHARES = np.linspace(0.0, 1.0, 11)


@dataclass(frozen=True)
class EigenvalueRange:
    """Least and largest value of one eigenvalue that a member is known to have."""

    low: float  # At the scale of the set, trace R = m
    high: float
    low_proved: bool  # Whether no member goes beyond; otherwise one may
    high_proved: bool


def eigenvalue_ranges(
    found: WeightsSet, members: Sequence[Array] = ()
) -> tuple[EigenvalueRange, ...]:
    """Range of every eigenvalue of Q, ascending as `numpy.linalg.eigvalsh` gives them.

    `members` (n + m, n + m).
    """
    n, m = found.fibre.plant.n, found.fibre.plant.m
    centre = found.least.weights.block
    known = [centre * (m / np.trace(centre[n:, n:])), *members]
    least_top = extreme_eigenvalue(found, largest=True)
    most_bottom = extreme_eigenvalue(found, largest=False)
    known += [least_top.weights.block, most_bottom.weights.block]
    if not members:
        vectors = np.linalg.eigh(centre[:n, :n])[1].T
        for ends in linear_ranges(found, np.array([_on_states(found, one) for one in vectors])):
            known += [ends.least.weights.block, ends.most.weights.block]
    values = np.array([np.linalg.eigvalsh(X[:n, :n]) for X in known])
    ranges = []
    for index in range(n):
        low = _search(found, known[int(np.argmin(values[:, index]))], index, -1.0)
        high = _search(found, known[int(np.argmax(values[:, index]))], index, 1.0)
        ranges.append(
            EigenvalueRange(
                least_top.value if index == n - 1 else low,
                most_bottom.value if index == 0 else high,
                index == n - 1 and least_top.value - least_top.bound <= _PROOF * least_top.value,
                index == 0 and most_bottom.bound - most_bottom.value <= _PROOF * most_bottom.value,
            )
        )
    return tuple(ranges)


def _search(found: WeightsSet, start: Array, index: int, sign: float) -> float:
    """The eigenvalue farthest up (sign 1) or down (-1) that segments to extreme members reach."""
    n, X = found.fibre.plant.n, start
    for _ in range(_STEPS):
        _, vectors = np.linalg.eigh(X[:n, :n])
        direction = sign * _on_states(found, vectors[:, index])
        end = linear_maxima(found, direction[None])[0].weights.block
        along = np.linalg.eigvalsh(X[:n, :n] + _SHARES[:, None, None] * (end - X)[:n, :n])[:, index]
        best = int(np.argmax(sign * along))
        if sign * (along[best] - along[0]) <= 1e-6 * abs(along[0]):
            break
        X = X + _SHARES[best] * (end - X)
    return float(np.linalg.eigvalsh(X[:n, :n])[index])


def _on_states(found: WeightsSet, vector: Array) -> Array:
    """The direction whose product with blkdiag(Q, R) is vector' Q vector."""
    n = found.fibre.plant.n
    direction = np.zeros_like(found.first)
    direction[:n, :n] = np.outer(vector, vector)
    return np.asarray(direction)
