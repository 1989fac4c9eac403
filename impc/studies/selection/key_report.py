"""The report of `impc key-parameters`: page, table, result.json, figure of the solution space."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from impc.reporting.document import Details, Lines, Report, Section, Verdict
from impc.reporting.finding import Finding, Picture
from impc.reporting.provenance import Provenance
from impc.reporting.style import BLUE, DOUBLE_COLUMN, INK, drawn, journal_style, new_figure
from impc.studies.selection.key_parameters import between_visits
from impc.studies.selection.report import command_section, names_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from impc.arrays import Array
    from impc.files.digests import Inputs
    from impc.studies.selection.key_parameters import KeyParameters
    from impc.studies.selection.model import ParametricModel


def key_report(
    model: ParametricModel, found: KeyParameters, command: str, inputs: Inputs
) -> Report:
    """Page, result.json, table and figure of `impc key-parameters`, with `command` and `inputs`."""
    chosen = names_of(model, found.chosen) if found.chosen else "none: no subset passes all filters"
    findings = [
        f"{len(found.selection.subsets)} subsets of {found.selection.size} parameters have "
        f"variances of at most {found.selection.bound:g} for every subject and visit, if the other "
        "parameters are exactly typical; so does every fit of a subset assume.",
        "A subset is kept when it also explains the recordings and is reliable between visits.",
    ]
    caption = (
        "Counterpart of figure 5.3: subsets in the space of reliability and goodness of fit; "
        "filled ones pass all filters."
    )
    with journal_style():
        figures = drawn({"solution-space": _solution_figure(found)})
    return Report(
        "impc: Key parameters",
        "Key parameters",
        (Verdict(f"Key parameters: {chosen}."), Lines(findings)),
        [
            Section("1. Estimates", (_estimates(model, found),), "Estimates", together=True),
            Section(
                "2. Subsets and filters",
                (
                    Picture("solution-space", caption, caption),
                    Details("Every subset", (_candidates(model, found), _sweep(model, found))),
                ),
                "Subsets",
            ),
            command_section(command),
        ],
        figures=figures,
        data={
            "chosen": model.named(found.chosen),
            "size": found.selection.size,
            "subsets": len(found.selection.subsets),
            "sweep": [
                {
                    "bound": item.bound,
                    "size": item.size,
                    "subsets": [model.named(subset) for subset in item.subsets],
                }
                for item in found.sweep
            ],
        },
        provenance=Provenance(command=command, inputs=inputs),
        words=model.words,
    )


def _candidates(model: ParametricModel, found: KeyParameters) -> Finding:
    rows = [
        (names_of(model, item.subset), item.variance, item.vaf, item.reliability, item.diversity,
         item.kept)
        for item in found.candidates
    ]  # fmt: skip
    heads = ["subset", "largest_variance", "mean_vaf_percent", "least_icc", "pathways", "kept"]
    caption = "Subsets and the filters that they pass, best first."
    return Finding("candidates", pd.DataFrame(rows, columns=heads), caption)


def _estimates(model: ParametricModel, found: KeyParameters) -> Finding:
    """Counterpart of tables 5.3 and 5.4: mean and SD over subjects, physical units."""
    places = {index: place for place, index in enumerate(found.chosen)}
    rows: list[dict[str, Any]] = []
    for index, name in enumerate(model.names):
        fits = [("all", found.nominal[index])]
        if index in places:
            fits.append(("chosen", found.estimates[places[index]]))
        for free, values in fits:
            row: dict[str, Any] = {"parameter": name, "unit": model.units[index], "free": free}
            row["mean"], row["sd"] = _mean_sd(values)
            if free == "chosen":
                for visit, own in enumerate(values.T, start=1):
                    row[f"mean_visit_{visit}"], row[f"sd_visit_{visit}"] = _mean_sd(own)
            icc = between_visits(values)
            ends = (np.nan,) * 3 if icc is None else (icc.value, icc.low, icc.high)
            rows.append(row | dict(zip(("icc", "icc_low", "icc_high"), ends, strict=True)))
    caption = (
        "Estimates, mean and SD over subjects, with all parameters free and with the chosen ones; "
        "ICC(A,k) between visits with its 95 % interval."
    )
    return Finding("estimates", pd.DataFrame(rows), caption, digits=3)


def _mean_sd(values: Array) -> tuple[float, float]:
    spread = float(np.nanstd(values, ddof=1)) if values.size > 1 else np.nan
    return float(np.nanmean(values)), spread


def _sweep(model: ParametricModel, found: KeyParameters) -> Finding:
    """How the first filter depends on its bound, and which parameters its subsets have."""
    rows = []
    for item in found.sweep:
        inside = Counter(index for subset in item.subsets for index in subset)
        counts = ", ".join(f"{model.names[index]} {inside[index]}" for index in sorted(inside))
        rows.append((item.bound, item.size, len(item.subsets), counts))
    heads = ["variance_bound", "size", "subsets", "in_how_many_of_them"]
    caption = "The first filter, for every subject and visit at once (5.5)."
    return Finding("sweep", pd.DataFrame(rows, columns=heads), caption)


def _solution_figure(found: KeyParameters) -> Figure:
    figure = new_figure(DOUBLE_COLUMN, 2.8)
    ax = figure.subplots()
    markers = {item.diversity: "osD^v"[min(item.diversity, 5) - 1] for item in found.candidates}
    for item in found.candidates:
        ax.plot(
            item.reliability,
            item.vaf,
            marker=markers[item.diversity],
            color=BLUE if item.kept else INK,
            markerfacecolor=BLUE if item.kept else "white",
            linestyle="none",
        )
    for diversity in sorted(markers):
        ax.plot(
            [], [], marker=markers[diversity], color=INK, linestyle="none",
            markerfacecolor="white", label=f"{diversity} pathways",
        )  # fmt: skip
    ax.set_xlabel("reliability, least ICC(A,k) (-)")
    ax.set_ylabel("mean VAF (%)")
    if found.candidates:
        ax.legend(loc="best")
    return figure
