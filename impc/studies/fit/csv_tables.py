"""The numbers of a fit as tables for spreadsheets: gain, weights, methods, trajectories.

    gain.csv          a row a number and method: name, unit, value, ends, level, whether it is told
    weights.csv       a row an entry of the reported Q and R, at R[0][0] = 1, and its range over all
                      weights with this gain, where it was computed
    trajectories.csv  a row a sample of the trials that the page draws: recorded and simulated

Numbers are in the units of the plant (docs/results.md).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from impc.model.signal_units import UNKNOWN
from impc.reporting.document import TextTable
from impc.studies.fit.result import shown_trials
from impc.studies.fit.tables import number_units
from impc.studies.methods_table import methods_numbers, until_its_end, weight_entries

if TYPE_CHECKING:
    from impc.studies.fit.result import FitResult


def fit_tables(result: FitResult) -> dict[str, TextTable]:
    """The tables by name."""
    return {
        "gain": _gain(result),
        "weights": _weights(result),
        "methods": methods_numbers(result.methods),
        "trajectories": _trajectories(result),
    }


def _gain(result: FitResult) -> TextTable:
    units = number_units(result.given.plant)
    rows = [
        (
            item.name,
            units.get(item.name, UNKNOWN),
            item.method,
            *(np.nan if value is None else float(value) for value in (item.value, item.low)),
            float(item.high),
            item.level,
            "yes" if item.told else "no",
            "yes" if item.excludes_zero else "no",
        )
        for item in result.certainty.intervals
    ]
    heads = (
        "number",
        "unit",
        "method",
        "value",
        "low",
        "high",
        "level",
        "identified",
        "excludes_zero",
    )
    return TextTable("", heads, rows)


def _weights(result: FitResult) -> TextTable:
    plant, weights = result.given.plant, result.intent.reported.weights
    summary = result.certainty.weights
    # At trace R = m: with one command the scale of the entries.
    found = summary.entries if summary is not None and plant.m == 1 else ()
    ranges = {frozenset((item.first, item.second)): (item.low, item.high) for item in found}
    no_range = (np.nan, np.nan)
    rows = [
        (*entry, *(ranges.get(frozenset(entry[1:3]), no_range) if entry[0] == "Q" else no_range))
        for entry in weight_entries(plant, weights)
    ]
    return TextTable("", ("matrix", "first", "second", "unit", "value", "low", "high"), rows)


def _trajectories(result: FitResult) -> TextTable:
    plant, blocks = result.given.plant, []
    for index in shown_trials(result):
        trial, run = result.given.recordings[index], result.inverse_mpc.runs[index]
        steps = trial.samples
        number = np.full((steps, 1), index + 1.0)
        time = plant.dt * np.arange(steps)[:, None]
        simulated, commands = until_its_end(plant, run)
        blocks.append(
            np.hstack([number, time, trial.outputs, simulated, commands, trial.disturbance])
        )
    heads = [
        "trial",
        "time",
        *(f"{name}_recorded" for name in plant.outputs),
        *(f"{name}_simulated" for name in plant.outputs),
        *(f"{name}_simulated" for name in plant.controls),
        *plant.disturbances,
    ]
    return TextTable("", heads, np.vstack(blocks).tolist())
