"""The report of a selection: page, tables as CSV, result.json, figure."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup

from impc.reporting.document import Lines, Picture, Report, Section, TextTable, Verdict
from impc.reporting.provenance import Provenance
from impc.reporting.rendering import number
from impc.reporting.style import BLUE, DOUBLE_COLUMN, INK, drawn, journal_style, new_figure

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.figure import Figure

    from impc.files.inputs import Inputs
    from impc.studies.selection.analysis import StudySelection
    from impc.studies.selection.model import ParametricModel


def selection_report(
    model: ParametricModel, found: StudySelection, command: str, inputs: Inputs
) -> Report:
    """Page, result.json, tables and figure of `impc select`; they name `command` and `inputs`."""
    tables = {
        "identifiability": _rank_table(model, found),
        "sweep": _sweep_table(model, found),
        "intervals": _interval_table(model, found),
        "methods": selection_table(model, found),
    }
    caption = (
        "Widths of the 95 % bootstrap intervals of the chosen parameters, relative to their "
        "ranges: a point a subject, a bar at the mean."
    )
    picture = Picture("intervals", caption, caption)
    with journal_style():
        figures = drawn({"intervals": _interval_figure(model, found)})
    return Report(
        "impc: Sensitive parameters",
        "Sensitive parameters",
        (Verdict(_verdict(model, found)), Lines(_findings(model, found))),
        [
            Section("1. Estimates", (picture, tables["intervals"]), "Estimates"),
            Section("2. Methods of selection", (tables["methods"],), "Methods"),
            Section(
                "3. Subsets and directions",
                [tables[name] for name in ("sweep", "identifiability")],
                "Subsets",
                folded=True,
            ),
            command_section(command),
        ],
        figures=figures,
        tables=tables,
        data=_data(model, found),
        provenance=Provenance(command=command, inputs=inputs),
        words=model.words,
    )


def command_section(command: str) -> Section:
    """The last section of a selection: the `command` that made it."""
    return Section("Made by", (Markup("<code>{}</code>").format(command),), folded=True)


def _verdict(model: ParametricModel, found: StudySelection) -> str:
    return (
        f"The recordings tell {len(found.free)} of the {model.size} parameters well enough at "
        f"once: {names_of(model, found.free)}."
    )


def selection_table(model: ParametricModel, found: StudySelection) -> TextTable:
    """What each method selects, and what it costs."""
    vaf = np.mean([np.mean(item.refit.vaf) for item in found.chosen.values()])
    full = np.mean([np.mean(item.fit.vaf) for item in found.nominal.values()])
    fits = {
        "lasso": [item.lasso for item in found.chosen.values()],
        "nelder_mead": [item.nelder_mead for item in found.chosen.values() if item.nelder_mead],
    }
    rows = [
        ("all parameters", str(model.size), number(float(full), 4), "", ""),
        (
            "information (FIM)", names_of(model, found.free), number(float(vaf), 4),
            f"{found.seconds['fim']:.3g}", "",
        ),
    ]  # fmt: skip
    for label, key in (("LASSO, proximal", "lasso"), ("LASSO, Table C.1", "nelder_mead")):
        known = [item for item in fits[key] if item.refit is not None]
        if not known:
            continue
        share = np.mean([np.mean(item.refit.vaf) for item in known if item.refit is not None])
        chosen = Counter(item.selected for item in known).most_common(1)[0][0]
        rows.append(
            (
                label, names_of(model, chosen), number(float(share), 4),
                f"{found.seconds[key]:.3g}",
                f"{found.seconds[key] / found.seconds['fim']:.3g}",
            )
        )  # fmt: skip
    heads = ("method", "selected", "mean VAF %", "seconds a subject", "over FIM")
    return TextTable("Methods of selection.", heads, rows)


def _findings(model: ParametricModel, found: StudySelection) -> list[str]:
    lines = []
    ranks = [item.information.rank for item in found.nominal.values()]
    seen = f"{min(ranks)} to {max(ranks)}" if min(ranks) < max(ranks) else f"{ranks[0]}"
    lines.append(f"Of {model.size} parameters {seen} directions are identifiable.")
    for names in dict.fromkeys(names for item in found.nominal.values() for names in item.scalings):
        lines.append(
            f"Scaling {', '.join(names)} together changes the outputs by less than their noise."
        )
    lines.append(f"Selected by LASSO: {names_of(model, found.lasso) or 'none'}.")
    both = sorted(set(found.free) & set(found.lasso))
    lines.append(f"In common: {names_of(model, both) or 'none'}.")
    return lines


def _rank_table(model: ParametricModel, found: StudySelection) -> TextTable:
    rows = tuple(
        (
            name,
            str(item.information.rank),
            number(float(np.mean(item.fit.vaf)), 4),
            ", ".join(model.names[index] for index in item.fit.at_bound) or "-",
            "; ".join(direction.sentence for direction in item.unseen) or "-",
        )
        for name, item in found.nominal.items()
    )
    heads = ("subject", "rank", "VAF %", "at a bound", "directions that are not seen")
    return TextTable("Identifiability, before any selection.", heads, rows)


def _sweep_table(model: ParametricModel, found: StudySelection) -> TextTable:
    rows = []
    for index, selection in enumerate(found.worst_case):
        sizes = [item.sweep[index].size for item in found.nominal.values()]
        rows.append(
            (
                f"{selection.bound:.2f}",
                f"{min(sizes)} to {max(sizes)}",
                str(selection.size),
                str(len(selection.subsets)),
                names_of(model, selection.subsets[0]) if selection.subsets else "-",
            )
        )
    heads = ("variance bound", "size, each subject", "size, all at once (5.5)", "subsets", "best")
    return TextTable("Largest feasible subsets.", heads, rows)


def _interval_table(model: ParametricModel, found: StudySelection) -> TextTable:
    rows = []
    for place, index in enumerate(found.free):
        values = np.array([item.refit.theta[index] for item in found.chosen.values()])
        widths = np.array([item.intervals.width[place] for item in found.chosen.values()])
        rows.append(
            (
                model.names[index], model.units[index],
                f"{values.mean():.4g}{_spread(values)}",
                f"{widths.mean():.3g}{_spread(widths)}",
                f"{100 * widths.mean() / (2 * model.gain[index]):.1f}",
            )
        )  # fmt: skip
    heads = ("parameter", "unit", "estimate", "width of the interval", "% of its range")
    return TextTable("Chosen parameters, mean ± SD over subjects.", heads, rows)


def _interval_figure(model: ParametricModel, found: StudySelection) -> Figure:
    figure = new_figure(DOUBLE_COLUMN, 2.4)
    ax = figure.subplots()
    for place, index in enumerate(found.free):
        widths = np.array([item.intervals.width[place] for item in found.chosen.values()])
        shown = 100 * widths / (2 * model.gain[index])
        spread = place + np.linspace(-0.2, 0.2, len(shown)) if len(shown) > 1 else [place]
        ax.plot(spread, shown, linestyle="none", marker="o", color=BLUE, markerfacecolor="white")
        ax.hlines(shown.mean(), place - 0.3, place + 0.3, color=INK, linewidth=1.5)
    ax.set_xticks(range(len(found.free)), [model.names[index] for index in found.free])
    ax.set_ylabel("interval (% of the range)")
    ax.set_ylim(bottom=0)
    return figure


def _data(model: ParametricModel, found: StudySelection) -> dict[str, Any]:
    def names(subset: Sequence[int]) -> list[str]:
        return [model.names[index] for index in subset]

    intervals = {
        subject: {
            name: {"value": value, "low": low, "high": high}
            for name, value, low, high in zip(
                item.intervals.names, item.intervals.value, item.intervals.low, item.intervals.high,
                strict=True,
            )
        }
        for subject, item in found.chosen.items()
    }  # fmt: skip
    return {
        "selected": {
            "fim": names(found.free),
            "lasso": names(found.lasso),
            "nelder_mead": {
                key: names(item.nelder_mead.selected)
                for key, item in found.chosen.items()
                if item.nelder_mead is not None
            },
        },
        "common": names(sorted(set(found.free) & set(found.lasso))),
        "intersection": [names(subset) for subset in found.intersection],
        "intervals": intervals,
        "vaf": {
            "nominal": {key: item.fit.vaf for key, item in found.nominal.items()},
            "fim": {key: item.refit.vaf for key, item in found.chosen.items()},
            "lasso": {
                key: None if item.lasso.refit is None else item.lasso.refit.vaf
                for key, item in found.chosen.items()
            },
        },
        "seconds": found.seconds,
        "rank": {key: item.information.rank for key, item in found.nominal.items()},
        "unseen_scalings": {key: item.scalings for key, item in found.nominal.items()},
        "unseen": {
            key: [direction.shares for direction in item.unseen]
            for key, item in found.nominal.items()
        },
        "sweep": [
            {"bound": item.bound, "size": item.size, "subsets": [names(s) for s in item.subsets]}
            for item in found.worst_case
        ],
    }


def names_of(model: ParametricModel, subset: Sequence[int]) -> str:
    """Names of a subset, with commas."""
    return ", ".join(model.names[index] for index in subset)


def _spread(values: np.ndarray[Any, np.dtype[np.float64]]) -> str:
    """The deviation behind a mean; nothing for one subject."""
    return f" ± {np.std(values, ddof=1):.2g}" if len(values) > 1 else ""
