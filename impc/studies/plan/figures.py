"""Figures of a plan: how far each cost weight would be identified, and what the perturbation does.

See docs/planning.md.
"""

from __future__ import annotations

import functools
import itertools
import math
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from impc.assess.covariance import TWO_SIDED
from impc.reporting.style import BLUE, DOUBLE_COLUMN, GREEN, INK, VERMILLION, new_figure

if TYPE_CHECKING:
    from collections.abc import Callable

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from impc.studies.plan.designs import Outcome
    from impc.studies.plan.study import Plan

_LINES = ((BLUE, "o", "-"), (VERMILLION, "s", "--"), (GREEN, "^", ":"), (INK, "D", "-."))
# Beyond this factor a cost weight is not identified, whatever its interval.
_LARGEST = 100.0
_COLUMNS = 3


def cost_weights_figure(plan: Plan) -> Figure:
    """Half an interval of 95 % of each cost weight, as a factor, over the amplitude."""
    names = plan.person.structure.unknowns
    rows = math.ceil(len(names) / _COLUMNS)
    figure = new_figure(DOUBLE_COLUMN, 0.5 + 2.0 * rows)
    axes = np.atleast_1d(figure.subplots(rows, min(_COLUMNS, len(names)), sharex=True)).ravel()
    for index, (ax, name) in enumerate(zip(axes, names, strict=False)):
        _lines(ax, plan, functools.partial(_factor, index))
        ax.set_yscale("log")
        ax.set_ylabel(f"cost weight of {name} (-)")
        ax.grid(visible=True, which="both", axis="y", linewidth=0.4, alpha=0.5)
        ax.yaxis.set_major_formatter("{x:g}")
        ax.yaxis.set_minor_formatter("{x:g}")
        ax.tick_params(axis="y", which="minor", labelsize=6)
    for ax in axes[len(names) :]:
        ax.set_visible(False)
    if len(plan.outcomes) > len(plan.settings.amplitude):
        axes[0].legend()
    return figure


def experiments_figure(plan: Plan) -> Figure:
    """Share of the time at the limit, and of the trials that end in a fall."""
    figure = new_figure(DOUBLE_COLUMN, 2.4)
    at_limit, falls = figure.subplots(1, 2, sharex=True)
    _lines(at_limit, plan, lambda item: 100 * item.at_limit)
    _lines(falls, plan, lambda item: 100 * item.falls)
    at_limit.set_ylabel("time at the limit (%)")
    falls.set_ylabel("trials that end in a fall (%)")
    falls.axhline(plan.settings.falls, color=INK, linewidth=0.8, linestyle=":")
    for ax in (at_limit, falls):
        ax.set_ylim(bottom=-1)
    if len(plan.outcomes) > len(plan.settings.amplitude):
        at_limit.legend()
    return figure


def _factor(index: int, item: Outcome) -> float:
    if item.expected is None:
        return math.nan
    half = TWO_SIDED * float(item.expected.deviations[index])
    return math.exp(half) if half < math.log(_LARGEST) else math.nan


def _lines(ax: Axes, plan: Plan, value: Callable[[Outcome], float]) -> None:
    """One line a dwell; a ring about the best experiment."""
    points = pd.DataFrame(
        [(item.design.dwell, item.design.amplitude, value(item)) for item in plan.outcomes]
    )
    by_dwell = points.groupby(0, dropna=False)  # NaN where it is as recorded
    for (dwell, mine), style in zip(by_dwell, itertools.cycle(_LINES), strict=False):
        label = "as recorded" if plan.settings.files else f"held for {dwell:g} s"
        color, marker, line = style
        ax.plot(mine[1], mine[2], color=color, marker=marker, linestyle=line, label=label)
    ring: Any = {"marker": "o", "markersize": 11, "color": INK, "fillstyle": "none"}
    ax.plot(plan.best.design.amplitude, value(plan.best), **ring)
    plant = plan.person.controller.plant
    amplitude = f"amplitude ({plant.unit(plant.disturbances[0])})"
    ax.set_xlabel("factor (-)" if plan.settings.files else amplitude)
    ax.margins(x=0.08)
