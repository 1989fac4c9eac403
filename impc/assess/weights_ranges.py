"""What the recordings leave open of the weights of one gain, in a form that a page can print.

Every number is over all weights with the gain whose condition number, in the units of the plant, is
at most a multiple of the least (`weights_set`; docs/equivalent-weights.md, section 5).

Among them is how far each eigenvalue of Q can go. The largest is a convex function of Q and the
least a concave one, so that two ends are programs and proved:

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

from impc.arrays import Array
from impc.assess.bounded_weights import weights_set
from impc.assess.extreme_weights import (
    entry_ranges,
    extreme_eigenvalue,
    linear_maxima,
    linear_ranges,
)
from impc.assess.intent_draws import prices_over_gains, set_of_gain, with_confidence
from impc.assess.intent_statements import order_statements, sense_statements, widest_dominant_angle
from impc.errors import SolverError, WeightsError
from impc.inverse.solution_set import gain_fibre

if TYPE_CHECKING:
    from collections.abc import Sequence

    from impc.arrays import Array
    from impc.assess.bounded_weights import WeightsSet
    from impc.assess.intent_draws import DrawnSet, PriceRange
    from impc.assess.intent_statements import Statement
    from impc.model.plant import Plant
    from impc.model.riccati import LqrSolution
    from impc.model.weights import Weights

#: Multiple of the least condition number up to which weights are taken as equally good.
RATIO = 10.0
# States whose entries and statements are computed: the recorded ones, then those that cost most at
# their typical size.
_NAMED = 4


@dataclass(frozen=True)
class EntryRange:
    """Range of Q_ij over the set, i and j by name."""

    first: str  # Names of the states i and j
    second: str
    low: float  # At trace R = m
    high: float


@dataclass(frozen=True)
class WeightsSummary:
    """The set of weights of a gain."""

    dimension: int  # Free directions of the weights that have the gain, scale not counted
    least_condition: float  # Condition numbers: the least, and the largest in the set
    limit: float
    entries: tuple[EntryRange, ...]  # Of the states that are recorded or cost most
    eigenvalues: tuple[EigenvalueRange, ...]  # Of Q, ascending
    statements: tuple[Statement, ...]  # Order and sense of these states
    # Widest angle found between the dominant direction of D Q D in the least conditioned member and
    # in another, degrees; D the typical sizes of the states
    widest_angle: float
    drawn: int  # Number of gains drawn beside the fitted one, for all that follows
    prices: tuple[PriceRange, ...]  # Of the named states; empty without draws
    # Widest angle, over the drawn gains, of the dominant direction of the least conditioned member
    # from that of the fitted gain, degrees; NaN without draws
    angle_of_gain: float


def summarise_weights(
    plant: Plant,
    gain: Array,
    metrics: Array,
    sizes: Array,
    ratio: float = RATIO,
    draws: tuple[LqrSolution, ...] = (),
) -> WeightsSummary:
    """Run the programs over the set of weights of a gain.

    `gain` (m, n); `metrics` (k, m, m); `sizes` (n,).
    """
    found = weights_set(gain_fibre(plant, gain, metrics), ratio)
    named = _shown(plant, found.least.weights, sizes)
    names = tuple(plant.states[index] for index in named)
    ranges = entry_ranges(found, named)
    members = [
        weights.block
        for item in ranges.values()
        for weights in (item.least.weights, item.most.weights)
    ]
    angle, widest = widest_dominant_angle(found, sizes)
    statements = order_statements(found, sizes, names) + sense_statements(
        found, sizes, names, ranges
    )
    sets = tuple(
        set_of_gain(plant, item, metrics, ratio, sizes, names, statements) for item in draws
    )
    prices = {
        plant.states[k]: (sizes[k] ** 2 * ranges[k, k].low, sizes[k] ** 2 * ranges[k, k].high)
        for k in named
    }
    return WeightsSummary(
        found.fibre.dimension - 1,
        found.least.condition,
        found.limit,
        tuple(
            EntryRange(plant.states[i], plant.states[j], item.low, item.high)
            for (i, j), item in ranges.items()
        ),
        eigenvalue_ranges(found, [*members, _at_trace(widest, plant.m)]),
        with_confidence(statements, sets) if sets else statements,
        angle,
        len(sets),
        prices_over_gains(prices, sets) if sets else (),
        _angle_of_gain(found, sets, sizes),
    )


def weights_summary_or_reason(
    plant: Plant,
    gain: Array,
    metrics: Array,
    sizes: Array,
    draws: tuple[LqrSolution, ...] = (),
) -> tuple[WeightsSummary | None, str]:
    """The summary, or None and why there is none.

    `gain` (m, n); `metrics` (k, m, m); `sizes` (n,).
    """
    try:
        return summarise_weights(plant, gain, metrics, sizes, draws=draws), ""
    except (WeightsError, SolverError) as error:
        return None, str(error)


def _angle_of_gain(found: WeightsSet, sets: tuple[DrawnSet, ...], sizes: Array) -> float:
    if not sets:
        return float("nan")
    own, widest = _dominant(found.least.weights, sizes), 0.0
    for one in sets:
        # Without a least conditioned member the direction is anywhere.
        cosine = 0.0 if one.least is None else abs(float(own @ _dominant(one.least, sizes)))
        widest = max(widest, float(np.degrees(np.arccos(min(1.0, cosine)))))
    return widest


def _dominant(weights: Weights, sizes: Array) -> Array:
    D = np.diag(np.asarray(sizes))
    return np.asarray(np.linalg.eigh(D @ weights.Q @ D)[1][:, -1])


def _shown(plant: Plant, weights: Weights, sizes: Array) -> list[int]:
    """States that are recorded, then those that cost most."""
    prices = np.diag(weights.Q) * np.asarray(sizes) ** 2
    recorded = [index for index, name in enumerate(plant.states) if name in plant.outputs]
    others = [int(index) for index in np.argsort(-prices, kind="stable")]
    return sorted(list(dict.fromkeys([*recorded, *others]))[:_NAMED])


def _at_trace(weights: Weights, m: int) -> Array:
    return np.asarray(weights.block * (m / np.trace(weights.R)))


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
