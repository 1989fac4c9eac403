"""Figures of a fit."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from impc.assess.assessments import MethodFit
from impc.assess.frequency_response import FrequencyResponse
from impc.assess.variance_accounted_for import at_limit
from impc.model.bounds import Bounds
from impc.reporting import style
from impc.reporting.rendering import sentence_case
from impc.reporting.shown_units import axis_label, shown_unit, signal_name
from impc.studies.fit.result import FitResult

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_WINDOW = 10.0  # s
_LAGS = 1.0  # Largest lag of the autocorrelation, s
# Largest number of signals of each kind; the interactive part shows all.
_MOST = 3
_MOST_STATEMENTS = 12
# Share of the axis below which a range is drawn as a mark.
_POINT = 0.01


def movement_figure(fit: MethodFit, index: int) -> Figure:
    """Part of a trial: recorded and modelled outputs, and commands with their limits."""
    plant, trial = fit.estimate.problem.plant, fit.estimate.problem.recordings[index]
    run, bounds = fit.runs[index], _bounds(fit)
    window = shown_window(fit, index)
    outputs, controls = plant.outputs[:_MOST], plant.controls[:_MOST]
    rows = len(outputs) + len(controls)
    figure = style.new_figure(style.HALF, 0.6 + 1.35 * rows)
    axes = np.atleast_1d(figure.subplots(rows, 1, sharex=True))
    time = np.arange(window.start, window.stop) * plant.dt
    modelled = run.x @ plant.C.T
    for column, (ax, name) in enumerate(zip(axes, outputs, strict=False)):
        factor, _ = shown_unit(plant, name)
        recorded = factor * trial.corrected[window, column]
        style.strip(ax, axis_label(plant, name))
        ax.plot(time, recorded, color=style.RECORDED, linewidth=4.5, label="recorded")
        ax.plot(time, factor * modelled[window, column], color=style.BLUE, label="model")
        if name in trial.signals:
            target = factor * trial.target[window, trial.signals.index(name)]
            ax.plot(time, target, color=style.INK, linewidth=0.8, linestyle="--", label="target")
        reach = 1.18 * float(np.nanmax(np.abs(recorded), initial=1e-9))
        ax.set_ylim(-reach, reach)
    for column, (ax, name) in enumerate(zip(axes[len(outputs) :], controls, strict=True)):
        _command(ax, fit, index, column, window)
        ax.set_title(f"{axis_label(plant, name).replace(' (', ' in the model (')}", pad=5)
    if np.any(np.isfinite(bounds.u_max)):
        axes[0].plot([], [], color=style.VERMILLION, linewidth=4.5, label="at the limit")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper right", ncols=4, columnspacing=1.2)
    axes[-1].set_xlabel("Time (s)")
    axes[-1].set_xlim(time[0], time[-1])
    return figure


def _bounds(fit: MethodFit) -> Bounds:
    """The bounds that the method uses; those of the subject if it ignores them."""
    own = fit.estimate.problem.bounds
    return own if np.any(np.isfinite([own.u_min, own.u_max])) else fit.bounds


def _command(ax: Axes, fit: MethodFit, index: int, column: int, window: slice) -> None:
    """Plot the modelled command, its limit, and the samples at the limit or beyond."""
    plant, bounds = fit.estimate.problem.plant, _bounds(fit)
    factor, _ = shown_unit(plant, plant.controls[column])
    u = factor * fit.runs[index].u[window, column]
    time = (window.start + np.arange(len(u))) * plant.dt
    low, high = factor * bounds.u_min[column], factor * bounds.u_max[column]
    top = 1.15 * float(np.max(np.abs(u), initial=1e-9))
    if np.isfinite(high):
        top = max(top, 1.6 * abs(high))
        ax.axhspan(high, top, color=style.FORBIDDEN, linewidth=0)
        ax.text(time[-1], high + 0.1 * (top - high), "beyond the limit", color=style.VERMILLION,
                fontsize=10, ha="right", va="bottom")  # fmt: skip
    if np.isfinite(low):
        ax.axhspan(-top, low, color=style.FORBIDDEN, linewidth=0)
    recorded = fit.estimate.problem.recordings[index].commands
    if len(recorded):
        ax.plot(
            time, factor * recorded[window, column][: len(u)], color=style.RECORDED, linewidth=4.5
        )
    ax.plot(time, u, color=style.BLUE, linewidth=1.3)
    for limit, side in ((low, -1), (high, 1)):
        if np.isfinite(limit):
            ax.axhline(limit, color=style.VERMILLION, linewidth=0.9, linestyle=(0, (4, 3)))
            at = np.where(side * (u - limit) >= -1e-4 * abs(limit), u, np.nan)
            # The marker shows a single sample, of which a line has nothing to draw.
            ax.plot(time, at, "s", ls="-", color=style.VERMILLION, linewidth=4.5, markersize=4.5,
                    markeredgewidth=0, solid_capstyle="butt")  # fmt: skip
    ax.set_ylim(-top, top)


def shown_window(fit: MethodFit, index: int) -> slice:
    """Samples of a trial to draw: the window with most samples at the limit."""
    problem = fit.estimate.problem
    run, samples = fit.runs[index], problem.recordings[index].samples
    length = min(round(_WINDOW / problem.plant.dt), samples)
    at = at_limit(run.u, problem.bounds.u_min, problem.bounds.u_max)
    counts = np.convolve(at.astype(float), np.ones(length), "valid")
    first = min(int(np.argmax(counts)), samples - length) if len(counts) else 0
    return slice(max(first, 0), max(first, 0) + length)


def residual_figure(fit: MethodFit) -> Figure:
    """Residuals of the first output in each trial, and their autocorrelation."""
    plant, trials = fit.estimate.problem.plant, fit.estimate.problem.recordings
    factor, unit = shown_unit(plant, plant.outputs[0])
    series = [
        factor * (trial.corrected - run.x @ plant.C.T)[:, 0]
        for trial, run in zip(trials, fit.runs, strict=True)
    ][:_MOST]
    figure = style.new_figure(style.HALF, 3.5)
    above, below = figure.subplots(2, 1)
    name = signal_name(plant, plant.outputs[0])
    style.strip(above, f"{sentence_case(name)}, recorded minus model ({unit})")
    style.strip(below, "Autocorrelation (no unit)")
    lags = min(round(_LAGS / plant.dt), min(map(len, series)) // 4)
    for k, part in enumerate(series):
        colour, width = (style.BLUE, 1.2) if k == 0 else (style.MUTED, 0.7)
        stride = -(-len(part) // 700)
        time = np.arange(0, len(part), stride) * plant.dt
        above.plot(time, part[::stride], color=colour, linewidth=0.6, zorder=3 - k)
        centred = np.nan_to_num(part - np.nanmean(part))
        power = float(centred @ centred) or 1.0
        values = [float(centred[j:] @ centred[: len(centred) - j]) / power for j in range(lags)]
        below.plot(np.arange(lags) * plant.dt, values, color=colour, linewidth=width, zorder=3 - k)
    band = 1.96 / np.sqrt(len(series[0]))
    below.axhspan(-band, band, color=style.RULE, linewidth=0, zorder=0)
    above.set_xlabel("Time (s)")
    below.set_xlabel("Lag (s)")
    return figure


def frequency_figure(result: FitResult, found: FrequencyResponse) -> Figure:
    """Magnitude, phase and coherence: recorded as points, modelled as lines."""
    plant = result.given.plant
    outputs = plant.outputs[:2]
    figure = style.new_figure(style.WIDE, 5.4)
    axes = figure.subplots(3, len(outputs), sharex=True, squeeze=False, height_ratios=[2, 2, 1.2])
    drive, _ = shown_unit(plant, found.signal)
    for column, name in enumerate(outputs):
        magnitude, phase, coherence = axes[:, column]
        factor, unit = shown_unit(plant, name)
        per = shown_unit(plant, found.signal)[1]
        known = found.coherence[:, column] > found.threshold
        f, scale = found.frequencies, factor / drive
        recorded, errors = scale * found.recorded[:, column], found.errors[:, column]
        for ax, values, spread, model in (
            (magnitude, recorded, recorded * errors, scale * found.modelled[:, column]),
            (phase, found.recorded_phase[:, column], np.degrees(errors),
             found.modelled_phase[:, column]),
        ):  # fmt: skip
            turn = 360 * np.round(np.median((values - model)[known] if any(known) else 0) / 360)
            points = values - (turn if ax is phase else 0)
            ax.errorbar(f[known], points[known], 1.96 * spread[known], fmt="o", color=style.MUTED,
                        markersize=4, linewidth=0.9, label="recorded")  # fmt: skip
            ax.plot(f, model, color=style.BLUE, linewidth=1.6, label="model")
        coherence.plot(f, found.coherence[:, column], color=style.MUTED)
        coherence.plot(f, found.threshold, color=style.RULE, linestyle="--")
        coherence.set_ylim(0, 1.05)
        magnitude.set_yscale("log")
        words = signal_name(plant, name)
        unit = "no unit" if unit == per else f"{unit} per {per}"
        magnitude.set_title(f"{sentence_case(words)}, magnitude ({unit})")
        phase.set_title("Phase (°)")
        coherence.set_title("Coherence (no unit)")
        coherence.set_xscale("log")
        style.plain_log(magnitude.yaxis, coherence.xaxis)
        coherence.set_xlabel("Frequency (Hz)")
    axes[0, 0].legend()
    return figure


def statements_figure(result: FitResult) -> Figure:
    """Range of each difference in cost over all weights with the fitted gain."""
    plant = result.given.plant
    shown = sorted(result.compared, key=lambda item: not item.made)[:_MOST_STATEMENTS]
    figure = style.new_figure(style.WIDE, 1.4 + 0.3 * len(shown))
    ax = figure.subplots()
    ends = np.array([[item.low, item.high] for item in shown])
    reach = 1.5 * float(np.max(np.abs(ends[np.isfinite(ends)]), initial=1.0))
    labels = []
    for row, item in enumerate(shown):
        one, other = signal_name(plant, item.first), signal_name(plant, item.second)
        same = "" if item.kind == "order" else ": same vs opposite side"
        label = f"{one} {'+' if same else 'vs'} {other}{same}"
        labels.append(sentence_case(label))
        low, high = np.clip(ends[row], -reach, reach)
        colour, width = (style.BLUE, 7) if item.made else (style.RECORDED, 5)
        ax.plot([low, high], [row, row], color=colour, linewidth=width, solid_capstyle="butt",
                marker="|" if high - low < _POINT * reach else "", markersize=12,
                markeredgewidth=3)  # fmt: skip
    ax.axvline(0, color=style.INK, linewidth=1)
    ax.set_xscale("symlog", linthresh=1.0, linscale=0.8)
    ax.set_xlim(-reach, reach)
    most = int(np.log10(reach))
    powers = [10.0**k for k in range(0, most + 1, max(1, -(-most // 4)))]
    ticks = [*(-one for one in powers[::-1]), 0.0, *powers]
    ax.set_xticks(ticks, [f"{one:g}".replace("-", "\u2212") for one in ticks])
    ax.xaxis.minorticks_off()
    ax.set_yticks(range(len(shown)), labels)
    ax.tick_params(axis="y", length=0, labelcolor=style.INK)
    ax.set_ylim(len(shown) - 0.4, -0.7)
    ax.spines["left"].set_visible(False)
    words = "first costs less  \u2190   \u2192  more"
    ax.text(0, 1.01, words, transform=ax.get_xaxis_transform(), ha="center", color=style.MUTED)
    ax.set_xlabel("How much more the first costs (in multiples of its own cost)")
    return figure
