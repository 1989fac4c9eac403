"""What a fit is sure of, as bars: the gain with its intervals, statements with their ranges.

Drawn narrow, so that their words can be read on a phone.
"""

from __future__ import annotations

from textwrap import fill
from typing import TYPE_CHECKING

import numpy as np

from impc.assess.printed_gain import entry_names
from impc.model.plant import UNKNOWN
from impc.reporting.style import BLUE, INK, VERMILLION, new_figure
from impc.studies.fit.gain_findings import number_name

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from impc.arrays import Array
    from impc.assess.intent_statements import Statement
    from impc.studies.fit.result import FitResult

_WIDTH = 4.2  # inches: 8 points are 9 pixels at the width of a phone
_SOFT = "#8C8C8C"
# Beside what the recordings identify; intervals of what they do not identify have no size.
_MARGIN = 0.15
_LETTERS = 62  # of a line of the figure's width
_MOST = 12


def gain_figure(result: FitResult) -> Figure:
    """Each entry of the gain as the command that it gives at a typical state, with its interval."""
    plant = result.fitted.problem.plant
    sizes = np.tile(np.array(result.intent.sizes), plant.m)
    first = result.preferred
    names = [name for name in entry_names(plant) if name in first]
    scale = dict(zip(entry_names(plant), sizes, strict=True))
    ends = np.array(
        [[scale[name] * end for end in (first[name].low, first[name].high)] for name in names]
    )
    identified = np.array([first[name].identified for name in names])
    low, high = _view(ends[identified] if np.any(identified) else ends)
    figure = new_figure(_WIDTH, 0.9 + 0.28 * len(names))
    ax = figure.subplots()
    for row, name in enumerate(names):
        colour = BLUE if identified[row] else _SOFT
        _bar(ax, row, ends[row], (low, high), colour)
        value = first[name].value
        if value is not None and low <= scale[name] * value <= high:
            ax.plot(
                scale[name] * value,
                row,
                "o",
                markersize=3.5,
                color=VERMILLION if identified[row] else _SOFT,
                markerfacecolor=VERMILLION if identified[row] else "white",
            )
    ax.axvline(0, color=INK, linewidth=0.7)
    ax.set_yticks(
        range(len(names)), [number_name(plant, name).removeprefix("gain of ") for name in names]
    )
    ax.set_ylim(len(names) - 0.5, -0.5)
    ax.set_xlim(low, high)
    units = {plant.unit(name) for name in plant.controls}
    ax.set_xlabel(f"command at a typical state ({units.pop() if len(units) == 1 else UNKNOWN})")
    ax.set_ylabel("state (-)")
    return figure


def shown_statements(result: FitResult) -> list[Statement]:
    """Statements that have a bar: those that may be made first, then those of the fitted gain."""
    summary = result.uncertainty.weights
    if summary is None:
        return []
    order = sorted(summary.statements, key=lambda item: (not item.made, item.holds is None))
    return order[:_MOST]


def statements_figure(result: FitResult) -> Figure:
    """The range of each statement's difference of weights over all weights; its sign decides."""
    shown = shown_statements(result)
    figure = new_figure(_WIDTH, 0.8 + 0.46 * len(shown))
    ax = figure.subplots()
    ends = np.array([[item.low, item.high] for item in shown])
    reach = 1.5 * float(np.max(np.abs(ends[np.isfinite(ends)]), initial=1.0))
    for row, item in enumerate(shown):
        colour = _SOFT if not item.made else BLUE if item.holds else VERMILLION
        _bar(ax, row, ends[row], (-reach, reach), colour)
        word = "" if not item.made else "true: " if item.holds else "false: "
        text = ax.text(
            0.0,
            row - 0.2,
            fill(word + item.says, _LETTERS),
            transform=ax.get_yaxis_transform(),
            fontsize=7,
            linespacing=1.0,
            va="bottom",
            fontweight="bold" if item.made else "normal",
            bbox={"facecolor": "white", "edgecolor": "none", "boxstyle": "square,pad=0.1"},
        )
        text.set_in_layout(False)
    ax.axvline(0, color=INK, linewidth=0.7, zorder=0)
    ax.set_xscale("symlog", linthresh=1.0)
    ax.set_xlim(-reach, reach)
    ax.spines["left"].set_visible(False)
    ax.set_yticks([])
    ax.set_ylim(len(shown) - 0.5, -0.9)
    ax.set_xlabel("difference over the cost weight of the state named first (-)")
    return figure


def _view(ends: Array) -> tuple[float, float]:
    """From where to where the axis goes: all ends and zero, and a margin."""
    finite = ends[np.isfinite(ends)]
    low, high = float(np.min(finite, initial=0.0)), float(np.max(finite, initial=0.0))
    margin = _MARGIN * (high - low) or 1.0
    return low - margin, high + margin


def _bar(ax: Axes, row: int, ends: Array, view: tuple[float, float], colour: str) -> None:
    """A bar between two ends; an arrow where it goes on beyond the view."""
    low, high = np.clip(ends, *view)
    ax.plot([low, high], [row, row], color=colour, linewidth=5.0, solid_capstyle="butt")
    for end, at, mark in ((ends[0], low, "<"), (ends[1], high, ">")):
        if end != at:
            ax.plot(at, row, mark, color=colour, markersize=6, clip_on=False)
