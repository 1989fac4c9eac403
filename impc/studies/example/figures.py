"""Counterparts of figures 3.2, 3.3 and 3.4, and the terminal set with the trajectories in it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from impc.reporting.style import (
    BLUE,
    DOUBLE_COLUMN,
    FORBIDDEN,
    GREEN,
    INK,
    SET_FILL,
    SINGLE_COLUMN,
    STATE_MARKS,
    VERMILLION,
    Mark,
    drawn,
    journal_style,
    new_figure,
)
from impc.studies.example.cases import BOUND

if TYPE_CHECKING:
    from collections.abc import Iterable

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from impc.control.simulation import Simulation
    from impc.studies.example.cases import CaseResult

#: Figure of the dissertation, the method it shows, and that method in words.
FIGURES = (
    ("3.2", "feedback_gain", "feedback gain"),
    ("3.3", "inverse_mpc", "inverse MPC"),
    ("3.4", "inverse_lqr_output", "inverse LQR on outputs"),
)
_CONTROL = Mark(GREEN, "D", "-")
_PATHS = (Mark(BLUE, "", "--"), Mark(INK, "", "-"), Mark(VERMILLION, "", "-."))


def example_figures(case: CaseResult) -> dict[str, bytes]:
    """Draw all figures of a case."""
    with journal_style():
        figures = {f"figure-{number}": _fit(case, method) for number, method, _ in FIGURES}
        figures |= {"terminal-set": _terminal_set(case), "comparison": _comparison(case)}
        named = {f"{name}-case-{case.name}": figure for name, figure in figures.items()}
        return drawn(named, mathematics=True)


def _fit(case: CaseResult, method: str) -> Figure:
    """One method against the recording: (A) states above (B) control."""
    figure = new_figure(SINGLE_COLUMN, 4.0)
    pair = figure.subplots(2, 1, sharex=True, height_ratios=[1.25, 1])
    _draw(pair, case, method)
    for axes, letter in zip(pair, "AB", strict=True):
        axes.set_title(f"({letter})", loc="left", fontweight="bold")
        axes.legend(loc="upper right", ncols=2, columnspacing=1.2)
    return figure


def _comparison(case: CaseResult) -> Figure:
    """The three methods of figures 3.2 to 3.4 side by side, for a first page."""
    figure = new_figure(DOUBLE_COLUMN, 3.5)
    grid = figure.subplots(2, len(FIGURES), sharex=True, sharey="row", height_ratios=[1.25, 1])
    for pair, (_, method, label) in zip(grid.T, FIGURES, strict=True):
        _draw(pair, case, method)
        pair[0].set_title(label[0].upper() + label[1:])
        for axes in pair:
            axes.label_outer()
    grid[0, -1].legend(loc="upper right", handlelength=2.0)
    grid[1, -1].legend(loc="center", bbox_to_anchor=(0.5, 0.31), ncols=2, handlelength=2.0)
    return figure


def _terminal_set(case: CaseResult) -> Figure:
    """The plane of the two states: the set in which the gain alone keeps the bound for ever."""
    figure = new_figure(SINGLE_COLUMN, 3.3)
    axes = figure.subplots()
    terminal = case.controller.terminal
    assert terminal is not None  # `run_case` makes its controller with one
    corners = terminal.vertices()
    axes.fill(*corners.T, facecolor=SET_FILL, edgecolor=INK, linewidth=0.9, label="terminal set")
    axes.plot(*case.truth.x.T, "o", color=INK, mfc="white", ms=4.5, label="recorded", zorder=4)
    for (_, name, label), mark in zip(FIGURES, _PATHS, strict=True):
        axes.plot(*_run(case, name).x.T, mark.line, color=mark.color, label=label, zorder=3)
    axes.annotate(
        "start", (case.x0[0], case.x0[1]), xytext=(6, 2), textcoords="offset points", va="bottom"
    )
    axes.set_xlabel("state $x_1$ (-)")
    axes.set_ylabel("state $x_2$ (-)")
    axes.margins(0.08)
    figure.legend(loc="outside upper center", ncols=2, columnspacing=1.2)
    return figure


def _draw(pair: Iterable[Axes], case: CaseResult, method: str) -> None:
    """States above the control: lines of the `method`, open markers of the recording."""
    above, below = pair
    run, truth = _run(case, method), case.truth
    for i, mark in enumerate(STATE_MARKS):
        shown: Any = {"color": mark.color, "mfc": "white", "label": f"$x_{i + 1}$ recorded"}
        above.plot(truth.x[:, i], mark.marker, **shown)
        above.plot(run.x[:, i], mark.line, color=mark.color, label=f"$x_{i + 1}$ fitted")
    # An input holds from its sample to the next: the last value is drawn once more, at the end.
    held = np.append(run.u[:, 0], run.u[-1, 0])
    fitted: Any = {"color": _CONTROL.color, "label": "$u$ fitted", "zorder": 3}
    below.step(np.arange(len(held)), held, where="post", **fitted)
    recorded: Any = {"color": INK, "mfc": "white", "ms": 3.2, "label": "$u$ recorded", "zorder": 4}
    below.plot(truth.u[:, 0], _CONTROL.marker, **recorded)
    _finish(above, below, case)


def _finish(above: Axes, below: Axes, case: CaseResult) -> None:
    """Set the limits, the same for all methods of a case so that figures can be compared."""
    methods = [_run(case, name) for _, name, _ in FIGURES]
    states = np.concatenate([run.x.ravel() for run in (case.truth, *methods)])
    inputs = np.concatenate([run.u.ravel() for run in (case.truth, *methods)])
    span = float(np.ptp(states))
    above.set_ylim(np.min(states) - 0.08 * span, np.max(states) + 0.12 * span)
    largest = 1.35 * max(BOUND, float(np.max(np.abs(inputs))))
    below.set_ylim(-largest, largest)
    for edge in (-1, 1):
        below.axhspan(edge * BOUND, edge * 2 * largest, color=FORBIDDEN, linewidth=0, zorder=0)
        below.axhline(edge * BOUND, color=INK, linewidth=0.8, linestyle=":", zorder=1)
    middle = (BOUND + largest) / 2
    below.text(len(case.truth.u), -middle, "beyond the bound", ha="right", va="center", size=7)
    above.set_ylabel("states (-)")
    below.set_ylabel("control $u$ (-)")
    below.set_xlabel("time (samples)")
    below.set_xlim(-0.5, len(case.truth.u) + 0.5)
    below.set_xticks(range(0, len(case.truth.u) + 1, 5))


def _run(case: CaseResult, method: str) -> Simulation:
    run = case.method(method).simulation
    assert run is not None  # only the LMI can be without an answer, and it has no figure
    return run
