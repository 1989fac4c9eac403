"""Summary of the set of equivalent weights, for reports.

All numbers are over the weights with the gain whose condition number, in the units of the plant, is
at most a multiple of the least (`weights_set`; docs/why/equivalent_weights.md).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from impc.assess.bounded_weights import entry_ranges, weights_set
from impc.assess.intent_draws import set_of_gain, weights_over_gains, with_confidence
from impc.assess.intent_statements import (
    angle_between,
    dominant_direction,
    order_statements,
    sense_statements,
    widest_dominant_angle,
)
from impc.errors import SolverError, WeightsError
from impc.inverse.solution_set import gain_fibre

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from impc.arrays import Array
    from impc.assess.bounded_weights import WeightsSet
    from impc.assess.intent_draws import DrawnSet, WeightRange
    from impc.assess.intent_statements import Statement
    from impc.model.plant import Plant
    from impc.model.riccati import LqrSolution
    from impc.model.weights import Weights

#: Largest condition number in the set, as a multiple of the least.
RATIO = 10.0
# Number of states shown: recorded ones, then those that cost most at their typical size.
_NAMED = 4


@dataclass(frozen=True)
class EntryRange:
    """Range of Q_ij over the set."""

    first: str  # Names of the states i and j
    second: str
    low: float  # At trace R = m
    high: float


@dataclass(frozen=True)
class WeightsSummary:
    """Set of equivalent weights of a gain."""

    dimension: int  # Free directions of the weights without scale
    least_condition: float  # Least condition number, then the largest in the set
    limit: float
    entries: tuple[EntryRange, ...]  # Entries of the states that are recorded or cost most
    statements: tuple[Statement, ...]  # Order and sense of these states
    # Widest angle found between the dominant directions of D Q D of the least-condition member and
    # another, degrees; D = typical sizes of the states
    widest_angle: float
    drawn: int  # Number of drawn gains
    cost_weights: tuple[WeightRange, ...]  # Costs of the named states; empty without draws
    # Widest angle over the drawn gains between the dominant direction of their least-condition
    # member and that of the fitted gain, degrees; NaN without draws
    angle_of_gain: float


def summarise_weights(
    plant: Plant,
    gain: Array,
    metrics: Array,
    sizes: Array,
    draws: tuple[LqrSolution, ...] = (),
    each: Callable[..., Iterable[DrawnSet]] = map,
) -> WeightsSummary:
    """Summarise the set of weights of a gain and of drawn gains, which `each` maps."""
    found = weights_set(gain_fibre(plant, gain, metrics), RATIO)
    named = _shown(plant, found.least.weights, sizes)
    names = tuple(plant.states[index] for index in named)
    ranges = entry_ranges(found, named)
    angle, _ = widest_dominant_angle(found, sizes)
    statements = order_statements(found, sizes, names) + sense_statements(
        found, sizes, names, ranges
    )

    def set_of(drawn: LqrSolution) -> DrawnSet:
        return set_of_gain(plant, drawn, metrics, RATIO, sizes, names, statements)

    sets = tuple(each(set_of, draws))
    cost_weights = {
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
        with_confidence(statements, sets) if sets else statements,
        angle,
        len(sets),
        weights_over_gains(cost_weights, sets) if sets else (),
        _angle_of_gain(found, sets, sizes),
    )


def weights_summary_or_reason(
    plant: Plant,
    gain: Array,
    metrics: Array,
    sizes: Array,
    draws: tuple[LqrSolution, ...] = (),
    each: Callable[..., Iterable[DrawnSet]] = map,
) -> tuple[WeightsSummary | None, str]:
    """Summary and "", or None and the reason."""
    try:
        return summarise_weights(plant, gain, metrics, sizes, draws, each), ""
    except (WeightsError, SolverError) as error:
        return None, str(error)


def _angle_of_gain(found: WeightsSet, sets: tuple[DrawnSet, ...], sizes: Array) -> float:
    if not sets:
        return float("nan")
    D = np.diag(np.asarray(sizes))
    own = dominant_direction(D @ found.least.weights.Q @ D)
    # Without a member the direction is unknown: 90 degrees.
    return max(
        90.0 if one.least is None else angle_between(own, dominant_direction(D @ one.least.Q @ D))
        for one in sets
    )


def _shown(plant: Plant, weights: Weights, sizes: Array) -> list[int]:
    """Recorded states and their rates, then those with the largest costs."""
    cost_weights = np.diag(weights.Q) * np.asarray(sizes) ** 2
    known = {*plant.outputs, *(f"{name}_rate" for name in plant.outputs)}
    recorded = [index for index, name in enumerate(plant.states) if name in known]
    others = [int(index) for index in np.argsort(-cost_weights, kind="stable")]
    return sorted(list(dict.fromkeys([*recorded, *others]))[:_NAMED])
