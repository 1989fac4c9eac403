"""Figures of a cohort: forest plot of all people, and a subject's first trial."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from impc.arrays import Array
from impc.reporting import style
from impc.reporting.rendering import number, sentence_case
from impc.studies.cohort.comparison import mean_of
from impc.studies.cohort.results import Cohort
from impc.studies.cohort.unit_result import LOGARITHM
from impc.studies.fit.facts import between

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_NAMED = 45  # Largest number of rows with names of subjects


def forest(cohort: Cohort) -> Figure:
    """Forest plot: one row per unit with its interval, and the mean of each group or visit."""
    lead, units = cohort.lead, cohort.units.join(cohort.ends).assign(far=cohort.far)
    label = lead.question if lead is not None and lead.question in units else "group"
    if lead is not None and label != "condition":
        units = units[units["condition"] == lead.condition]
    blocks = units.sort_values("value", ascending=False).groupby(label)
    rows = len(units) + len(blocks)
    figure = style.new_figure(style.HALF, float(np.clip(0.9 + 0.16 * rows, 2.6, 6.4)))
    ax, at = figure.subplots(), 0.0
    if cohort.measure.startswith(LOGARITHM):
        ax.set_xscale("log")
    # The axis shows all values that are determined.
    seen = units["value"][units["determined"]] if units["determined"].sum() > 2 else units["value"]
    low, high = ax.xaxis.get_transform().transform([seen.min(), seen.max()])
    pad = 0.6 * (high - low) or 1.0  # wider intervals are cut off
    ax.set_xlim(*ax.xaxis.get_transform().inverted().transform([low - pad, high + pad]))
    if ax.get_xscale() == "log":
        style.plain_log(ax.xaxis)
    across: Any = {"transform": ax.get_yaxis_transform(), "va": "center"}
    small = {"fontsize": 9} | across
    for block, part in blocks:
        title = f"{label.capitalize()} {block!s}" if block else "All people"
        ax.text(0, at, title, weight="bold", **across)
        mean = mean_of(part.loc[part.index.isin(cohort.usable.index)], cohort.measure)
        if not mean.lacks:
            _mean(ax, cohort.shown(cohort.measure, mean.ends), at, len(part), across)
        for row in part.to_dict("records"):
            at -= 1
            if rows <= _NAMED:
                ax.text(-0.015, at, row["subject"], ha="right", color=style.MUTED, **small)
            ax.plot([row["low"], row["high"]], [at, at], color=style.BLUE, linewidth=1.3)
            known, far = row["determined"], np.isfinite(row["far"])
            colour = style.VERMILLION if far else style.BLUE if known else style.MUTED
            ax.plot(np.clip(row["value"], *ax.get_xlim()), at, "s" if far else "o", color=colour,
                    markersize=4.5, markerfacecolor=colour if known else "none")  # fmt: skip
        at -= 1.6
    ax.set_ylim(at + 0.8, 0.9)
    ax.set_yticks([])
    ax.spines["left"].set_visible(False)
    shown = cohort.of(cohort.measure)
    ax.set_xlabel(f"{sentence_case(shown['name'])} ({shown['unit']})", loc="left")
    ax.xaxis.set_label_position("top")
    return figure


def _mean(ax: Axes, ends: Array, at: float, rows: int, across: Any) -> None:
    """Draw the mean over people with its interval behind their rows."""
    low, value, high = ends
    height = [at - rows - 0.3, at - 0.5]
    ax.fill_betweenx(height, low, high, color=style.RULE, linewidth=0, zorder=0)
    ax.plot([value, value], height, color=style.INK, linewidth=1.2, zorder=1)
    ax.text(1, at, f"mean {number(value)} ({between(low, high)})", ha="right", **across)


def subject_figure(fit: Mapping[str, Any]) -> Figure:
    """Recorded and modelled outputs of a unit's first trial, from its stored `fit`."""
    run = fit["trajectory"]
    signals = [(one["label"], one["recorded"], one["simulated"]) for one in run["signals"]]
    return style.panels(signals, run["dt"], "Time (s)")
