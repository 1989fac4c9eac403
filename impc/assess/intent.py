"""Control intent: what the weights that have the fitted gain say, by three rules for choosing them.

With Q = T diag(q) T' (3.23) the state cost is sum q_i z_i^2, z = T'x, and its dominant part is the
last, q_n (v'x)^2 (3.26). The angle between the directions v of the rules shows how much they depend
on the rule; statements that hold for all weights are in `weights_ranges`.

See docs/why/equivalent_weights.md and docs/why/conclusions.md.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from impc.arrays import Array, Frozen, frozen
from impc.assess.bounded_weights import linear_maxima, weights_set
from impc.errors import SolverError, WeightsError
from impc.inverse.equivalent_weights import analytic_centre, least_condition_weights
from impc.inverse.solution_set import gain_fibre
from impc.model.plant import Plant
from impc.model.weights import Weights, condition_number, normalised


def dominant_direction(Q: Array) -> Array:
    """Eigenvector (n,) of the largest eigenvalue of a symmetric matrix (n, n)."""
    return np.asarray(np.linalg.eigh((Q + Q.T) / 2)[1][:, -1])


def angle_between(one: Array, other: Array) -> float:
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
    angle = angle_between(before[0].dominant, vectors[:, -1]) if before else 0.0
    return Reading(rule, scaled, condition_number(scaled), frozen(values), frozen(vectors), angle)
