"""The report of a selection: page, tables as CSV, result.json, figure."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from markupsafe import Markup

from impc.files.disk import truth_beside
from impc.reporting.document import Lines, Report, Section, Verdict
from impc.reporting.finding import Finding, Picture
from impc.reporting.provenance import Provenance
from impc.reporting.style import BLUE, DOUBLE_COLUMN, INK, drawn, journal_style, new_figure

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from matplotlib.figure import Figure

    from impc.arrays import Array
    from impc.files.digests import Inputs
    from impc.studies.selection.analysis import StudySelection
    from impc.studies.selection.estimation import PriorFit
    from impc.studies.selection.model import ParametricModel

_OPEN = "not determined"


def selection_report(
    model: ParametricModel,
    found: StudySelection,
    command: str,
    inputs: Inputs,
    truths: Mapping[str, Array],
) -> Report:
    """Page, result.json, tables and figure of `impc select`; they name `command` and `inputs`.

    `truths` has the true parameters (k,) of simulated subjects.
    """
    caption = (
        "Widths of the 95 % intervals of the chosen parameters, relative to their ranges, the "
        "others uncertain as they are between people: a point a subject, a bar at the mean."
    )
    picture = Picture("intervals", caption, caption)
    intervals = _intervals(model, found, truths)
    said = _compared(intervals)
    with journal_style():
        figures = drawn({"intervals": _interval_figure(model, found)})
    return Report(
        "impc: Sensitive parameters",
        "Sensitive parameters",
        (Verdict(_verdict(model, found)), Lines([*said, *_findings(model, found)])),
        [
            Section("1. Estimates", (picture, intervals), "Estimates"),
            Section("2. Methods of selection", (_methods(model, found),), "Methods"),
            Section(
                "3. Subsets and directions",
                (_sweep(model, found), _ranks(model, found)),
                "Subsets",
                folded=True,
            ),
            command_section(command),
        ],
        figures=figures,
        data=_data(model, found) | {"truth": said[0] if said else None},
        provenance=Provenance(command=command, inputs=inputs),
        words=model.words,
    )


def command_section(command: str) -> Section:
    """The last section of a selection: the `command` that made it."""
    return Section("Made by", (Markup("<code>{}</code>").format(command),), folded=True)


def _methods(model: ParametricModel, found: StudySelection) -> Finding:
    """What each method selects, and what it costs."""
    vaf = np.mean([np.mean(item.refit.vaf) for item in found.chosen.values()])
    full = np.mean([np.mean(item.fit.vaf) for item in found.nominal.values()])
    rows = [
        ("all parameters", f"all {model.size}", float(full), np.nan),
        ("information (FIM)", names_of(model, found.free), float(vaf), found.seconds["fim"]),
    ]
    for label, key in (("LASSO, proximal", "lasso"), ("LASSO, Table C.1", "nelder_mead")):
        fits = [getattr(item, key) for item in found.chosen.values()]
        known = [item for item in fits if item is not None and item.refit is not None]
        if known:
            share = float(np.mean([np.mean(item.refit.vaf) for item in known]))
            chosen = Counter(item.selected for item in known).most_common(1)[0][0]
            rows.append((label, names_of(model, chosen), share, found.seconds[key]))
    heads = ["method", "selected", "mean_vaf_percent", "seconds_a_subject"]
    return Finding("methods", pd.DataFrame(rows, columns=heads), "Methods of selection.")


def _findings(model: ParametricModel, found: StudySelection) -> list[str]:
    ranks = [item.information.rank for item in found.nominal.values()]
    seen = f"{min(ranks)} to {max(ranks)}" if min(ranks) < max(ranks) else f"{ranks[0]}"
    scalings = dict.fromkeys(names for item in found.nominal.values() for names in item.scalings)
    both = sorted(set(found.free) & set(found.lasso))
    stuck = Counter(index for item in found.chosen.values() for index in item.known.fit.at_bound)
    return [
        *(
            f"The estimate of {model.names[index]} ends at a bound in {stuck[index]} of "
            f"{len(found.chosen)} subjects, where its interval is one-sided or its whole range."
            for index in found.free
            if stuck[index]
        ),
        f"Of {model.size} parameters {seen} directions are identifiable.",
        *(
            f"Scaling {', '.join(names)} together changes the outputs by less than their noise."
            for names in scalings
        ),
        f"Selected by LASSO: {names_of(model, found.lasso) or 'none'}.",
        f"In common: {names_of(model, both) or 'none'}.",
    ]


def _ranks(model: ParametricModel, found: StudySelection) -> Finding:
    rows = [
        (subject, item.information.rank, float(np.mean(item.fit.vaf)),
         names_of(model, item.fit.at_bound), "; ".join(one.sentence for one in item.unseen))
        for subject, item in found.nominal.items()
    ]  # fmt: skip
    heads = ["subject", "rank", "vaf_percent", "at_a_bound", "directions_that_are_not_seen"]
    caption = "Identifiability, before any selection."
    return Finding("identifiability", pd.DataFrame(rows, columns=heads), caption)


def _sweep(model: ParametricModel, found: StudySelection) -> Finding:
    rows = []
    for index, selection in enumerate(found.worst_case):
        sizes = [item.sweep[index].size for item in found.nominal.values()]
        best = names_of(model, selection.subsets[0]) if selection.subsets else ""
        rows.append((selection.bound, min(sizes), max(sizes), selection.size,
                     len(selection.subsets), best))  # fmt: skip
    heads = ["variance_bound", "least_size_of_a_subject", "largest_size_of_a_subject",
             "size_all_at_once", "subsets", "best"]  # fmt: skip
    return Finding("sweep", pd.DataFrame(rows, columns=heads), "Largest feasible subsets (5.5).")


def _intervals(
    model: ParametricModel, found: StudySelection, truths: Mapping[str, Array]
) -> Finding:
    rows: list[dict[str, Any]] = []
    for place, index in enumerate(found.free):
        for subject, item in found.chosen.items():
            row: dict[str, Any] = {
                "subject": subject, "parameter": model.names[index], "unit": model.units[index],
            }  # fmt: skip
            own, exact = item.known, item.exact
            for name in ("value", "low", "high"):
                row[name] = float(getattr(own, name)[place])
            row["note"] = _note(model, index, own, row["low"], row["high"])
            row["width_percent_of_the_range"] = 50 * (row["high"] - row["low"]) / model.gain[index]
            for name in ("value", "low", "high"):
                row[f"others_exact_{name}"] = float(getattr(exact, name)[place])
            if subject in truths:
                row["truth"] = float(truths[subject][index])
                row["inside"] = row["low"] <= row["truth"] <= row["high"]
            rows.append(row)
    caption = (
        "The chosen parameters of each subject with 95 % intervals, the others uncertain as they "
        "are between people; and, others exact, with 95 % bootstrap intervals if each of the "
        "others had exactly its typical value, which holds for nobody."
    )
    return Finding("intervals", pd.DataFrame(rows), caption)


def _note(model: ParametricModel, index: int, item: PriorFit, low: float, high: float) -> str:
    """What the bounds of a parameter do to its interval."""
    ends = {"lower": low <= model.low[index], "upper": high >= model.high[index]}
    if all(ends.values()):
        return _OPEN
    at = "estimate at its" if index in item.fit.at_bound else "ends at the"
    return "".join(f"one-sided: {at} {name} bound" for name, here in ends.items() if here)


def _verdict(model: ParametricModel, found: StudySelection) -> str:
    """What is identified if the parameters that were not chosen were exact, and as they are."""
    names = model.named(found.free)
    chosen = f"{len(names)} of the {model.size} parameters together: {', '.join(names)}"
    rest = [k for k in range(model.size) if k not in found.free and model.deviation[k] > 0]
    if not rest:
        exact = ", the others being exactly typical" * (len(names) < model.size)
        return f"The recordings identify {chosen}{exact}."
    within = np.sum([one.known.variance <= found.bound for one in found.chosen.values()], axis=0)
    parts = ", ".join(f"{name} in {count}" for name, count in zip(names, within, strict=True))
    quarter = np.allclose(model.deviation[rest], model.gain[rest] / 2)
    return (
        f"If the other {len(rest)} parameters were exactly typical, the recordings would identify "
        f"{chosen}. Taken as typical, give or take "
        f"{'a quarter of their range' if quarter else 'their deviation between people'}, which the "
        f"intervals contain, they leave identified {parts} of {len(found.chosen)} subjects."
    )


def read_truths(folder: Path, model: ParametricModel) -> dict[str, Array]:
    """True parameters (k,) by subject and visit, from the truth.json of a study's `folder`."""
    said = truth_beside(folder)
    try:
        return {
            subject: np.array([values[name] for name in model.names], dtype=np.float64)
            for subject, values in said["recordings"].items()
        }
    except (AttributeError, KeyError, TypeError, ValueError):  # none, or another program's file
        return {}


