"""All files of a selection: page, tables as CSV, result.json, figure."""

from __future__ import annotations

import csv
import io
import json
from typing import TYPE_CHECKING, Any

import numpy as np

from impc.report.rendering import TextTable, embedded, number, plain, render_template
from impc.report.style import BLUE, DOUBLE_COLUMN, INK, journal_style, new_figure, render

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.figure import Figure

    from impc.selection.analysis import StudySelection
    from impc.selection.key_parameters import KeyParameters
    from impc.selection.model import ParametricModel

__all__ = ["key_files", "selection_files", "selection_table"]


def selection_files(
    model: ParametricModel, found: StudySelection, command: str
) -> dict[str, bytes]:
    """Build all files of `impc select`; nothing is written."""
    tables = {
        "identifiability": _rank_table(model, found),
        "sweep": _sweep_table(model, found),
        "intervals": _interval_table(model, found),
        "methods": selection_table(model, found),
        "agreement": _agreement_table(model, found),
        "bias": _bias_table(model, found),
    }
    with journal_style():
        pictures = render(_interval_figure(model, found))
    page = render_template(
        "selection/selection_page.html",
        title="Sensitive parameters",
        findings=_findings(model, found),
        tables=list(tables.values()),
        picture_source=embedded(pictures["png"]),
        caption="Widths of the 95 % bootstrap intervals of the chosen parameters, relative to "
        "their ranges: a point a subject, a bar at the mean.",
        command=command,
    )
    return {
        "report.html": page.encode(),
        "result.json": _json(model, found, command),
        **{f"{name}.csv": _csv(table) for name, table in tables.items()},
        **{f"intervals.{kind}": content for kind, content in pictures.items()},
    }


def key_files(model: ParametricModel, found: KeyParameters, command: str) -> dict[str, bytes]:
    """Build all files of `impc key-parameters`; nothing is written."""
    rows = tuple(
        (
            _names(model, item.subset),
            number(item.variance),
            number(item.vaf, 4),
            number(item.reliability, 2),
            str(item.diversity),
            "kept" if item.kept else "",
        )
        for item in found.candidates
    )
    heads = ("subset", "largest variance", "mean VAF %", "least ICC(A,k)", "pathways", "")
    table = TextTable("Subsets and the filters that they pass, best first.", heads, rows)
    chosen = _names(model, found.chosen) if found.chosen else "none: no subset passes all filters"
    with journal_style():
        pictures = render(_solution_figure(model, found))
    page = render_template(
        "selection/selection_page.html",
        title="Key parameters",
        findings=[
            f"{len(found.selection.subsets)} subsets of {found.selection.size} parameters are "
            f"estimated well enough for every subject and visit (variance at most "
            f"{found.selection.bound:g}).",
            f"Chosen: {chosen}.",
        ],
        tables=[table],
        picture_source=embedded(pictures["png"]),
        caption="Counterpart of figure 5.3: subsets in the space of reliability and goodness of "
        "fit; filled ones pass all filters.",
        command=command,
    )
    content = {
        "chosen": [model.names[index] for index in found.chosen],
        "size": found.selection.size,
        "subsets": len(found.selection.subsets),
        "candidates": [
            {
                "names": [model.names[index] for index in item.subset],
                "variance": item.variance,
                "vaf": item.vaf,
                "icc": item.reliability,
                "diversity": item.diversity,
                "kept": item.kept,
            }
            for item in found.candidates
        ],
        "command": command,
    }
    return {
        "report.html": page.encode(),
        "result.json": (json.dumps(plain(content), indent=1) + "\n").encode(),
        "candidates.csv": _csv(table),
        **{f"solution-space.{kind}": picture for kind, picture in pictures.items()},
    }


