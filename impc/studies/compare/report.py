"""The report of a comparison of methods: page, table as CSV, result.json, one figure."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup

from impc.inverse.methods import METHODS
from impc.reporting.document import Lines, Picture, Report, Section, Terms, TextTable
from impc.reporting.rendering import number
from impc.reporting.style import BLUE, DOUBLE_COLUMN, INK, drawn, journal_style, new_figure

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.figure import Figure

    from impc.inverse.problem import Problem
    from impc.reporting.provenance import Provenance
    from impc.studies.compare.subject import MethodComparison

__all__ = ["compare_report", "methods_table"]

_PICTURE = Picture(
    "comparison",
    "VAF in and out of sample and largest command of every method",
    "Left: variance accounted for, mean over outputs; filled, all trials; open, trials left out. "
    "Bars that would be negative end at zero. Right: largest command; the dotted line is the "
    "subject's bound, hatched bars exceed it.",
)


def compare_report(
    problem: Problem, compared: Sequence[MethodComparison], provenance: Provenance
) -> Report:
    """Page, result.json, comparison.csv and the figure."""
    subject = str(problem.recordings[0].label.subject) or "a subject"
    methods = [METHODS[item.name] for item in compared]
    with journal_style():
        figures = drawn({"comparison": _figure(problem, compared)})
    sections = [
        Section(
            "1. All methods on the same recordings",
            (methods_table(problem, compared), _PICTURE),
            together=True,
        ),
        Section("2. Weights", (_weights(problem, compared),)),
        Section(
            "3. What each method does",
            (Terms([(one.label, (one.sentence,)) for one in methods]),),
        ),
        Section(
            "4. Versions",
            (
                Markup("<code>{}</code>").format(provenance.command),
                Terms(
                    [
                        ("Made", (provenance.made,)),
                        ("Plant", (Markup("<code>{}</code>").format(provenance.plant_name),)),
                        ("Versions", (provenance.all_versions,)),
                    ]
                ),
            ),
        ),
    ]
    return Report(
        f"impc compare: {subject}",
        f"Methods for the weights behind the recordings of {subject}",
        (Lines(_findings(compared)),),
        sections,
        figures=figures,
        tables={"comparison": _numbers(problem, compared)},
        data=_data(problem, compared, provenance),
    )


def _held(item: MethodComparison) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    count = item.fit.vaf.size
    return np.mean(item.held_out, axis=0) if len(item.held_out) else np.full(count, np.nan)


def _findings(compared: Sequence[MethodComparison]) -> list[str]:
    usable = [item for item in compared if not np.any(np.isnan(item.fit.vaf))]
    held = [item for item in usable if not np.any(np.isnan(_held(item)))]
    ranked = sorted(held or usable, key=lambda item: -float(np.mean(_score(item))))
    lines = []
    if ranked:
        best = ranked[0]
        where = "trials that it has not seen" if held else "the trials that it was fitted to"
        lines.append(
            f"Best on {where}: {METHODS[best.name].label}, {np.mean(_score(best)):.2f} % on "
            "average over the outputs."
        )
    keeping = [METHODS[item.name].label for item in usable if item.fit.keeps_bounds]
    lines.append(f"Keep the subject's bounds: {', '.join(keeping) or 'none'}.")
    lines += [
        f"{METHODS[item.name].label}: {item.fit.estimate.reason}."
        for item in compared
        if item.fit.estimate.reason
    ]
    return lines


def _score(item: MethodComparison) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    held = _held(item)
    return item.fit.vaf if np.any(np.isnan(held)) else held


def methods_table(problem: Problem, compared: Sequence[MethodComparison]) -> TextTable:
    """What the `compared` methods reach on the recordings of the `problem`."""
    outputs = problem.plant.outputs
    heads = ["method"]
    heads += [f"VAF {name} %" for name in outputs] + [f"left out {name} %" for name in outputs]
    heads += ["largest input", "beyond bound %", "falls", "weights", "seconds"]
    rows = []
    for item in compared:
        fit = item.fit
        fallen = [time for time in fit.fell if time is not None]
        rows.append(
            (
                METHODS[item.name].label,
                *(number(float(value), 5) for value in (*fit.vaf, *_held(item))),
                ", ".join(number(float(value)) for value in fit.largest_input),
                "-" if fit.estimate.K is None else f"{100 * fit.exceeded:.1f}",
                f"{min(fallen):.1f} s" if fallen else "",
                "none" if fit.estimate.weights is None else "yes",
                f"{fit.estimate.seconds:.2f}",
            )
        )
    caption = (
        "Variance accounted for (3.24): all trials, and each trial predicted from the others after "
        "the time that serves to find where it starts. Beyond bound: share of samples."
    )
    return TextTable(caption, heads, rows)


def _weights(problem: Problem, compared: Sequence[MethodComparison]) -> TextTable:
    plant = problem.plant
    rows = []
    for item in compared:
        given = item.fit.estimate.weights
        if given is None:
            continue
        eigenvalues = np.linalg.eigvalsh(given.block)
        rows.append(
            (
                METHODS[item.name].label,
                *(number(float(value)) for value in np.diag(given.Q)),
                number(float(eigenvalues[-1] / eigenvalues[0])),
            )
        )
    heads = ("method", *(f"Q {name}" for name in plant.states), "condition number")
    return TextTable(
        "Diagonal of Q in plant units at R[0, 0] = 1, and kappa(blkdiag(Q, R)). result.json has "
        "all entries.",
        heads,
        rows,
    )


def _figure(problem: Problem, compared: Sequence[MethodComparison]) -> Figure:
    shown = [item for item in compared if item.fit.estimate.K is not None][::-1]
    figure = new_figure(DOUBLE_COLUMN, 0.5 + 0.36 * max(len(shown), 2))
    left, right = figure.subplots(1, 2, sharey=True, width_ratios=(1.6, 1))
    rows = np.arange(len(shown))
    inside = [max(float(np.nan_to_num(np.mean(item.fit.vaf))), 0.0) for item in shown]
    outside = [max(float(np.nan_to_num(np.mean(_held(item)))), 0.0) for item in shown]
    left.barh(rows + 0.2, inside, 0.38, color=BLUE, label="all trials")
    left.barh(
        rows - 0.2, outside, 0.38, color="white", edgecolor=INK, linewidth=0.8, label="left out"
    )
    left.set_yticks(rows, [METHODS[item.name].label for item in shown])
    left.set_xlim(0, 100)
    left.set_xlabel("VAF, mean over outputs (%)")
    left.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2)
    largest = [float(item.fit.largest_input[0]) for item in shown]
    hatches = ["" if item.fit.keeps_bounds else "////" for item in shown]
    right.barh(rows, largest, 0.6, color="#C8C8C8", edgecolor=INK, linewidth=0.6, hatch=hatches)
    limit = float(problem.bounds.u_max[0])
    if np.isfinite(limit):
        right.axvline(limit, color=INK, linestyle=":", linewidth=1.2)
        right.set_xlim(0, min(1.05 * max(largest), 5 * limit))
    right.set_xlabel(f"largest {problem.plant.controls[0]} (SI unit)")
    return figure


def _numbers(problem: Problem, compared: Sequence[MethodComparison]) -> TextTable:
    """comparison.csv: numbers to the last digit."""
    plant = problem.plant
    heads = [
        "method",
        *(f"vaf_{name}" for name in plant.outputs),
        *(f"held_out_vaf_{name}" for name in plant.outputs),
        *(f"largest_{name}" for name in plant.controls),
        "share_beyond_bound",
        "seconds",
        "reason",
    ]
    rows = [
        (
            item.name,
            *map(float, (*item.fit.vaf, *_held(item), *item.fit.largest_input, item.fit.exceeded)),
            item.fit.estimate.seconds,
            item.fit.estimate.reason,
        )
        for item in compared
    ]
    return TextTable("", heads, rows)


def _data(
    problem: Problem, compared: Sequence[MethodComparison], provenance: Provenance
) -> dict[str, Any]:
    plant = problem.plant
    methods: dict[str, Any] = {}
    for item in compared:
        fit = item.fit
        methods[item.name] = {
            "K": fit.estimate.K,
            "Q": None if fit.estimate.weights is None else fit.estimate.weights.Q,
            "R": None if fit.estimate.weights is None else fit.estimate.weights.R,
            "vaf": dict(zip(plant.outputs, fit.vaf, strict=True)),
            "held_out_vaf": dict(zip(plant.outputs, _held(item), strict=True)),
            "trial_vaf": fit.trial_vaf,
            "held_out_trial_vaf": item.held_out,
            "largest_input": fit.largest_input,
            "share_beyond_bound": fit.exceeded,
            "fell": fit.fell,
            "seconds": fit.estimate.seconds,
            "reason": fit.estimate.reason,
        }
    return {
        "methods": methods,
        "states": plant.states,
        "outputs": plant.outputs,
        "horizon": problem.horizon,
        **provenance.data(),
    }
