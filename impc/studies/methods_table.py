"""Methods beside each other: one table for readers, one for programs, and result.json.

The columns are those of `impc.assess.assessments`, whichever command asks (docs/results.md).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from impc.arrays import Array, Frozen
from impc.assess.assessments import ASSESSMENTS, assessed
from impc.inverse.methods import METHODS
from impc.model.signal_units import price_unit
from impc.reporting.document import Terms, TextTable
from impc.reporting.rendering import number

if TYPE_CHECKING:
    from collections.abc import Sequence

    from impc.assess.assessments import MethodFit
    from impc.control.simulation import Simulation
    from impc.model.plant import Plant
    from impc.model.weights import Weights


@dataclass(frozen=True)
class _Column(Frozen):
    label: str
    key: str
    values: Array
    digits: int


def methods_table(fits: Sequence[MethodFit]) -> TextTable:
    """What methods reach on the same recordings, for readers; no column without a number."""
    columns = [column for column in _columns(fits) if not np.all(np.isnan(column.values))]
    noted = any(fit.estimate.reason for fit in fits)
    rows = []
    for row, fit in enumerate(fits):
        cells = [number(float(column.values[row]), column.digits) for column in columns]
        note = [fit.estimate.reason] * noted
        rows.append((METHODS[fit.name].label, *cells, f"{fit.estimate.seconds:.2f}", *note))
    heads = ["method", *(column.label for column in columns), "seconds", *(["note"] * noted)]
    return TextTable("Every method on the same recordings, all trials at once.", heads, rows)


def methods_numbers(fits: Sequence[MethodFit]) -> TextTable:
    """The same with every digit, for programs."""
    columns, rows = _columns(fits), []
    for row, fit in enumerate(fits):
        cells = [float(column.values[row]) for column in columns]
        rows.append((fit.name, *cells, fit.estimate.seconds, fit.estimate.reason))
    heads = ["method", *(column.key for column in columns), "seconds", "reason"]
    return TextTable("", heads, rows)


def methods_data(fits: Sequence[MethodFit]) -> dict[str, Any]:
    """`methods` of result.json (docs/results.md)."""
    return {fit.name: _data(fit) for fit in fits}


def column_terms() -> Terms:
    """What each column says, in a sentence."""
    heads = [
        item.label.format("", unit="").replace("()", "").strip() for item in ASSESSMENTS.values()
    ]
    sentences = [(item.sentence,) for item in ASSESSMENTS.values()]
    return Terms(list(zip(heads, sentences, strict=True)))


def _columns(fits: Sequence[MethodFit]) -> list[_Column]:
    plant = fits[0].estimate.problem.plant
    return [
        _Column(label, key, values, item.digits)
        for item in ASSESSMENTS.values()
        for label, key, values in zip(
            item.heads(plant),
            item.keys(plant),
            np.array([item.find(fit) for fit in fits]).T,
            strict=True,
        )
    ]


def _data(fit: MethodFit) -> dict[str, Any]:
    found = fit.estimate
    return {
        "K": found.K,
        "S": found.S,
        "Q": None if found.weights is None else found.weights.Q,
        "R": None if found.weights is None else found.weights.R,
        "status": found.status.value,
        "reason": found.reason,
        "misfit": found.misfit,
        "evaluations": found.evaluations,
        "seconds": found.seconds,
        **assessed(fit),
        "trial_vaf": fit.trial_vaf,
        "held_out_trial_vaf": fit.held_out,
        "fell": fit.fell,
    }


def weight_entries(plant: Plant, weights: Weights) -> list[tuple[str, str, str, str, float]]:
    """The lower triangles of Q and R, one row an entry: matrix, two names, unit, value."""
    return [
        (which, one, other, price_unit(plant, one, other), float(matrix[i, j]))
        for which, names, matrix in (
            ("Q", plant.states, weights.Q),
            ("R", plant.controls, weights.R),
        )
        for i, one in enumerate(names)
        for j, other in enumerate(names[: i + 1])
    ]


def until_its_end(plant: Plant, run: Simulation) -> tuple[Array, Array]:
    """Outputs (steps + 1, p) and commands (steps + 1, m) of a run, NaN where it did not get.

    The last sample has no command.
    """
    y, u = np.array(run.x @ plant.C.T), np.full((len(run.x), plant.m), np.nan)
    y[run.reached + 1 :] = np.nan
    u[: run.reached] = run.u[: run.reached]
    return y, u