def selection_table(model: ParametricModel, found: StudySelection) -> TextTable:
    """What each method selects, and what it costs."""
    vaf = np.mean([np.mean(item.vaf) for item in found.refits.values()])
    full = np.mean([np.mean(item.nominal.vaf) for item in found.subjects])
    rows = [
        ("all parameters", str(model.size), number(float(full), 4), "", ""),
        (
            "information (FIM)", _names(model, found.chosen), number(float(vaf), 4),
            f"{found.seconds['fim']:.3g}", "",
        ),
    ]  # fmt: skip
    for label, key, fits in (
        ("LASSO, proximal", "lasso", found.lasso),
        ("LASSO, Table C.1", "nelder_mead", found.nelder_mead),
    ):
        known = [item for item in fits.values() if item.refit is not None]
        if not known:
            continue
        share = np.mean([np.mean(item.refit.vaf) for item in known if item.refit is not None])
        chosen = found.lasso_common if key == "lasso" else known[0].selected
        rows.append(
            (
                label, _names(model, chosen), number(float(share), 4),
                f"{found.seconds[key]:.3g}",
                f"{found.seconds[key] / found.seconds['fim']:.3g}",
            )
        )  # fmt: skip
    heads = ("method", "selected", "mean VAF %", "seconds a subject", "over FIM")
    return TextTable("Methods of selection.", heads, tuple(tuple(row) for row in rows))


def _findings(model: ParametricModel, found: StudySelection) -> list[str]:
    lines = []
    ranks = [item.information.rank for item in found.subjects]
    lines.append(
        f"Of {model.size} parameters {min(ranks)} to {max(ranks)} directions are identifiable."
    )
    for names in dict.fromkeys(names for item in found.subjects for names in item.scalings):
        lines.append(
            f"Scaling {', '.join(names)} together changes the outputs by less than their noise."
        )
    lines.append(f"Selected by information: {_names(model, found.chosen)}.")
    lines.append(f"Selected by LASSO: {_names(model, found.lasso_common) or 'none'}.")
    both = sorted(set(found.chosen) & set(found.lasso_common))
    lines.append(f"In common: {_names(model, both) or 'none'}.")
    return lines


def _rank_table(model: ParametricModel, found: StudySelection) -> TextTable:
    rows = tuple(
        (
            item.name,
            str(item.information.rank),
            number(float(np.mean(item.nominal.vaf)), 4),
            ", ".join(model.names[index] for index in item.nominal.at_bound) or "-",
            "; ".join(direction.sentence for direction in item.unseen) or "-",
        )
        for item in found.subjects
    )
    heads = ("subject", "rank", "VAF %", "at a bound", "directions that are not seen")
    return TextTable("Identifiability, before any selection.", heads, rows)


def _sweep_table(model: ParametricModel, found: StudySelection) -> TextTable:
    rows = []
    for index, selection in enumerate(found.worst_case):
        sizes = [item.sweep[index].size for item in found.subjects]
        rows.append(
            (
                f"{selection.bound:.2f}",
                f"{min(sizes)} to {max(sizes)}",
                str(selection.size),
                str(len(selection.subsets)),
                _names(model, selection.subsets[0]) if selection.subsets else "-",
            )
        )
    heads = ("variance bound", "size, each subject", "size, all at once (5.5)", "subsets", "best")
    return TextTable("Largest feasible subsets.", heads, tuple(rows))


def _interval_table(model: ParametricModel, found: StudySelection) -> TextTable:
    rows = []
    for place, index in enumerate(found.chosen):
        values = np.array([np.array(item.theta)[index] for item in found.refits.values()])
        widths = np.array([item.width[place] for item in found.intervals.values()])
        rows.append(
            (
                model.names[index], model.units[index],
                f"{values.mean():.4g} ± {_sd(values):.2g}",
                f"{widths.mean():.3g} ± {_sd(widths):.2g}",
                f"{100 * widths.mean() / (2 * model.gain[index]):.1f}",
            )
        )  # fmt: skip
    heads = ("parameter", "unit", "estimate", "width of the interval", "% of its range")
    return TextTable("Chosen parameters, mean ± SD over subjects.", heads, tuple(rows))


def _agreement_table(model: ParametricModel, found: StudySelection) -> TextTable:
    rows = []
    for rule, item in found.agreement.items():
        subset = item if isinstance(item, tuple) else (item.subsets[0] if item.subsets else ())
        shared = len(set(subset) & set(found.chosen))
        rows.append((rule, _names(model, subset) or "-", f"{shared} of {len(found.chosen)}"))
    caption = (
        f"What other rules select in the first subject. The chosen subset's collinearity is "
        f"{found.collinearity:.3g}; 10 to 20 is the usual limit."
    )
    return TextTable(caption, ("rule", "subset", "shared with the chosen"), tuple(rows))


