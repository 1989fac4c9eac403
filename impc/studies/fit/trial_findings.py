"""What a fit says of each trial: agreement, offsets, commands, residuals, checks, curves."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from impc.reporting.finding import Finding, Picture
from impc.reporting.shown_units import shown_unit
from impc.studies.fit.aim import aim_data
from impc.studies.fit.body_words import lack_finding
from impc.studies.fit.gain_findings import number_name
from impc.studies.fit.result import shown_trials, trial_name
from impc.studies.methods_table import trajectory_table

if TYPE_CHECKING:
    from impc.studies.fit.result import FitResult


def agreement_finding(result: FitResult) -> Finding:
    """How much of each output of each trial is explained."""
    outputs, rows = result.fitted.problem.plant.outputs, []
    for index, trial in enumerate(result.trials):
        held = result.held_out[index].vaf if result.held_out else [np.nan] * len(outputs)
        for column, name in enumerate(outputs):
            rows.append(
                {
                    "trial": trial_name(result, index),
                    "output": name,
                    "vaf_percent": float(trial.vaf[column]),
                    "left_out_vaf_percent": float(held[column]),
                    "p_white_residual": float(trial.whiteness[column]),
                    "at_the_bound_percent": 100 * float(trial.saturated),
                }
            )
    return Finding(
        "agreement",
        pd.DataFrame(rows),
        "Variance accounted for (VAF). Left out: predicted from the other trials, after the time "
        "that serves to find where the trial starts. P-value of Ljung and Box's test that the "
        "residual is white; a small one says that something regular is left.",
        digits=5,
    )


def offset_findings(result: FitResult) -> list[Finding]:
    """What the outputs of each trial have too much, where that was asked for."""
    plant, offsets = result.fitted.problem.plant, aim_data(result)["offsets"]
    rows = [
        (trial_name(result, index), name, shown_unit(plant, name)[1],
         shown_unit(plant, name)[0] * value)
        for name, values in offsets.items()
        for index, value in enumerate(values)
    ]  # fmt: skip
    table = pd.DataFrame(rows, columns=["trial", "output", "unit", "offset"])
    caption = "What the recorded outputs have too much, found with the gain."
    return [Finding("offsets", table, caption)] if rows else []


def command_findings(result: FitResult) -> list[Finding]:
    """The gain by regression on recorded commands beside that of the fit, where there are any."""
    if result.commands is None:
        return []
    table = result.commands.reset_index(names="number")
    table["number"] = [number_name(result.given.plant, name) for name in table["number"]]
    inside = table["fitted"].between(table["low"], table["high"])
    said = (
        f"{inside.sum()} of the {len(table)} entries of the fitted gain lie inside the 95 % "
        "intervals of a regression of the recorded commands on the states."
    )
    caption = (
        "The regression takes samples without a bound. Noise in recorded states, and noise of the "
        "subject that is not white, bias the regression; a wrong plant or bound biases the fit. "
        "Where the two differ by much, one of these is there (docs/fitting.md)."
    )
    return [Finding("command_regression", table, caption, [said])]


def residual_findings(result: FitResult) -> list[Finding]:
    """Tests that speak against the model; their warnings have to be read before any number."""
    last = result.lack[-1]
    return [] if last is None else [lack_finding(result, last)]


RESIDUALS = Picture(
    "residuals",
    "Residuals over time and their autocorrelation",
    "Residuals of every trial, one below the other, and their autocorrelation.",
)


def check_finding(result: FitResult) -> Finding:
    """What the checks of the recordings found."""
    rows = [
        (trial_name(result, index), line)
        for index, trial in enumerate(result.given.recordings)
        for line in trial.findings or ("Nothing found.",)
    ]
    return Finding("checks", pd.DataFrame(rows, columns=["trial", "found"]))


def trajectory_finding(result: FitResult) -> Finding:
    """A row a sample of the trials that the page draws: recorded and simulated."""
    runs = {"simulated": result.inverse_mpc.runs}
    table = trajectory_table(result.fitted.problem, shown_trials(result), runs)
    drives = list(result.given.plant.disturbances)
    others = [name for name in table.columns if name not in drives]
    return Finding("trajectories", table[[*others, *drives]])
