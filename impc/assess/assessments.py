"""What is said of every estimate, whatever its method: one function each, in one list.

`impc fit`, `impc compare`, `impc cohort` and `impc.report` show them in their tables and write them
into result.json under `methods.<method>.<assessment>` (docs/results.md). What takes a fit of its
own (intervals, other horizons) is asked for in the settings of a fit, and stands in
`impc.assess.all_intervals`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Array
from impc.assess.judged import MethodFit
from impc.model.plant import Plant
from impc.model.weights import condition_number

if TYPE_CHECKING:
    from collections.abc import Mapping


@dataclass(frozen=True)
class Assessment:
    """One function of a method's estimate and its simulation of all trials (docs/results.md)."""

    name: str  # In result.json and in the heads of CSV files
    sentence: str  # For readers who do not know it
    # Plant -> names of what it has a number for, (k,): outputs, inputs, or `whole` for one number
    # of the method
    signals: Callable[[Plant], tuple[str, ...]]
    find: Callable[[MethodFit], Array]  # MethodFit -> the numbers (k,); NaN where there is none

    def keys(self, plant: Plant) -> list[str]:
        """Heads of its columns in a table."""
        return [f"{self.name}_{name}".rstrip("_") for name in self.signals(plant)]


def _held_out(fit: MethodFit) -> Array:
    """Mean over trials."""
    missing = np.full(fit.vaf.shape, np.nan)
    return np.mean(fit.held_out, axis=0) if len(fit.held_out) else missing


def whole(_: Plant) -> tuple[str, ...]:
    """One number for the method."""
    return ("",)


def _first_fall(fit: MethodFit) -> Array:
    return np.array([min((time for time in fit.fell if time is not None), default=np.nan)])


def _condition(fit: MethodFit) -> Array:
    weights = fit.estimate.weights
    return np.array([np.nan if weights is None else condition_number(weights)])


#: By name, in the order of the tables.
ASSESSMENTS: dict[str, Assessment] = {
    item.name: item
    for item in (
        Assessment(
            "vaf",
            "Variance accounted for (3.24), over all trials, %.",
            lambda plant: plant.outputs,
            lambda fit: fit.vaf,
        ),
        Assessment(
            "held_out_vaf",
            "VAF of each trial predicted from the others, after the time that serves to find where "
            "it starts; the mean over trials, %.",
            lambda plant: plant.outputs,
            _held_out,
        ),
        Assessment(
            "largest_input",
            "Largest magnitude of the input, in its unit.",
            lambda plant: plant.controls,
            lambda fit: fit.largest_input,
        ),
        Assessment(
            "beyond_bound",
            "Share of the samples at which an input bound is exceeded, %.",
            whole,
            lambda fit: np.array([np.nan if fit.estimate.K is None else 100 * fit.exceeded]),
        ),
        Assessment(
            "first_fall",
            "Time at which the first of the trials leaves every reasonable range, s.",
            whole,
            _first_fall,
        ),
        Assessment(
            "condition_number",
            "Largest over smallest eigenvalue of blkdiag(Q, R), in the units of the plant.",
            whole,
            _condition,
        ),
    )
}


def assessed(fit: MethodFit) -> Mapping[str, dict[str, float] | float]:
    """Every assessment of a method by its name: a number, or a number for each signal by name."""
    plant = fit.estimate.problem.plant
    found: dict[str, dict[str, float] | float] = {}
    for item in ASSESSMENTS.values():
        signals, values = item.signals(plant), [float(value) for value in item.find(fit)]
        found[item.name] = (
            values[0] if signals == ("",) else dict(zip(signals, values, strict=True))
        )
    return found
