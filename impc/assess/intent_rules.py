"""Control intent: what the weights of a fitted controller price most, and how sure that is.

With Q = T diag(q) T' (3.23) the state cost is sum q_i z_i^2, z = T'x; its dominant part is the
last, q_n (v'x)^2 (3.26). All weights with the fitted gain explain the recordings equally well, so
the direction v is read from several of them, each chosen by a rule of its own, and the angle
between their directions says how much of v was chosen by the rule and not by the subject.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Array, Frozen, frozen
from impc.assess.bounded_weights import linear_maxima, weights_set
from impc.errors import SolverError, WeightsError
from impc.inverse.equivalent_weights import analytic_centre, least_condition_weights
from impc.inverse.solution_set import gain_fibre
from impc.model.weights import Weights, condition_number, normalised

if TYPE_CHECKING:
    from collections.abc import Callable

    from impc.model.plant import Plant

# Entries of a direction below this are not named in a sentence.
_NAMED = 0.05


@dataclass(frozen=True)
class Reading(Frozen):
    """The intent as one choice of weights shows it."""

    rule: str  # How the weights were chosen among those with the gain
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
    """Readings of the intent behind one gain; the first is the dissertation's."""

    readings: tuple[Reading, ...]
    missing: tuple[str, ...]  # Choices that could not be made, and why
    # Typical size of each state (n,): its root-mean-square in the recordings' simulation
    sizes: Array

    @property
    def reported(self) -> Reading:
        """The first reading."""
        return self.readings[0]

    @property
    def widest_angle(self) -> float:
        """Largest angle between the reported dominant direction and another reading's, degrees."""
        return max(item.angle for item in self.readings)


def intent(plant: Plant, gain: Array, metrics: Array, sizes: Array, fallback: Weights) -> Intent:
    """Read the intent from the weights that have a gain.

    `gain` (m, n); `metrics` (k, m, m); `sizes` (n,).
    """
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
    """(3.26) in words: the dominant cost, its share, and which states it weighs.

    A state counts by v_i times its typical size, so that units do not decide: `sizes` (n,) in the
    units of the states.
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
        f"{100 * share:.0f} % of the trace of Q; at the size that the states have in the "
        f"recordings it weighs {', '.join(named)}."
    )


_PLANT_UNITS = "least condition number, plant units (the dissertation's)"


def _rules(
    plant: Plant, gain: Array, metrics: Array, sizes: Array
) -> list[tuple[str, Callable[[], Weights]]]:
    fibre = gain_fibre(plant, gain, metrics)

    def of_least_trace() -> Weights:
        """Up to ten times the least condition number: the infimum is not attained."""
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
    angle = 0.0
    if before:
        cosine = min(1.0, abs(float(before[0].dominant @ vectors[:, -1])))
        angle = float(np.degrees(np.arccos(cosine)))
    return Reading(rule, scaled, condition_number(scaled), frozen(values), frozen(vectors), angle)
