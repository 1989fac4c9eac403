"""Figures of the fit of an optimal control problem: trajectories, parameters, what is told.

See docs/nonlinear.md.
"""

from __future__ import annotations

import textwrap
from typing import TYPE_CHECKING

import numpy as np

from impc.assess.covariance import TWO_SIDED
from impc.nonlinear.result import MOST_TRIALS, limits_of
from impc.reporting.shown_units import shown_as
from impc.reporting.style import (
    BLUE,
    DOUBLE_COLUMN,
    FORBIDDEN,
    INK,
    SINGLE_COLUMN,
    VERMILLION,
    drawn,
    journal_style,
    new_figure,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from impc.nonlinear.result import OptimalFit

_SOFT = "#8C8C8C"
_ONE_COLUMN = 6  # signals above each other; more stand in two columns
# Factors beyond which an interval is drawn with an arrow.
_FURTHEST = 30.0
_LONGEST = 45  # characters of a legend


def optimal_figures(fit: OptimalFit) -> dict[str, bytes]:
    """Draw all figures: PNG and PDF by file name."""
    with journal_style():
        figures = {
            f"trajectories-{index + 1}": _trajectories(fit, index)
            for index in range(min(len(fit.trials), MOST_TRIALS))
        }
        if interval_rows(fit):
            figures["parameters"] = _parameters(fit)
        figures["singular-values"] = _singular_values(fit)
        return drawn(figures)


def _trajectories(fit: OptimalFit, index: int) -> Figure:
    estimate, names = fit.estimate, fit.names
    one, (x, u) = estimate.recordings[index], estimate.runs[index]
    limits = limits_of(estimate.problem, np.array(list(estimate.theta.values())))
    columns = 1 if len(names) <= _ONE_COLUMN else 2
    rows = -(-len(names) // columns)
    figure = new_figure(DOUBLE_COLUMN, 0.6 + 1.05 * rows)
    axes = figure.subplots(rows, columns, sharex=True, squeeze=False).T.ravel()
    step = 1.0 if fit.dt is None else fit.dt
    for k, name in enumerate(names):
        recorded, run = (one.x, x) if k < len(x[0]) else (one.u, u)
        column = k if k < len(x[0]) else k - len(x[0])
        factor, unit = shown_as(estimate.problem.signal_units.get(name, "-"))
        time, ax = step * np.arange(len(run)), axes[k]
        ax.plot(
            time, factor * recorded[:, column], color=_SOFT, marker="o", markersize=2.5,
            markerfacecolor="white", linewidth=1.2, label="recorded",
        )  # fmt: skip
        ax.plot(
            time, factor * run[:, column], color=VERMILLION, linestyle="--", linewidth=1.0,
            label="simulated",
        )  # fmt: skip
        _limits(ax, [factor * value for value in limits.get(name, [])])
        ax.set_ylabel(f"{name} ({unit})")
    for ax in axes[len(names) :]:
        ax.set_visible(False)
    for ax in (axes[rows - 1], axes[len(names) - 1]):
        ax.set_xlabel("sample (-)" if fit.dt is None else "time (s)")
        ax.tick_params(labelbottom=True)
    axes[0].legend(loc="lower left", ncols=2, bbox_to_anchor=(0, 1.0))
    axes[0].set_title(fit.trials[index], loc="right")
    return figure


def _limits(ax: Axes, values: list[float]) -> None:
    """A line at each limit that the curves come near; one far away would hide them."""
    low, high = ax.get_ylim()
    for value in values:
        if low - (high - low) <= value <= high + (high - low):
            ax.axhline(value, color=INK, linewidth=0.8, linestyle=":")


def interval_rows(fit: OptimalFit) -> list[tuple[str, float, float]]:
    """Name, and both ends of the interval over the value, of what may be drawn as a factor.

    Positive parameters that are told by themselves, and the told products of several.
    """
    found = []
    for one in fit.estimate.combinations.told:
        if not one.difference:
            factor = float(np.exp(np.minimum(TWO_SIDED * one.deviation, 100.0)))
            found.append((one.name, 1 / factor, factor))
    return found


def _parameters(fit: OptimalFit) -> Figure:
    rows = interval_rows(fit)
    figure = new_figure(SINGLE_COLUMN, 0.7 + 0.24 * len(rows))
    ax = figure.subplots()
    reach = min(max(1.01, *(high for _, _, high in rows)) ** 1.1, _FURTHEST)
    for place, (_, low, high) in enumerate(rows):
        ax.plot([max(low, 1 / reach), min(high, reach)], [place, place], color=BLUE, linewidth=1.6)
        ax.plot(1.0, place, color=BLUE, marker="o", markerfacecolor="white", linestyle="")
        for end, mark in ((low, "<"), (high, ">")):
            if not 1 / reach <= end <= reach:
                ax.plot(np.clip(end, 1 / reach, reach), place, color=BLUE, marker=mark)
    ax.axvline(1.0, color=INK, linewidth=0.6)
    ax.set_xscale("log")
    ax.set_xlim(1 / reach**1.05, reach**1.05)
    ticks = [1 / reach, 1.0, reach]
    ax.set_xticks(ticks, [f"{tick:.4g}" for tick in ticks])
    ax.minorticks_off()
    ax.set_yticks(range(len(rows)), [name for name, _, _ in rows])
    ax.set_ylim(len(rows) - 0.5, -0.5)
    ax.set_xlabel("95 % interval over the value (-)")
    ax.set_ylabel("told (-)")
    return figure


def _singular_values(fit: OptimalFit) -> Figure:
    found = fit.estimate.combinations
    values = np.maximum(found.singular_values / found.singular_values[0], 1e-17)
    figure = new_figure(SINGLE_COLUMN, 2.2)
    ax = figure.subplots()
    place, told = np.arange(1, len(values) + 1), len(found.told)
    ax.plot(place[:told], values[:told], color=BLUE, marker="o", linestyle="", label="told")
    if told < len(values):
        ax.axvspan(told + 0.5, len(values) + 0.5, color=FORBIDDEN, linewidth=0)
        names = "; ".join(" ".join(one.exponents) for one in found.untold)
        ax.plot(
            place[told:], values[told:], color=VERMILLION, marker="s", markerfacecolor="white",
            linestyle="", label=textwrap.shorten(f"not told: {names}", _LONGEST),
        )  # fmt: skip
    ax.set_yscale("log")
    ax.set_ylim(0.3 * float(values[-1]), 3.0)
    ax.set_xticks(place)
    ax.set_xlabel("direction of the parameters (-)")
    ax.set_ylabel("singular value / largest (-)")
    ax.legend(loc="lower left")
    return figure
