"""The report of a comparison of methods: page, table as CSV, result.json, one figure."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from markupsafe import Markup

from impc.assess.assessments import ASSESSMENTS
from impc.checking import replace
from impc.control.named_solver import described
from impc.inverse.methods import METHODS
from impc.reporting.document import Lines, Report, Section, Terms, Verdict
from impc.reporting.estimate_text import gain_table
from impc.reporting.finding import Chart, Finding, Picture
from impc.reporting.shown_units import axis_label, body_sentence, signal_words
from impc.reporting.style import BLUE, DOUBLE_COLUMN, INK, drawn, journal_style, new_figure
from impc.studies.charts import chart_figure, methods_chart
from impc.studies.methods_table import (
    column_terms,
    methods_data,
    methods_finding,
    trajectory_table,
    weight_entries,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.figure import Figure

    from impc.arrays import Array
    from impc.assess.assessments import MethodFit
    from impc.inverse.problem import Problem
    from impc.reporting.provenance import Provenance

# Percent that exact recordings leave, and less.
_ROUNDING = 1e-6
_PICTURE = Picture(
    "comparison",
    "VAF in and out of sample and largest command of every method",
    "Left: what a method does not explain, 100 % less its VAF, mean over outputs; filled, all "
    "trials; open, trials left out; farther left is better. Right: largest command; the dotted "
    "line is the subject's bound, hatched bars exceed it.",
)


# Curves in the picture of a trial: recorded, and the three methods that explain most.
_CURVES = 4
_TRAJECTORIES = Picture(
    "trajectories",
    "Outputs and commands of the first trial: recorded, and as the best three methods have them",
    "The first trial: recorded (grey), and the three methods that explain most. Dotted: the "
    "subject's bounds.",
)


def compare_report(
    problem: Problem,
    compared: Sequence[MethodFit],
    provenance: Provenance,
) -> Report:
    """Page, result.json, tables and the figures."""
    subject = str(problem.recordings[0].label.subject) or "a subject"
    methods = [METHODS[item.name] for item in compared]
    found = compared[-1].estimate.problem.recordings  # with their offsets
    problem = replace(problem, recordings=found)
    with journal_style():
        curves = methods_chart(problem, _by_score(compared), 0)
        figures = drawn(
            {
                "comparison": _figure(problem, compared),
                "trajectories": chart_figure(curves, _CURVES),
            }
        )
    sections = [
        Section(
            "1. All methods on the same recordings",
            (_PICTURE, methods_finding(compared), Chart(_TRAJECTORIES, curves)),
            "Methods",
            together=True,
        ),
        Section(
            "2. What each method does, and what each column says",
            (Terms([(one.label, (one.sentence,)) for one in methods]), column_terms()),
            "Columns",
            folded=True,
        ),
        Section("3. Weights", (_weights(problem, compared),), "Weights", folded=True),
        Section(
            "4. Versions",
            (
                Markup("<code>{}</code>").format(provenance.command),
                Terms(
                    [
                        ("Made", (provenance.made,)),
                        ("Plant", (Markup("<code>{}</code>").format(provenance.plant_name),)),
                        ("Body", (body_sentence(problem.plant),)),
                        ("Quadratic programs", (f"Solved by {described(problem.solver)}.",)),
                        ("Versions", (provenance.all_versions,)),
                    ]
                ),
            ),
            folded=True,
        ),
    ]
    return Report(
        f"impc compare: {subject}",
        f"Methods for the weights behind the recordings of {subject}",
        (Verdict(_verdict(compared)), Lines(_findings(compared))),
        sections,
        figures=figures,
        beside=[_gain(problem, compared), _trajectories(problem, compared)],
        data=_data(problem, compared),
        provenance=provenance,
        words=signal_words(problem.plant),
    )


def _usable(compared: Sequence[MethodFit]) -> list[MethodFit]:
    return [item for item in compared if not np.any(np.isnan(item.vaf))]


def _by_score(compared: Sequence[MethodFit]) -> list[MethodFit]:
    """Those with a simulation, best first; those that fall are last."""
    shown = [item for item in compared if item.runs]
    return sorted(shown, key=lambda item: -np.nan_to_num(float(np.mean(_score(item))), nan=-np.inf))


def _verdict(compared: Sequence[MethodFit]) -> str:
    usable = _usable(compared)
    held = [item for item in usable if len(item.held_out) and not np.any(np.isnan(item.held_out))]
    ranked = sorted(held or usable, key=lambda item: -float(np.mean(_score(item))))
    if not ranked:
        return "No method explains these recordings to their end."
    best = ranked[0]
    where = "trials that it has not seen" if held else "the trials that it was fitted to"
    kept = "keeps" if best.keeps_bounds else "exceeds"
    return (
        f"Best on {where}: {METHODS[best.name].label}, {np.mean(_score(best)):.2f} % on average "
        f"over the outputs; it {kept} the subject's bounds."
    )


def _findings(compared: Sequence[MethodFit]) -> list[str]:
    keeping = [METHODS[item.name].label for item in _usable(compared) if item.keeps_bounds]
    lines = [f"Keep the subject's bounds: {', '.join(keeping) or 'none'}."]
    lines += [
        f"{METHODS[item.name].label}: {item.estimate.reason}."
        for item in compared
        if item.estimate.reason
    ]
    return lines


def _held_out(item: MethodFit) -> Array:
    return ASSESSMENTS["held_out_vaf"].find(item)


def _score(item: MethodFit) -> Array:
    """VAF of each output on trials left out, (p,); on all trials where none was, %."""
    outside = _held_out(item)
    return item.vaf if np.any(np.isnan(outside)) else outside


def _gain(problem: Problem, compared: Sequence[MethodFit]) -> Finding:
    rows = [
        (f"K.{control}.{state}", unit, item.name, value)
        for item in compared
        if (K := item.estimate.K) is not None
        for control, state, unit, value in gain_table(problem.plant, K).itertuples(index=False)
    ]
    return Finding("gain", pd.DataFrame(rows, columns=["number", "unit", "method", "value"]))


def _weights(problem: Problem, compared: Sequence[MethodFit]) -> Finding:
    rows = [
        (*entry[:-1], item.name, entry[-1])
        for item in compared
        if item.estimate.weights is not None
        for entry in weight_entries(problem.plant, item.estimate.weights)
    ]
    heads = ["matrix", "first", "second", "unit", "method", "value"]
    caption = "Entries of Q and R, at R = 1 of the first command."
    return Finding("weights", pd.DataFrame(rows, columns=heads), caption)


def _trajectories(problem: Problem, compared: Sequence[MethodFit]) -> Finding:
    """Every trial; a method that falls has no numbers from there on."""
    runs = {item.name: item.runs for item in compared if item.runs}
    every = range(len(problem.recordings))
    return Finding("trajectories", trajectory_table(problem, every, runs))


def _figure(problem: Problem, compared: Sequence[MethodFit]) -> Figure:
    shown = [item for item in compared if item.estimate.K is not None][::-1]
    figure = new_figure(DOUBLE_COLUMN, 0.5 + 0.36 * max(len(shown), 2))
    left, right = figure.subplots(1, 2, sharey=True, width_ratios=(1.6, 1))
    rows = np.arange(len(shown))
    inside = [_unexplained(item.vaf) for item in shown]
    outside = [_unexplained(_held_out(item)) for item in shown]
    left.plot(inside, rows, "o", color=BLUE, label="all trials")
    if not np.all(np.isnan(outside)):
        left.plot(
            outside, rows, "o", color=INK, markerfacecolor="none", markersize=9, label="left out"
        )
    left.set_xscale("log")
    left.grid(axis="y", linewidth=0.4)
    left.set_yticks(rows, [METHODS[item.name].label for item in shown])
    left.set_xlabel("not explained, 100 - VAF (%)")
    left.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2)
    largest = [float(item.largest_input[0]) for item in shown]
    hatches = ["" if item.keeps_bounds else "////" for item in shown]
    right.barh(rows, largest, 0.6, color="#C8C8C8", edgecolor=INK, linewidth=0.6, hatch=hatches)
    limit = float(problem.bounds.u_max[0])
    if np.isfinite(limit):
        right.axvline(limit, color=INK, linestyle=":", linewidth=1.2)
        right.set_xlim(0, min(1.05 * max(largest), 5 * limit))
    right.set_xlabel(f"largest {axis_label(problem.plant, problem.plant.controls[0])}")
    return figure


def _unexplained(shares: Array) -> float:
    """100 % less the mean VAF; rounding where all is explained, so that it has a logarithm."""
    return max(100.0 - float(np.mean(shares)), _ROUNDING)


def _data(problem: Problem, compared: Sequence[MethodFit]) -> dict[str, Any]:
    return {
        "methods": methods_data(compared),
        "states": problem.plant.states,
        "outputs": problem.plant.outputs,
        "horizon": problem.horizon,
        "body": problem.plant.moves,
        "solver": problem.solver,
    }
