"""Figures of a cohort: measures by group, and a subject's fit."""

from __future__ import annotations

import textwrap
from typing import TYPE_CHECKING, Any

import numpy as np

from impc.model.plant import UNKNOWN
from impc.reporting.style import DOUBLE_COLUMN, INK, STATE_MARKS, VERMILLION, new_figure
from impc.studies.cohort.comparison import measure_words

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_COLUMNS = 3
_SOFT = "#8C8C8C"


def group_figure(units: pd.DataFrame, measures: Sequence[str], names: Mapping[str, str]) -> Figure:
    """Every unit by group and visit; a line joins the visits of one subject; bars are means."""
    groups = sorted(set(units["group"])) or [""]
    visits = list(dict.fromkeys(units["visit"]))
    rows = -(-len(measures) // _COLUMNS)
    figure = new_figure(DOUBLE_COLUMN, 2.2 * rows)
    axes = np.ravel(figure.subplots(rows, _COLUMNS, squeeze=False))
    for ax in axes[len(measures) :]:
        ax.set_visible(False)
    reach = 0.3 if len(visits) > 1 else 0.0
    offsets = dict(zip(visits, np.linspace(-reach, reach, len(visits)), strict=True))
    for ax, name in zip(axes, measures, strict=False):
        for place, group in enumerate(groups):
            own = units[units["group"] == group]
            _people(ax, own, name, place, offsets)
            half = 0.35 if len(visits) == 1 else 0.5 * reach / (len(visits) - 1)
            for visit, offset in offsets.items():
                values = own.loc[own["visit"] == visit, name].to_numpy(dtype=float)
                if np.any(np.isfinite(values)):
                    at, mean = place + offset, np.nanmean(values)
                    ax.hlines(mean, at - half, at + half, color=INK, linewidth=1.5)
        ax.set_xticks(range(len(groups)), [group or "all" for group in groups])
        ax.set_xlim(-0.6, len(groups) - 0.4)
        ax.set_title(textwrap.fill(measure_words(name), 28), loc="left")
        percent = name.startswith(("vaf.", "held_out_vaf."))
        unit = "-" if name.startswith("log_cost_weight.") else names.get(name, UNKNOWN)
        ax.set_ylabel(f"value ({'%' if percent else unit})")
    return figure


def _people(ax: Axes, own: pd.DataFrame, name: str, place: int, offsets: dict[str, float]) -> None:
    """One group's units: a mark each, a line for each person who came more than once."""
    mark = STATE_MARKS[place % len(STATE_MARKS)]
    people = [part for _, part in own.groupby(["subject", "condition"], sort=False)]
    # Side by side, in the order of the table: no two points hide each other.
    wide = 0.25 if len(offsets) == 1 else 0.04
    apart = np.linspace(-wide, wide, len(people)) if len(people) > 1 else [0.0]
    for shift, part in zip(apart, people, strict=True):
        ax.plot(
            [place + shift + offsets[visit] for visit in part["visit"]],
            part[name].to_numpy(dtype=float),
            linewidth=0.5,
            marker=mark.marker,
            color=mark.color,
            markerfacecolor="white",
            markersize=3.0,
        )


def subject_figure(fit: dict[str, Any]) -> Figure:
    """Recorded and simulated outputs of a unit's first trial, from the content of its `fit`."""
    shown = fit["trajectory"]
    recorded, simulated = np.array(shown["recorded"]), np.array(shown["simulated"])
    figure = new_figure(DOUBLE_COLUMN, 1.3 * recorded.shape[1] + 0.5)
    axes = np.ravel(figure.subplots(recorded.shape[1], 1, sharex=True, squeeze=False))
    time = np.arange(len(recorded)) * shown["dt"]
    dashed: Any = {"color": VERMILLION, "linestyle": "--", "linewidth": 1.0}
    for index, ax in enumerate(axes):
        factor, unit = fit["shown_units"][index]
        ax.plot(time, factor * recorded[:, index], color=_SOFT, linewidth=1.6, label="recorded")
        ax.plot(time, factor * simulated[:, index], label="simulated", **dashed)
        ax.set_ylabel(f"{fit['outputs'][index]} ({unit})")
    axes[-1].set_xlabel("time (s)")
    axes[0].legend(loc="upper right", ncols=2, bbox_to_anchor=(1.0, 1.3))
    return figure
