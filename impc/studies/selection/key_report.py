"""The report of `impc key-parameters`: page, table, result.json, figure of the solution space."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from impc.reporting.document import (
    Details,
    Lines,
    Picture,
    Report,
    Section,
    TextTable,
    Verdict,
)
from impc.reporting.provenance import Provenance
from impc.reporting.rendering import number
from impc.reporting.style import BLUE, DOUBLE_COLUMN, INK, drawn, journal_style, new_figure
from impc.studies.selection.key_parameters import between_visits
from impc.studies.selection.report import command_section, names_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.figure import Figure

    from impc.arrays import Array
    from impc.files.inputs import Inputs
    from impc.studies.selection.key_parameters import KeyParameters
    from impc.studies.selection.model import ParametricModel


def key_report(
    model: ParametricModel, found: KeyParameters, command: str, inputs: Inputs
) -> Report:
    """Page, result.json, table and figure of `impc key-parameters`, with `command` and `inputs`."""
    candidates = _candidate_table(model, found)
    chosen = names_of(model, found.chosen) if found.chosen else "none: no subset passes all filters"
    findings = [
        f"{len(found.selection.subsets)} subsets of {found.selection.size} parameters are "
        f"estimated well enough for every subject and visit (variance at most "
        f"{found.selection.bound:g}).",
        "A subset is kept when it also explains the recordings and is reliable between visits.",
    ]
    caption = (
        "Counterpart of figure 5.3: subsets in the space of reliability and goodness of fit; "
        "filled ones pass all filters."
    )
    with journal_style():
        figures = drawn({"solution-space": _solution_figure(model, found)})
    return Report(
        "impc: Key parameters",
        "Key parameters",
        (Verdict(f"Key parameters: {chosen}."), Lines(findings)),
        [
            Section("1. Estimates", (_estimate_table(model, found),), "Estimates", together=True),
            Section(
                "2. Subsets and filters",
                (
                    Picture("solution-space", caption, caption),
                    Details("Every subset", (candidates, _sweep_table(model, found))),
                ),
                "Subsets",
            ),
            command_section(command),
        ],
        figures=figures,
        tables={"candidates": candidates},
        data=_data(model, found),
        provenance=Provenance(command=command, inputs=inputs),
        words=model.words,
    )


def _candidate_table(model: ParametricModel, found: KeyParameters) -> TextTable:
    rows = [
        (
            names_of(model, item.subset),
            number(item.variance),
            number(item.vaf, 4),
            number(item.reliability, 2),
            str(item.diversity),
            "kept" if item.kept else "",
        )
        for item in found.candidates
    ]
    heads = ("subset", "largest variance", "mean VAF %", "least ICC(A,k)", "pathways", "")
    return TextTable("Subsets and the filters that they pass, best first.", heads, rows)


def _data(model: ParametricModel, found: KeyParameters) -> dict[str, Any]:
    def names(subset: Sequence[int]) -> list[str]:
        return [model.names[index] for index in subset]

    estimates = zip(names(found.chosen), map(_icc, found.estimates), strict=True)
    return {
        "chosen": names(found.chosen),
        "size": found.selection.size,
        "subsets": len(found.selection.subsets),
        "sweep": [
            {"bound": item.bound, "size": item.size, "subsets": [names(s) for s in item.subsets]}
            for item in found.sweep
        ],
        "icc": {
            "nominal": dict(zip(model.names, map(_icc, found.nominal), strict=True)),
            "chosen": dict(estimates),
        },
        "candidates": [
            {
                "names": names(item.subset),
                "variance": item.variance,
                "vaf": item.vaf,
                "icc": item.reliability,
                "diversity": item.diversity,
                "kept": item.kept,
            }
            for item in found.candidates
        ],
    }


def _icc(values: Array) -> dict[str, float]:
    """With its 95 % interval; NaN where there is none."""
    told = between_visits(values)
    return {key: getattr(told, key, np.nan) for key in ("value", "low", "high")}


def _estimate_table(model: ParametricModel, found: KeyParameters) -> TextTable:
    """Counterpart of tables 5.3 and 5.4: mean ± SD over subjects, physical units."""
    places = {index: place for place, index in enumerate(found.chosen)}
    visits = [f"visit {number + 1}" for number in range(found.nominal.shape[2])]
    rows = []
    for index, name in enumerate(model.names):
        own = found.estimates[places[index]] if index in places else None
        rows.append(
            (
                name,
                model.units[index],
                _mean_sd(found.nominal[index]),
                _with_interval(found.nominal[index]),
                *(["fixed"] * len(visits) if own is None else map(_mean_sd, own.T)),
                "" if own is None else _with_interval(own),
            )
        )
    heads = ("parameter", "unit", "all free", "ICC, all free", *visits, "ICC")
    title = "Estimates, mean ± SD over subjects; ICC(A,k) between visits with its 95 % interval."
    return TextTable(title, heads, rows)


def _mean_sd(values: Array) -> str:
    spread = number(float(np.nanstd(values, ddof=1))) if values.size > 1 else "-"
    return f"{number(float(np.nanmean(values)))} ± {spread}"


def _with_interval(values: Array) -> str:
    value, low, high = _icc(values).values()
    return "-" if np.isnan(value) else f"{value:.2f} [{low:.2f}, {high:.2f}]"


def _sweep_table(model: ParametricModel, found: KeyParameters) -> TextTable:
    """How the first filter depends on its bound, and which parameters its subsets have."""
    rows = []
    for item in found.sweep:
        inside = [sum(index in subset for subset in item.subsets) for index in range(model.size)]
        counts = ", ".join(
            f"{name} {count}" for name, count in zip(model.names, inside, strict=True) if count
        )
        rows.append((f"{item.bound:.2f}", str(item.size), str(len(item.subsets)), counts or "-"))
    heads = ("variance bound", "size", "subsets", "in how many of them")
    return TextTable("The first filter, for every subject and visit at once (5.5).", heads, rows)


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
    ax.set_xlabel("reliability, least ICC(A,k) (-)")
    ax.set_ylabel("mean VAF (%)")
    if found.candidates:
        ax.legend(loc="best")
    return figure
