"""The numbers of a comparison as tables for spreadsheets: gains, weights and trajectories.

    gain.csv          a row an entry of a method's gain: name, unit, method, value
    weights.csv       a row an entry of a method's Q and R, at R[0][0] = 1
    trajectories.csv  a row a sample: recorded, and as every method has it

Numbers are in the units of the plant (docs/results.md); those of `impc fit` have intervals too.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from impc.model.signal_units import gain_unit
from impc.reporting.document import TextTable
from impc.studies.methods_table import methods_numbers, until_its_end, weight_entries

if TYPE_CHECKING:
    from collections.abc import Sequence

    from impc.assess.assessments import MethodFit
    from impc.inverse.problem import Problem


def compare_tables(problem: Problem, compared: Sequence[MethodFit]) -> dict[str, TextTable]:
    """The tables by name."""
    return {
        "gain": _gain(problem, compared),
        "weights": _weights(problem, compared),
        "methods": methods_numbers(compared),
        "trajectories": _trajectories(problem, compared),
    }


def _gain(problem: Problem, compared: Sequence[MethodFit]) -> TextTable:
    plant = problem.plant
    rows = [
        (f"K.{control}.{state}", gain_unit(plant, control, state), item.name, float(K[i, j]))
        for item in compared
        if (K := item.estimate.K) is not None
        for i, control in enumerate(plant.controls)
        for j, state in enumerate(plant.states)
    ]
    return TextTable("", ("number", "unit", "method", "value"), rows)


def _weights(problem: Problem, compared: Sequence[MethodFit]) -> TextTable:
    plant = problem.plant
    rows = [
        (*entry[:-1], item.name, entry[-1])
        for item in compared
        if item.estimate.weights is not None
        for entry in weight_entries(plant, item.estimate.weights)
    ]
    return TextTable("", ("matrix", "first", "second", "unit", "method", "value"), rows)


def _trajectories(problem: Problem, compared: Sequence[MethodFit]) -> TextTable:
    """Every trial; a method that falls has no numbers from there on."""
    plant, blocks = problem.plant, []
    shown = [item for item in compared if item.runs]
    for index, trial in enumerate(problem.recordings):
        steps = trial.samples
        parts = [np.full((steps, 1), index + 1.0), plant.dt * np.arange(steps)[:, None]]
        parts += [np.asarray(trial.outputs), np.asarray(trial.disturbance)]
        for item in shown:
            parts += until_its_end(plant, item.runs[index])
        blocks.append(np.hstack(parts))
    heads = ["trial", "time", *(f"{name}_recorded" for name in plant.outputs), *plant.disturbances]
    for item in shown:
        heads += [f"{name}_{item.name}" for name in (*plant.outputs, *plant.controls)]
    return TextTable("", heads, np.vstack(blocks).tolist())