def _compared(intervals: Finding) -> list[str]:
    """How many true values lie inside their `intervals`, where truths are known."""
    table = intervals.table
    if table is None or "truth" not in table:
        return []
    known = table.dropna(subset=["truth"])
    exact = known["truth"].between(known["others_exact_low"], known["others_exact_high"])
    return [
        f"The recordings are simulated: {known['inside'].sum()} of the {len(known)} true values "
        f"lie inside their 95 % intervals, {(known['note'] == _OPEN).sum()} of which are whole "
        f"ranges; {exact.sum()} if the other parameters are taken as exactly typical."
    ]


def _interval_figure(model: ParametricModel, found: StudySelection) -> Figure:
    figure = new_figure(DOUBLE_COLUMN, 2.4)
    ax = figure.subplots()
    for place, index in enumerate(found.free):
        known = [item.known for item in found.chosen.values()]
        widths = np.array([item.high[place] - item.low[place] for item in known])
        shown = 100 * widths / (2 * model.gain[index])
        spread = place + np.linspace(-0.2, 0.2, len(shown)) if len(shown) > 1 else [place]
        ax.plot(spread, shown, linestyle="none", marker="o", color=BLUE, markerfacecolor="white")
        ax.hlines(shown.mean(), place - 0.3, place + 0.3, color=INK, linewidth=1.5)
    ax.set_xticks(range(len(found.free)), [model.names[index] for index in found.free])
    ax.set_ylabel("interval (% of the range)")
    ax.set_ylim(bottom=0)
    return figure


