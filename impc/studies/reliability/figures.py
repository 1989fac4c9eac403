"""Figures of a reliability study: counterparts of figures 2.3 to 2.6."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import scipy.signal

from impc.reporting.shown_units import shown_angle
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

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from impc.studies.reliability.analysis import Reliability, Trials

_LINES = ((BLUE, "-"), (VERMILLION, "--"), (GREEN, ":"), (INK, "-."))


def reliability_figures(trials: Trials, result: Reliability) -> dict[str, bytes]:
    """Draw all figures: PNG and PDF by file name."""
    subject, visit, condition = result.subjects[0], result.visits[0], result.conditions[0]
    with journal_style():
        figures = {
            "visits": _visits(result),
            "time-series": _time_series(trials),
            "spectra": _spectra(trials, result),
            "transfer-visits": _responses(
                result, {f"visit {one}": (subject, one, condition) for one in result.visits}
            ),
            "transfer-subjects": _responses(
                result, {f"subject {one}": (one, visit, condition) for one in result.subjects}
            ),
        }
        return drawn(figures)


def _visits(result: Reliability) -> Figure:
    """The root-mean-square score of every person, visit by visit, and the mean."""
    shown = [item for item in result.measures if item.measure == "rms"]
    factor, unit = shown_angle()
    columns = len(result.outputs)
    rows = -(-len(shown) // columns)
    figure = new_figure(DOUBLE_COLUMN, 0.3 + 1.7 * rows)
    axes = np.ravel(figure.subplots(rows, columns, squeeze=False, sharex=True))
    order = sorted(shown, key=lambda item: result.conditions.index(item.condition))
    across = np.arange(len(result.visits))
    for ax, item in zip(axes, order, strict=False):
        scores = factor * item.scores
        for person in scores:
            ax.plot(across, person, color=BLUE, linewidth=0.6, marker="o", markersize=2.5)
        ax.plot(across, pd.DataFrame(scores).mean(), color=INK, linewidth=2.0)
        ax.set_title(f"{item.output}, {item.condition}", loc="left")
        ax.set_ylabel(f"root-mean-square ({unit})")
        ax.set_xticks(across, result.visits)
        ax.set_xlim(-0.3, len(across) - 0.7)
    for ax in axes[-columns:]:
        ax.set_xlabel("visit (-)")
    return figure


def _time_series(trials: Trials) -> Figure:
    """Figure 2.3: input and outputs of one trial."""
    trial = next(iter(trials.cells.values()))[0]
    time = np.arange(trial.samples) / trials.rate
    rows = 1 + len(trials.outputs)
    figure = new_figure(DOUBLE_COLUMN, 1.2 * rows + 0.4)
    axes = figure.subplots(rows, 1, sharex=True)
    factor, unit = shown_angle()
    axes[0].step(time, trial.disturbance[:, 0], where="post", color=INK, linewidth=0.9)
    axes[0].set_ylabel("perturbation\n(N m)")
    for ax, name, values in zip(axes[1:], trials.outputs, trial.outputs.T, strict=True):
        ax.plot(time, factor * values, color=BLUE, linewidth=1.0)
        ax.set_ylabel(f"{name}\n({unit})")
    axes[-1].set_xlabel("time (s)")
    for place, ax in enumerate(axes):
        ax.set_title(f"({'ABCDEFG'[place]})", loc="left")
    return figure


def _spectra(trials: Trials, result: Reliability) -> Figure:
    """Figure 2.4: power of input and outputs of one trial, the passband shaded."""
    trial = next(iter(trials.cells.values()))[0]
    figure = new_figure(DOUBLE_COLUMN, 2.6)
    axes = figure.subplots(1, 1 + len(result.outputs))
    excited = result.band.excited
    factor, angle = shown_angle()
    signals = [("perturbation", trial.disturbance[:, 0], "N²m²/Hz")]
    for name, values in zip(result.outputs, trial.outputs.T, strict=True):
        signals.append((name, factor * values, f"{angle}²/Hz"))
    for ax, (name, values, unit) in zip(axes, signals, strict=True):
        frequency, power = scipy.signal.periodogram(values, trials.rate, detrend=False)
        inside = excited[excited < len(power)]
        ax.axvspan(result.band.low, result.band.high, color=FORBIDDEN, zorder=0)
        ax.loglog(
            frequency[inside], power[inside], color=BLUE, marker=".", markersize=2, linewidth=0.6
        )
        ax.set_xlabel("frequency (Hz)")
        ax.set_ylabel(f"{name} ({unit})")
    return figure


def _responses(result: Reliability, cells: dict[str, tuple[str, str, str]]) -> Figure:
    """Figures 2.5 and 2.6: amplitude and phase of the averaged estimates of four cells."""
    figure = new_figure(DOUBLE_COLUMN, 3.6)
    axes = figure.subplots(2, len(result.outputs), sharex=True, squeeze=False)
    factor, unit = shown_angle()
    for (color, line), (label, key) in zip(_LINES, cells.items(), strict=False):
        found = result.responses.get(key)
        if found is None:
            continue
        style: Any = {"color": color, "linestyle": line, "label": label}
        for (above, below), response in zip(axes.T, factor * found.response.T, strict=True):
            above.loglog(found.frequency, np.abs(response), **style)
            below.semilogx(found.frequency, np.degrees(np.unwrap(np.angle(response))), **style)
    for index, name in enumerate(result.outputs):
        axes[0, index].set_title(f"({'AB'[index % 2]}) {name}", loc="left")
        axes[1, index].set_xlabel("frequency (Hz)")
        axes[0, index].set_ylabel(f"amplitude ({unit}/(N m))")
        axes[1, index].set_ylabel("phase (deg)")
    axes[0, 0].legend(loc="lower left")
    return figure
