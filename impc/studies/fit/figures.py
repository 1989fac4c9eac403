"""Figures of a fit: trajectories (figure 3.7), residuals, intent, methods."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from impc.inverse.methods import METHODS
from impc.model.foresight import physical_disturbances
from impc.reporting.shown_units import axis_label, shown_unit
from impc.reporting.style import (
    BLUE,
    DOUBLE_COLUMN,
    FORBIDDEN,
    GREEN,
    INK,
    VERMILLION,
    drawn,
    journal_style,
    new_figure,
)
from impc.studies.fit.interval_figures import (
    gain_figure,
    shown_statements,
    statements_figure,
)
from impc.studies.fit.result import MOST_TRIALS, shown_trials, trial_name
from impc.studies.fit.structures import cost_weight_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from impc.arrays import Array
    from impc.studies.fit.result import FitResult

_SOFT = "#8C8C8C"
_LAGS = 1.0  # s of the autocorrelation
_WINDOW = 10.0  # s of the comparison
_METHOD_LINES = {
    "inverse_mpc": (VERMILLION, "-"),
    "inverse_lqr_output": (BLUE, "--"),
    "clipped_lqr": (GREEN, ":"),
}


def fit_figures(result: FitResult) -> dict[str, bytes]:
    """Draw all figures: PNG and PDF by file name."""
    with journal_style():
        figures = {
            f"trajectories-trial-{index + 1}": trajectory_figure(result, index)
            for index in shown_trials(result)
        }
        figures["gain"] = gain_figure(result)
        if shown_statements(result):
            figures["statements"] = statements_figure(result)
        figures["residuals"] = _residuals(result)
        figures["intent"] = _intent(result)
        figures["methods"] = _methods(result)
        if result.structures and result.structures[0].ratios:
            figures["structured-weights"] = cost_weight_figure(result)
        return drawn(figures)


def trajectory_figure(result: FitResult, index: int) -> Figure:
    """Outputs, command and disturbance of a trial, recorded and simulated."""
    plant = result.fitted.problem.plant
    trial, run = result.fitted.problem.recordings[index], result.inverse_mpc.runs[index]
    time = np.arange(trial.samples) * plant.dt
    drives = plant.disturbances[: physical_disturbances(plant)]
    pushes = trial.disturbance[:, : len(drives)]
    rows = len(plant.outputs) + plant.m + (1 if np.any(pushes) else 0)
    figure = new_figure(DOUBLE_COLUMN, 0.5 + 1.15 * rows)
    axes = np.atleast_1d(figure.subplots(rows, 1, sharex=True))
    for column, name in enumerate(plant.outputs):
        factor, _ = shown_unit(plant, name)
        ax = axes[column]
        ax.plot(
            time,
            factor * trial.without_offset[:, column],
            color=_SOFT,
            linewidth=1.6,
            label="recorded",
            rasterized=True,
        )
        if name in trial.signals:
            target = factor * trial.target[:, trial.signals.index(name)]
            ax.plot(time, target, "k--", linewidth=0.6, drawstyle="steps-post", label="target")
        simulated = run.x @ plant.C.T
        ax.plot(
            time,
            factor * simulated[:, column],
            color=VERMILLION,
            linestyle="--",
            linewidth=1.0,
            label="simulated",
        )
        ax.set_ylabel(axis_label(plant, name))
    for column in range(plant.m):
        _command(axes[len(plant.outputs) + column], result, index, column)
    if np.any(pushes):
        ax = axes[-1]
        ax.plot(time, pushes, color=INK, linewidth=0.8, drawstyle="steps-post")
        ax.set_ylabel(", ".join(axis_label(plant, name) for name in drives))
    axes[0].set_title(trial_name(result, index), loc="right")
    axes[0].legend(loc="upper left", ncols=3, bbox_to_anchor=(0, 1.28))
    axes[-1].set_xlabel("time (s)")
    axes[-1].set_xlim(0, time[-1])
    return figure


def _command(ax: Axes, result: FitResult, index: int, column: int) -> None:
    name = result.given.plant.controls[column]
    dt = result.fitted.problem.plant.dt
    u = result.inverse_mpc.runs[index].u[:, column]
    time = np.arange(len(u)) * dt
    bounds = result.given.bounds
    for limit in (bounds.u_min[column], bounds.u_max[column]):
        if np.isfinite(limit):
            ax.axhline(limit, color=INK, linewidth=0.8, linestyle=":")
            at = np.isclose(u, limit, rtol=1e-6)
            ax.fill_between(
                time,
                0,
                1,
                where=at,
                transform=ax.get_xaxis_transform(),
                color=FORBIDDEN,
                linewidth=0,
                step="post",
            )
    commands = result.given.recordings[index].commands[: len(u), column]
    if len(commands):
        ax.plot(time, commands, color=_SOFT, linewidth=1.6, drawstyle="steps-post")
    ax.plot(time, u, color=BLUE, linewidth=0.9, drawstyle="steps-post")
    ax.set_ylabel(axis_label(result.given.plant, name))


def _residuals(result: FitResult) -> Figure:
    plant = result.fitted.problem.plant
    trials, p = result.fitted.problem.recordings, len(plant.outputs)
    count = min(len(trials), MOST_TRIALS)
    figure = new_figure(DOUBLE_COLUMN, 0.4 + 1.3 * p * 1.0)
    axes = np.array(figure.subplots(p, 2, width_ratios=[3, 1], squeeze=False, sharex="col"))
    for column, name in enumerate(plant.outputs):
        factor, unit = shown_unit(plant, name)
        series = [
            factor * (trial.without_offset - run.x @ plant.C.T)[:, column]
            for trial, run in zip(trials, result.inverse_mpc.runs, strict=True)
        ]
        offset = 6 * max(float(np.nanstd(part)) for part in series)
        for index, part in enumerate(series[:MOST_TRIALS]):
            axes[column, 0].plot(
                np.arange(len(part)) * plant.dt,
                part - index * offset,
                color=INK,
                linewidth=0.4,
                rasterized=True,
            )
        axes[column, 0].set_yticks(
            [-index * offset for index in range(count)],
            [trial_name(result, index)[-12:] for index in range(count)],
        )
        axes[column, 0].set_ylabel("trial (-)")
        axes[column, 0].set_title(f"residual of {name}, {offset:.2g} {unit} apart", loc="left")
        _autocorrelation(axes[column, 1], series, plant.dt)
    axes[-1, 0].set_xlabel("time (s)")
    axes[-1, 1].set_xlabel("lag (s)")
    return figure


def _autocorrelation(ax: Axes, series: list[Array], dt: float) -> None:
    lags = min(round(_LAGS / dt), min(len(part) for part in series) // 4)
    styles = ("-", "--", ":", "-.")
    for index, part in enumerate(series):
        centred = np.nan_to_num(part - np.nanmean(part))
        power = float(centred @ centred) or 1.0
        values = [float(centred[k:] @ centred[: len(centred) - k]) / power for k in range(1, lags)]
        ax.plot(
            np.arange(1, lags) * dt,
            values,
            color=INK,
            linewidth=0.8,
            linestyle=styles[index % len(styles)],
        )
    band = 1.96 / np.sqrt(min(len(part) for part in series))
    ax.axhspan(-band, band, color=FORBIDDEN, linewidth=0)
    ax.set_ylim(-0.4, 1.0)
    ax.set_ylabel("autocorrelation (-)")
    ax.set_title("grey: white noise", loc="left")


def _intent(result: FitResult) -> Figure:
    plant, readings = result.fitted.problem.plant, result.intent.readings
    figure = new_figure(DOUBLE_COLUMN, 2.9)
    left, right = figure.subplots(1, 2, width_ratios=[1, 2.2])
    marks = ("o", "s", "D")
    for index, reading in enumerate(readings):
        values = reading.eigenvalues[::-1]
        left.plot(
            np.arange(1, len(values) + 1),
            values,
            marker=marks[index % 3],
            linewidth=0.7,
            color=_shade(index),
            markerfacecolor="white" if index else _shade(index),
        )
        parts = np.abs(reading.dominant * np.array(result.intent.sizes))
        width = 0.8 / len(readings)
        right.bar(
            np.arange(plant.n) + (index - (len(readings) - 1) / 2) * width,
            100 * parts / np.sum(parts),
            width,
            color=_shade(index),
            edgecolor=INK,
            linewidth=0.4,
            hatch=("", "//", "..")[index % 3],
            label=reading.rule,
        )
    left.set_yscale("log")
    left.set_xlabel("eigenvalue of Q, largest first (-)")
    left.set_ylabel("cost weight at R = 1 (SI units)")
    right.set_xticks(np.arange(plant.n), plant.states, rotation=35, ha="right")
    right.set_ylabel("share in dominant cost (%)")
    right.legend(fontsize=5.5, loc="upper right")
    return figure


def _shade(index: int) -> str:
    return (VERMILLION, BLUE, GREEN, "#E69F00", "#CC79A7", "#BBBBBB")[index % 6]


def _methods(result: FitResult) -> Figure:
    """Ten seconds about the largest disagreement of inverse LQR, in the trial that has it."""
    plant = result.fitted.problem.plant
    shown = {item.name: item for item in result.methods if item.name in _METHOD_LINES and item.runs}
    index, first = _most_telling(result)
    trial = result.fitted.problem.recordings[index]
    window = slice(first, min(first + round(_WINDOW / plant.dt), trial.samples - 1))
    time = np.arange(window.start, window.stop) * plant.dt
    figure = new_figure(DOUBLE_COLUMN, 3.4)
    above, below = figure.subplots(2, 1, sharex=True)
    factor, _ = shown_unit(plant, plant.outputs[0])
    recorded = factor * trial.without_offset[window, 0]
    above.plot(time, recorded, color=_SOFT, linewidth=1.8, label="recorded")
    for name, method in shown.items():
        color, line = _METHOD_LINES[name]
        run = method.runs[index]
        output = factor * (run.x @ plant.C.T)[window, 0]
        above.plot(
            time, output, color=color, linestyle=line, linewidth=1.1, label=METHODS[name].label
        )
        below.plot(time, run.u[window, 0], color=color, linestyle=line, linewidth=1.0)
    for limit in (result.given.bounds.u_min[0], result.given.bounds.u_max[0]):
        if np.isfinite(limit):
            below.axhline(limit, color=INK, linewidth=0.8, linestyle=":")
    reach = 1.6 * float(np.nanmax(np.abs(recorded), initial=0.0)) or 1.0
    above.set_ylim(-reach, reach)
    above.set_ylabel(axis_label(plant, plant.outputs[0]))
    below.set_ylabel(axis_label(plant, plant.controls[0]))
    largest = max(float(np.max(np.abs(item.runs[index].u[window, 0]))) for item in shown.values())
    below.set_ylim(-1.1 * largest, 1.1 * largest)
    below.set_xlabel("time (s)")
    below.set_xlim(time[0], time[-1])
    above.legend(ncols=2, loc="lower left", bbox_to_anchor=(0, 1.02))
    above.set_title(trial_name(result, index), loc="right")
    return figure


def _most_telling(result: FitResult) -> tuple[int, int]:
    """Trial and first sample of the window in which clipped or plain LQR departs most."""
    plant, best = result.fitted.problem.plant, (0.0, 0, 0)
    window = round(_WINDOW / plant.dt)
    for method in result.methods:
        if method.name not in ("clipped_lqr", "inverse_lqr_output") or not method.runs:
            continue
        for index, run in enumerate(method.runs):
            own = result.inverse_mpc.runs[index].x @ plant.C.T
            apart = np.abs((run.x @ plant.C.T - own)[:, 0])
            stop = run.reached + 1
            sample = int(np.argmax(np.minimum(apart[:stop], 10 * np.std(own[:, 0]))))
            if apart[sample] > best[0]:
                first = max(0, min(sample - window // 2, len(own) - 1 - window))
                best = (float(apart[sample]), index, first)
    return best[1], best[2]