def _data(model: ParametricModel, found: StudySelection) -> dict[str, Any]:
    names, chosen = model.named, found.chosen.items()
    lasso = {key: item.lasso.refit for key, item in chosen}
    tables = {key: item.nelder_mead for key, item in chosen if item.nelder_mead is not None}
    return {
        "selected": {
            "fim": names(found.free),
            "lasso": names(found.lasso),
            "nelder_mead": {key: names(item.selected) for key, item in tables.items()},
        },
        "common": names(sorted(set(found.free) & set(found.lasso))),
        "intersection": [names(subset) for subset in found.intersection],
        "deviation": dict(zip(model.names, model.deviation, strict=True)),
        "vaf": {
            "nominal": {key: item.fit.vaf for key, item in found.nominal.items()},
            "fim": {key: item.refit.vaf for key, item in chosen},
            "lasso": {key: None if fit is None else fit.vaf for key, fit in lasso.items()},
        },
        "unseen_scalings": {key: item.scalings for key, item in found.nominal.items()},
        "unseen": {
            key: [direction.shares for direction in item.unseen]
            for key, item in found.nominal.items()
        },
        "subsets": [
            {"bound": item.bound, "subsets": [names(subset) for subset in item.subsets]}
            for item in found.worst_case
        ],
    }


def names_of(model: ParametricModel, subset: Sequence[int]) -> str:
    """Names of a subset, with commas."""
    return ", ".join(model.named(subset))