def _bias_table(model: ParametricModel, found: StudySelection) -> TextTable:
    rows = tuple(
        (item.name, f"{item.moved:+.2f}", *(f"{value:+.3f}" for value in item.shift))
        for item in found.bias
    )
    heads = ("fixed parameter", "moved by", *(model.names[index] for index in found.chosen))
    caption = (
        "Bias from fixing, first subject: shift of the chosen parameters when a fixed one is "
        "elsewhere; all in halves of their ranges."
    )
    return TextTable(caption, heads, rows)


def _interval_figure(model: ParametricModel, found: StudySelection) -> Figure:
    figure = new_figure(DOUBLE_COLUMN, 2.4)
    ax = figure.subplots()
    for place, index in enumerate(found.chosen):
        widths = np.array([item.width[place] for item in found.intervals.values()])
        shown = 100 * widths / (2 * model.gain[index])
        spread = place + np.linspace(-0.2, 0.2, len(shown)) if len(shown) > 1 else [place]
        ax.plot(spread, shown, linestyle="none", marker="o", color=BLUE, markerfacecolor="white")
        ax.hlines(shown.mean(), place - 0.3, place + 0.3, color=INK, linewidth=1.5)
    ax.set_xticks(range(len(found.chosen)), [model.names[index] for index in found.chosen])
    ax.set_ylabel("interval (% of the range)")
    ax.set_ylim(bottom=0)
    return figure


def _solution_figure(model: ParametricModel, found: KeyParameters) -> Figure:
    figure = new_figure(DOUBLE_COLUMN, 2.8)
    ax = figure.subplots()
    markers = "osD^v"
    for item in found.candidates:
        if np.isnan(item.reliability):
            continue
        ax.plot(
            item.reliability,
            item.vaf,
            marker=markers[min(item.diversity, len(markers)) - 1],
            color=BLUE if item.kept else INK,
            markerfacecolor=BLUE if item.kept else "white",
            linestyle="none",
        )
    for diversity in sorted({item.diversity for item in found.candidates}):
        ax.plot(
            [], [], marker=markers[min(diversity, len(markers)) - 1], color=INK, linestyle="none",
            markerfacecolor="white", label=f"{diversity} pathways",
        )  # fmt: skip
    ax.set_xlabel("reliability, least ICC(A,k)")
    ax.set_ylabel("mean VAF (%)")
    if found.candidates:
        ax.legend(loc="best")
    return figure


def _json(model: ParametricModel, found: StudySelection, command: str) -> bytes:
    def names(subset: Sequence[int]) -> list[str]:
        return [model.names[index] for index in subset]

    intervals: dict[str, Any] = {}
    for subject, item in found.intervals.items():
        intervals[subject] = {
            name: {"value": value, "low": low, "high": high}
            for name, value, low, high in zip(
                item.names, item.value, item.low, item.high, strict=True
            )
        }
    content = {
        "selected": {
            "fim": names(found.chosen),
            "lasso": names(found.lasso_common),
            "nelder_mead": {key: names(item.selected) for key, item in found.nelder_mead.items()},
        },
        "common": names(sorted(set(found.chosen) & set(found.lasso_common))),
        "intersection": [names(subset) for subset in found.intersection],
        "intervals": intervals,
        "vaf": {
            "nominal": {item.name: item.nominal.vaf for item in found.subjects},
            "fim": {key: item.vaf for key, item in found.refits.items()},
            "lasso": {
                key: None if item.refit is None else item.refit.vaf
                for key, item in found.lasso.items()
            },
        },
        "seconds": found.seconds,
        "rank": {item.name: item.information.rank for item in found.subjects},
        "unseen_scalings": {item.name: item.scalings for item in found.subjects},
        "unseen": {
            item.name: [direction.shares for direction in item.unseen] for item in found.subjects
        },
        "sweep": [
            {"bound": item.bound, "size": item.size, "subsets": [names(s) for s in item.subsets]}
            for item in found.worst_case
        ],
        "command": command,
    }
    return (json.dumps(plain(content), indent=1, allow_nan=False) + "\n").encode()


def _names(model: ParametricModel, subset: Sequence[int]) -> str:
    return ", ".join(model.names[index] for index in subset)


def _sd(values: np.ndarray[Any, np.dtype[np.float64]]) -> float:
    return float(np.std(values, ddof=1)) if len(values) > 1 else float("nan")


def _csv(table: TextTable) -> bytes:
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(table.heads)
    writer.writerows(table.rows)
    return stream.getvalue().encode()
