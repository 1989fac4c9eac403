"""Data of the interactive curves on a page.

    curves   label, colour (CSS variable) and dash pattern of each; the first is the recording
    trials   label, step (s) and panels of each; a panel is one signal: label, limits, and the
             values of every curve (null: no value)

Long trials are thinned.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from impc.arrays import Array
from impc.assess.assessments import MethodFit
from impc.inverse.methods import METHODS
from impc.inverse.problem import Problem
from impc.reporting.shown_units import axis_label, shown_unit
from impc.studies.methods_table import until_its_end

# Largest number of values on a page: 25,000 are 0.15 MB.
_MOST = 25_000
_COLOURS = ("--accent", "--limit", "--ok", "--bad", "--warn", "--muted")
_DASHES: tuple[list[int], ...] = ([], [6, 3], [2, 2], [8, 2, 2, 2])


def trajectories(
    problem: Problem, fits: Sequence[MethodFit], trials: Mapping[int, str]
) -> dict[str, Any]:
    """Curves of recording and methods in the `trials` (index -> label)."""
    drawn, plant = [fit for fit in fits if fit.runs], problem.plant
    curves: list[dict[str, Any]] = [{"label": "recorded", "color": "--rec", "dash": []}]
    for k, fit in enumerate(drawn):
        dash = _DASHES[k // 6 + (k > 0) % 4]
        curves.append({"label": METHODS[fit.name].label, "color": _COLOURS[k % 6], "dash": dash})
    samples = sum(problem.recordings[index].samples for index in trials)
    stride = -(-samples * len(curves) * (len(plant.outputs) + plant.m) // _MOST)
    found = [
        {"label": label, "step": plant.dt * stride, "panels": _panels(problem, drawn, k, stride)}
        for k, label in trials.items()
    ]
    return {"curves": curves, "trials": found}


def _panels(
    problem: Problem, fits: Sequence[MethodFit], trial: int, stride: int
) -> list[dict[str, Any]]:
    plant, bounds, given = problem.plant, problem.bounds, problem.recordings[trial]
    unknown = np.full((given.samples, plant.m), np.nan)
    pairs = [(given.corrected, given.commands if len(given.commands) else unknown)]
    pairs += [until_its_end(plant, fit.runs[trial]) for fit in fits]
    curves, none = [np.hstack(pair) for pair in pairs], np.full(len(plant.outputs), np.nan)
    limits = np.array([[*none, *bounds.u_min], [*none, *bounds.u_max]])
    panels = []
    for column, name in enumerate((*plant.outputs, *plant.controls)):
        factor = shown_unit(plant, name)[0]
        panels.append({
            "label": axis_label(plant, name),
            "limits": [float(factor * one) for one in limits[:, column] if np.isfinite(one)],
            "curves": [short(factor * part[::stride, column]) for part in curves],
        })  # fmt: skip
    return panels


def short(values: Array) -> list[float | None]:
    """Round to five digits; not finite values become None."""
    return [float(f"{one:.5g}") if np.isfinite(one) else None for one in values]
