"""Text, HTML and figure of an estimate: methods of `Estimate`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import escape

from impc.arrays import Array
from impc.checking import asked, checked
from impc.errors import InputError
from impc.inverse.estimates import Estimate
from impc.inverse.methods import METHODS
from impc.model.plant import Plant, gain_unit
from impc.model.signal_errors import KINDS
from impc.reporting.shown_units import axis_label, error_unit, shown_unit

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes

_WIDTH = 78
# Largest number of rows of a matrix that is printed in full.
_SMALL = 4


def summary(estimate: Estimate) -> str:
    """Text summary: method, problem, fit, qualifications, gain with intervals, and weights."""
    lines = [METHODS[estimate.method].label, "=" * _WIDTH, *_problem(estimate)]
    if estimate.K is None:
        return "\n".join([*lines, "-" * _WIDTH, estimate.status.sentence, estimate.reason])
    plant = estimate.problem.plant
    shares = zip(plant.outputs, estimate.vaf, strict=True)
    lines.append("VAF, %:     " + ", ".join(f"{name} {value:.4g}" for name, value in shares))
    said = (estimate.status.sentence, estimate.reason, *estimate.doubts)
    lines += [text for text in said if text]  # warnings come before the numbers
    staged = estimate.problem.terminal_weight is not None
    table = gain_table(plant, estimate.gain) if staged else estimate.intervals()
    lines += ["-" * _WIDTH, table.round(6).to_string(), "-" * _WIDTH]
    if estimate.weights is not None:
        parts = (("Q", estimate.weights.Q), ("R", estimate.weights.R))
        for name, matrix in parts:
            text = np.array2string(matrix, precision=4, suppress_small=True)
            small = len(matrix) <= _SMALL
            text = text.replace("\n", "\n    ") if small else f"{matrix.shape}, see .weights"
            lines.append(f"{name} = {text}")
        if not staged:
            lines.append(
                "Intervals: of the gain fitted without weights. .K is the gain of these weights."
            )
    return "\n".join(lines)


def _problem(estimate: Estimate) -> list[str]:
    problem = estimate.problem
    plant, bounds = problem.plant, problem.bounds
    samples = sum(trial.samples for trial in problem.recordings)
    limits = [
        f"{low:g} <= {name} <= {high:g}"
        for names, lows, highs in (
            (plant.controls, bounds.u_min, bounds.u_max),
            (plant.states, bounds.x_min, bounds.x_max),
        )
        for name, low, high in zip(names, lows, highs, strict=True)
        if np.isfinite(low) or np.isfinite(high)
    ]
    lines = [
        f"Recordings: {len(problem.recordings)} trials, {samples} samples of {plant.dt:g} s",
        f"Controller: horizon {problem.horizon}, {', '.join(limits) or 'no bounds'}",
    ]
    signals = dict.fromkeys(name for trial in problem.recordings for name in trial.signals)
    if signals:
        known = f", known {plant.ahead} samples ahead" if plant.ahead else ""
        lines.append(f"Targets:    {', '.join(signals)}{known}")
    rates = zip(plant.disturbances, plant.observer, strict=True)
    learned = [f"{name} at {rate:.4g} 1/s" for name, rate in rates if rate > 0]
    if learned:
        lines.append(f"Observer:   {', '.join(learned)}")
    if len(problem.measured) > len(plant.outputs):
        lines.append(f"Commands:   recorded, {', '.join(plant.controls)}")
    for kind, name, values in problem.fitted_errors:
        factor, unit = error_unit(plant, kind, name)
        listed = ", ".join(f"{factor * value:.4g}" for value in values)
        lines.append(f"Errors:     {name} has {KINDS[kind][0]}, {listed} {unit}, one per trial")
    return lines


def as_html(estimate: Estimate) -> str:
    """Status and gain as escaped HTML for a notebook."""
    head = f"<p>{escape(METHODS[estimate.method].label)}: {escape(estimate.status.sentence)}</p>"
    if estimate.K is None:
        return head + f"<p>{escape(estimate.reason)}</p>"
    table = gain_table(estimate.problem.plant, estimate.gain)
    shown = table.to_html(index=False, float_format="{:.4g}".format)
    doubts = "".join(f"<p>{escape(text)}</p>" for text in estimate.doubts)
    return head + shown + doubts


def gain_table(plant: Plant, gain: Array) -> pd.DataFrame:
    """Table of a gain (m, n) of u = -Kx: input, state, unit and value of each entry."""
    import pandas as pd  # noqa: PLC0415  # a third of a second

    rows = [
        (control, state, gain_unit(plant, control, state), float(value))
        for control, row in zip(plant.controls, gain, strict=True)
        for state, value in zip(plant.states, row, strict=True)
    ]
    return pd.DataFrame(rows, columns=["input", "state", "unit", "value"])


@checked(trial=0)
def plot(estimate: Estimate, trial: int = 0, axes: Any = None) -> np.ndarray[Any, Any]:
    """Plot outputs and inputs of a trial (counted from 0); returns matplotlib axes.

    `axes` is an array of your own axes, one per output and input. To save the figure, use
    `found.plot()[0].figure.savefig("fit.png")`.
    """
    import matplotlib.pyplot as plt  # noqa: PLC0415  # a second

    problem, plant = estimate.problem, estimate.problem.plant
    if trial >= len(problem.recordings):
        last = len(problem.recordings) - 1
        raise InputError("trial", f"got {trial}", f"pass an integer from 0 to {last}")
    run, recorded = estimate.simulations[trial], problem.recordings[trial].corrected
    count = len(plant.outputs) + plant.m
    if axes is None:
        _, axes = plt.subplots(count, sharex=True, layout="constrained")
    shown: np.ndarray[Any, Any] = asked("axes", lambda: np.ravel(np.asarray(axes, dtype=object)))
    if len(shown) != count or not all(hasattr(type(axis), "plot") for axis in shown):
        raise InputError("axes", f"got {len(shown)}", f"pass {count}: outputs, then inputs")
    for k, name in enumerate(plant.outputs):
        factor, _ = shown_unit(plant, name)
        shown[k].plot(run.time, factor * recorded[:, k], color="0.7", linewidth=3, label="recorded")
        shown[k].plot(run.time, factor * run.outputs[:, k], label="simulated")
        shown[k].set_ylabel(axis_label(plant, name))
    for k, name in enumerate(plant.controls):
        _input(shown[len(plant.outputs) + k], estimate, trial, k, name)
    shown[0].legend(ncols=2, loc="lower right", bbox_to_anchor=(1, 1), frameon=False)
    shown[-1].set_xlabel("time (s)")
    return shown


def _input(axis: Axes, estimate: Estimate, trial: int, k: int, name: str) -> None:
    plant, bounds = estimate.problem.plant, estimate.problem.bounds
    run, (factor, _) = estimate.simulations[trial], shown_unit(plant, name)
    axis.step(run.time[:-1], factor * run.inputs[:, k], where="post", color="C0")
    for end in (bounds.u_min[k], bounds.u_max[k]):
        if np.isfinite(end):
            axis.axhline(factor * end, color="0.4", linestyle=":")
    axis.set_ylabel(axis_label(plant, name))
