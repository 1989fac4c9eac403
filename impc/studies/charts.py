"""Data of the interactive curves on a page.

    curves   label, colour (CSS variable) and dash pattern of each; the first is the recording
    trials   label, step (s) and panels of each; a panel is one signal: label, limits, and the
             values of every curve (null: no value)

Long trials are thinned.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from impc.inverse.methods import METHODS
from impc.reporting.shown_units import axis_label, shown_unit
from impc.studies.methods_table import until_its_end

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from impc.arrays import Array
    from impc.assess.assessments import MethodFit
    from impc.inverse.problem import Problem

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
        label = METHODS[fit.name].label
        curves.append(
            {"label": label, "color": _COLOURS[k % 6], "dash": _DASHES[k // 6 + (k > 0) % 4]}
        )
    samples = sum(problem.recordings[index].samples for index in trials)
    stride = -(-samples * len(curves) * (len(plant.outputs) + plant.m) // _MOST)
    return {
        "curves": curves,
        "trials": [
            {
                "label": label,
                "step": plant.dt * stride,
                "panels": _panels(problem, drawn, k, stride),
            }
            for k, label in trials.items()
        ],
    }


def _panels(
    problem: Problem, fits: Sequence[MethodFit], trial: int, stride: int
) -> list[dict[str, Any]]:
    plant, bounds, given = problem.plant, problem.bounds, problem.recordings[trial]
    runs = [until_its_end(plant, fit.runs[trial]) for fit in fits]
    unknown = np.full((given.samples, plant.m), np.nan)
    outputs = [given.corrected, *(y for y, _ in runs)]
    commands = [given.commands if len(given.commands) else unknown, *(u for _, u in runs)]
    panels = []
    for names, curves, limited in (
        (plant.outputs, outputs, False),
        (plant.controls, commands, True),
    ):
        for column, name in enumerate(names):
            factor = shown_unit(plant, name)[0]
            limits = [bounds.u_min[column], bounds.u_max[column]] if limited else []
            panels.append(
                {
                    "label": axis_label(plant, name),
                    "limits": [float(factor * one) for one in limits if np.isfinite(one)],
                    "curves": [short(factor * part[::stride, column]) for part in curves],
                }
            )
    return panels


def short(values: Array) -> list[float | None]:
    """Round to five digits; not finite values become None."""
    return [float(f"{one:.5g}") if np.isfinite(one) else None for one in values]
