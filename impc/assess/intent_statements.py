"""Statements about the control intent that hold for all equivalent weights.

All weights with the fitted gain and a condition number up to a multiple of the least explain the
recordings equally well (`weights_set`). A statement is useful if it holds for every one of them.

    cost       d_i^2 Q_ii: cost of a typical excursion d_i of state i
    order      cost of i above cost of j: the sign of a linear function, decided exactly
    sense      Q_ij above or below zero: equal or opposite signs of two states cost more
    direction  dominant eigenvector of D Q D; the widest angle to that of the least-condition
               member is searched, not proved: farther members may exist

The direction is also computed for weights chosen by three rules; the angle between them shows how
much it depends on the rule. With Q = T diag(q) T' (3.23) the state cost is sum q_i z_i^2, z = T'x,
and its dominant part is the last, q_n (v'x)^2 (3.26).

See docs/why/equivalent_weights.md and docs/why/conclusions.md.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Array, Frozen, frozen
from impc.assess.bounded_weights import linear_maxima, linear_ranges, weights_set
from impc.errors import SolverError, WeightsError
from impc.inverse.equivalent_weights import analytic_centre, least_condition_weights
from impc.inverse.solution_set import gain_fibre
from impc.model.weights import Weights, condition_number, normalised

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from impc.assess.bounded_weights import Range, WeightsSet
    from impc.model.plant import Plant

_FRANK_WOLFE = 12
# A range that ends this close to zero, relative to its width, leaves the sign undecided.
_TOUCHES = 1e-6
# 38 of 39 draws, see `weights_ranges`.
_AGREE = 38 / 39 - 1e-9


@dataclass(frozen=True)
class Statement:
    """A statement about two states."""

    first: str  # Names of the states
    second: str
    holds: bool | None  # True or False if all members agree; otherwise None
    # Range of the linear function whose sign decides, over the cost of `first` in the member of
    # least condition number
    low: float
    high: float
    kind: str  # "order" or "sense"
    # Share of the drawn gains for which it holds too (`weights_ranges`); None if not checked
    confidence: float | None = None

    @property
    def made(self) -> bool:
        """Whether the statement is supported at 95 %: at least 38 of 39 drawn gains agree."""
        return self.confidence is not None and self.confidence >= _AGREE


def statement_function(plant: Plant, sizes: Array, kind: str, first: str, second: str) -> Array:
    """Linear function of blkdiag(Q, R) that is positive if a statement holds (n + m, n + m)."""
    i, j = plant.states.index(first), plant.states.index(second)
    function = np.zeros((plant.n + plant.m, plant.n + plant.m))
    if kind == "order":
        function[i, i], function[j, j] = sizes[i] ** 2, -(sizes[j] ** 2)
    else:
        function[i, j] = function[j, i] = sizes[i] * sizes[j] / 2
    return function


def pair_statements(
    found: WeightsSet,
    sizes: Array,
    states: tuple[str, ...],
    ranges: Mapping[tuple[int, int], Range],
) -> tuple[Statement, ...]:
    """Order and sense of every pair of the given states; `ranges` are those of Q_ij."""
    plant, pairs = found.fibre.plant, list(itertools.combinations(states, 2))
    if not pairs:
        return ()

    def statement(kind: str, pair: tuple[str, str], ends: Range, scale: float) -> Statement:
        low, high = scale * ends.least.bound, scale * ends.most.bound  # no member goes beyond
        touches = _TOUCHES * max(abs(low), abs(high))
        holds = True if low > touches else False if high < -touches else None
        index = plant.states.index(pair[0])
        unit = float(found.least.weights.Q[index, index] * sizes[index] ** 2)
        return Statement(*pair, holds, low / unit, high / unit, kind)

    functions = np.array([statement_function(plant, sizes, "order", *pair) for pair in pairs])
    order = zip(pairs, linear_ranges(found, functions), strict=True)
    places = [tuple(plant.states.index(name) for name in pair) for pair in pairs]
    sense = [(ranges[max(i, j), min(i, j)], float(sizes[i] * sizes[j])) for i, j in places]
    return (
        *(statement("order", pair, ends, 1.0) for pair, ends in order),
        *(statement("sense", pair, *own) for pair, own in zip(pairs, sense, strict=True)),
    )


def widest_dominant_angle(found: WeightsSet, sizes: Array) -> tuple[float, Weights]:
    """Widest angle found between dominant directions of D Q D, degrees, and its weights.

    D = diag(sizes), the typical excursions (n,) in the units of the states. The direction of the
    member of least condition number is compared with others: from it and from the members at the
    ends of the ranges of the largest costs, Frank-Wolfe steps increase the angle (the derivative of
    an eigenvector is linear in Q, so that each step is one program).
    """
    n, least = found.fibre.plant.n, found.least.weights
    if n == 1:  # a single state
        return 0.0, least
    D = np.diag(np.asarray(sizes, dtype=np.float64))
    centre = _dominant(D @ least.Q @ D)

    def angle(X: Array) -> float:
        return _angle(centre, _dominant(D @ X[:n, :n] @ D))

    def climbed(X: Array) -> Array:
        """Frank-Wolfe: along segments to the members that are extreme in the gradient."""
        for _ in range(_FRANK_WOLFE):
            gradient = np.zeros_like(X)
            gradient[:n, :n] = D @ _turning(D @ X[:n, :n] @ D, centre) @ D
            end = linear_maxima(found, gradient[None])[0].weights.block
            segment = [X + share * (end - X) for share in np.linspace(0.0, 1.0, 21)]
            best = int(np.argmax([angle(Y) for Y in segment]))
            if best == 0:
                break
            X = segment[best]
        return X

    largest = np.argsort(-np.diag(D @ least.Q @ D))[:2]
    directions = np.zeros((len(largest), *found.first.shape))
    directions[np.arange(len(largest)), largest, largest] = 1.0
    starts = [least.block]
    for ends in linear_ranges(found, directions):
        starts += [ends.least.weights.block, ends.most.weights.block]
    best = max(map(climbed, starts), key=angle)
    return angle(best), Weights(best[:n, :n], best[n:, n:])


def _turning(Q: Array, centre: Array) -> Array:
    """Gradient of 1 - (v'centre)^2 by Q, v the dominant eigenvector."""
    values, vectors = np.linalg.eigh(Q)
    v, others = vectors[:, -1], vectors[:, :-1]
    gaps = np.maximum(values[-1] - values[:-1], 1e-9 * values[-1])
    weight = others @ ((others.T @ centre) / gaps)
    gradient = -2 * float(v @ centre) * np.outer(weight, v)
    if np.linalg.norm(gradient) < 1e-9 / values[-1]:  # at the centre: any direction
        gradient = np.outer(others[:, -1], v) / values[-1]
    return np.asarray((gradient + gradient.T) / 2)


def _dominant(Q: Array) -> Array:
    """Eigenvector (n,) of the largest eigenvalue of a symmetric matrix (n, n)."""
    return np.asarray(np.linalg.eigh((Q + Q.T) / 2)[1][:, -1])


def _angle(one: Array, other: Array) -> float:
    """Angle between two directions (n,) of either sign, degrees."""
    return float(np.degrees(np.arccos(min(1.0, abs(float(one @ other))))))


# Smaller entries of a direction are not named in a sentence.
_NAMED = 0.05


@dataclass(frozen=True)
class Reading(Frozen):
    """Control intent according to one choice of weights."""

    rule: str  # Rule by which the weights were chosen
    weights: Weights  # In plant units, scaled to R[0, 0] = 1
    condition: float  # kappa(blkdiag(Q, R)) in plant units
    eigenvalues: Array  # Of Q, ascending (n,)
    vectors: Array  # Eigenvectors, one a column (n, n); each with its largest entry positive
    angle: float  # Between the dominant direction and that of the first reading, degrees

    @property
    def dominant(self) -> Array:
        """Direction v of the dominant cost (n,)."""
        return self.vectors[:, -1]


@dataclass(frozen=True)
class Intent(Frozen):
    """Control intent of one gain by several rules; the first is that of the dissertation."""

    readings: tuple[Reading, ...]
    missing: tuple[str, ...]  # Rules that failed, with the reason
    # Typical size of each state (n,): RMS in the simulated recordings
    sizes: Array

    @property
    def reported(self) -> Reading:
        """Intent by the first rule."""
        return self.readings[0]

    @property
    def widest_angle(self) -> float:
        """Largest angle between the dominant directions of the first and another rule, degrees."""
        return max(item.angle for item in self.readings)


def intent(plant: Plant, gain: Array, metrics: Array, sizes: Array, fallback: Weights) -> Intent:
    """Compute the intent from the weights that have a gain, by each rule."""
    readings: list[Reading] = []
    missing: list[str] = []
    try:
        rules = _rules(plant, gain, metrics, sizes)
    except (WeightsError, SolverError) as error:
        rules, missing = [], [f"{_PLANT_UNITS}: {error}"]
    for rule, choose in rules:
        try:
            found = choose()
        except (WeightsError, SolverError) as error:
            missing.append(f"{rule}: {error}")
            continue
        readings.append(_reading(rule, found, readings))
    if not readings or (missing and missing[0].startswith(_PLANT_UNITS)):
        first = _reading("the weights that the fit ended with", fallback, [])
        readings = [first, *(_reading(item.rule, item.weights, [first]) for item in readings)]
    return Intent(tuple(readings), tuple(missing), frozen(sizes))


def dominant_sentence(reading: Reading, plant: Plant, sizes: Array) -> str:
    """Sentence with the dominant cost (3.26), its share and the states that it penalises.

    States count by v_i times their typical size `sizes` (n,), so that units do not matter.
    """
    v = reading.dominant
    terms = [
        f"{v[index]:+.2f} {plant.states[index]}"
        for index in np.argsort(-np.abs(v), kind="stable")
        if abs(v[index]) >= _NAMED
    ]
    share = reading.eigenvalues[-1] / np.sum(reading.eigenvalues)
    parts = np.abs(v * sizes)
    order = np.argsort(-parts, kind="stable")
    named = [
        f"{plant.states[index]} ({100 * parts[index] / np.sum(parts):.0f} %)"
        for index in order
        if parts[index] >= _NAMED * np.sum(parts)
    ]
    return (
        f"The dominant cost is {reading.eigenvalues[-1]:.3g} ({' '.join(terms)})^2, "
        f"{100 * share:.0f} % of the trace of Q. At the typical size of the states in the "
        f"recordings it penalises {', '.join(named)}."
    )


_PLANT_UNITS = "minimum condition number, plant units"


def _rules(
    plant: Plant, gain: Array, metrics: Array, sizes: Array
) -> list[tuple[str, Callable[[], Weights]]]:
    fibre = gain_fibre(plant, gain, metrics)

    def of_least_trace() -> Weights:
        """Least trace up to ten times the least condition number (the infimum is not attained)."""
        squares = np.diag(np.append(np.asarray(sizes) ** 2, np.zeros(plant.m)))
        return linear_maxima(weights_set(fibre), -squares[None])[0].weights

    return [
        (_PLANT_UNITS, lambda: least_condition_weights(fibre).weights),
        ("analytic centre (no units)", lambda: analytic_centre(fibre).weights),
        ("least trace, states over their size", of_least_trace),
    ]


def _reading(rule: str, weights: Weights, before: list[Reading]) -> Reading:
    scaled = normalised(weights)
    values, vectors = np.linalg.eigh(scaled.Q)
    largest = np.argmax(np.abs(vectors), axis=0)
    vectors = vectors * np.sign(vectors[largest, np.arange(len(values))])
    angle = _angle(before[0].dominant, vectors[:, -1]) if before else 0.0
    return Reading(rule, scaled, condition_number(scaled), frozen(values), frozen(vectors), angle)
