"""Methods beside each other: a table, and result.json.

The columns are those of `impc.assess.assessments`, whichever command asks (docs/results.md).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from impc.assess.assessments import ASSESSMENTS, assessed
from impc.inverse.methods import METHODS
from impc.model.plant import weight_unit
from impc.reporting.document import Terms
from impc.reporting.finding import Finding

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from impc.arrays import Array
    from impc.assess.assessments import MethodFit
    from impc.control.simulation import Simulation
    from impc.inverse.problem import Problem
    from impc.model.plant import Plant
    from impc.model.weights import Weights


def methods_finding(fits: Sequence[MethodFit]) -> Finding:
    """What methods reach on the same recordings; no column without a number."""
    plant, rows = fits[0].estimate.problem.plant, []
    for fit in fits:
        row: dict[str, Any] = {"method": METHODS[fit.name].label}
        for item in ASSESSMENTS.values():
            row |= dict(zip(item.keys(plant), map(float, item.find(fit)), strict=True))
        ended = {"seconds": fit.estimate.seconds, "name": fit.name, "note": fit.estimate.reason}
        rows.append(row | ended)
    table = pd.DataFrame(rows).dropna(axis="columns", how="all")
    if not any(table["note"]):
        table = table.drop(columns="note")
    caption = "Every method on the same recordings, all trials at once."
    return Finding("methods", table, caption)


def methods_data(fits: Sequence[MethodFit]) -> dict[str, Any]:
    """`methods` of result.json (docs/results.md)."""
    return {fit.name: _data(fit) for fit in fits}


def column_terms() -> Terms:
    """What each column says, in a sentence."""
    return Terms([(key.replace("_", " "), (item.sentence,)) for key, item in ASSESSMENTS.items()])


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
        (which, one, other, weight_unit(plant, one, other), float(matrix[i, j]))
        for which, names, matrix in (
            ("Q", plant.states, weights.Q),
            ("R", plant.controls, weights.R),
        )
        for i, one in enumerate(names)
        for j, other in enumerate(names[: i + 1])
    ]


def trajectory_table(
    problem: Problem, trials: Iterable[int], runs: Mapping[str, Sequence[Simulation]]
) -> pd.DataFrame:
    """A row a sample of these trials: recorded, what drove them, and the runs of each name."""
    plant, blocks = problem.plant, []
    for index in trials:
        trial = problem.recordings[index]
        steps = trial.samples
        parts = [np.full((steps, 1), index + 1.0), plant.dt * np.arange(steps)[:, None]]
        parts += [np.asarray(trial.without_offset), np.asarray(trial.disturbance)]
        for each in runs.values():
            parts += until_its_end(plant, each[index])
        blocks.append(np.hstack(parts))
    heads = ["trial", "time", *(f"{name}_recorded" for name in plant.outputs), *plant.disturbances]
    for ending in runs:
        heads += [f"{name}_{ending}" for name in (*plant.outputs, *plant.controls)]
    return pd.DataFrame(np.vstack(blocks), columns=heads)


def until_its_end(plant: Plant, run: Simulation) -> tuple[Array, Array]:
    """Outputs (steps + 1, p) and commands (steps + 1, m) of a run, NaN where it did not get.

    The last sample has no command.
    """
    y, u = np.array(run.x @ plant.C.T), np.full((len(run.x), plant.m), np.nan)
    y[run.reached + 1 :] = np.nan
    u[: run.reached] = run.u[: run.reached]
    return y, u
