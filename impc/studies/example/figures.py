"""Figure of the example: the recording of a case and three methods."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from impc.reporting.style import (
    BLUE,
    FORBIDDEN,
    MUTED,
    PHONE,
    RECORDED,
    RULE,
    VERMILLION,
    new_figure,
)
from impc.studies.example.cases import BOUND
from impc.studies.methods_table import method_label

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from impc.control.simulation import Simulation
    from impc.studies.example.cases import CaseResult

#: Methods that are drawn.
DRAWN = ("inverse_mpc", "feedback_gain", "inverse_lqr_output")
_SLACK = 1e-6  # Relative excess above which the limit counts as exceeded


def comparison_figure(case: CaseResult, width: float, narrow: bool) -> Figure:
    """States and command of three methods side by side; on a phone only the command."""
    runs = [case.method(name).simulation for name in DRAWN]
    found = [run for run in runs if run is not None]  # all three: only the LMI can be infeasible
    if narrow:
        figure = new_figure(PHONE, 5.4)
        titles = below = figure.subplots(len(found), 1, sharex=True, sharey=True)
    else:
        figure = new_figure(width, 3.9)
        titles, below = figure.subplots(2, len(found), sharex=True, sharey="row")
        titles[0].set_ylabel("States (-)")
        for ax, run in zip(titles, found, strict=True):
            ax.plot(case.truth.x, color=RECORDED, linewidth=4.5)
            ax.plot(run.x, color=BLUE)
            ax.axhline(0, color=RULE, linewidth=0.8, zorder=0)
            ax.margins(x=0, y=0.16)
            for place, value in enumerate(case.truth.x[0]):
                ax.annotate(f"state {place + 1}", (0, value), (5, 5), textcoords="offset points",
                            color=MUTED, fontsize=9)  # fmt: skip
    largest = 1.3 * max(1.3 * BOUND, *(float(np.max(np.abs(run.u))) for run in found))
    for ax, title, name, run in zip(below, titles, DRAWN, found, strict=True):
        _command(ax, case, run, largest)
        title.set_title(method_label(name).split(" to ")[0])
        ax.set_xlabel("" if narrow and ax is not below[-1] else "Sample (count)")
    below[int(narrow)].set_ylabel("Command (-)")
    return figure


def _command(ax: Axes, case: CaseResult, run: Simulation, largest: float) -> None:
    edges = np.arange(len(run.u) + 1)
    ax.stairs(case.truth.u[:, 0], edges, baseline=None, color=RECORDED, linewidth=4.5)
    ax.stairs(run.u[:, 0], edges, baseline=None, color=BLUE, linewidth=1.4)
    beyond = np.abs(run.u[:, 0]) > (1 + _SLACK) * BOUND
    ax.hlines(run.u[beyond, 0], edges[:-1][beyond], edges[1:][beyond], color=VERMILLION, lw=3)
    for side in (-1, 1):
        ax.axhspan(side * BOUND, side * largest, color=FORBIDDEN, linewidth=0, zorder=0)
        ax.axhline(side * BOUND, color=VERMILLION, linewidth=1, linestyle="--")
    ax.set_ylim(-largest, largest)
    ax.margins(x=0)
    ax.text(len(run.u), 1.04 * BOUND, "beyond the limit", ha="right", va="bottom",
            color=VERMILLION, fontsize=9)  # fmt: skip
