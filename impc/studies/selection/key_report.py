"""Report of `impc key-parameters`."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import pandas as pd

from impc.arrays import Array
from impc.files.digests import Inputs
from impc.reporting.document import Copy, Report, Section, Terms
from impc.reporting.finding import Finding, Picture
from impc.reporting.provenance import Provenance
from impc.reporting.rendering import number
from impc.reporting.style import BLUE, HALF, MUTED, PAPER, new_figure
from impc.reporting.verdict import Key
from impc.studies.reliability.icc import icc
from impc.studies.selection.analysis import KeyParameters
from impc.studies.selection.model import ParametricModel
from impc.studies.selection.verdict import KEY_RULES, KeyFacts

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_OTHER = (
    "impc select asks another question: which parameters can be estimated in each person, with "
    "narrower intervals. It may name others."
)


def key_report(
    model: ParametricModel, found: KeyParameters, command: str, inputs: Inputs | None
) -> Report:
    """Report of `impc key-parameters`."""
    facts, subsets = KeyFacts(model, found), found.selection
    results = f"No parameters were shown to be repeatable (best subset: {facts.icc})."
    if facts.keys:
        results = f"Key parameters: {facts.names} ({facts.icc}, VAF "
        results += f"{number(found.candidates[0].vaf)} %)."
    copied = Copy(
        f"Subsets of {facts.size} parameters were fitted to recordings of {facts.people} people "
        f"with {facts.visits} visits, and kept if their variances were at most {subsets.bound:g} "
        "in every person and visit (unit: half the search range, squared), if they explained the "
        "recordings, and if they were repeatable between visits (lower end of the 95 % interval of "
        "ICC(A,k)). The other parameters were fixed at assumed values.",
        results,
    )
    provenance = Provenance(command=command, inputs=inputs)
    return Report(
        "impc: key parameters", "key parameter report", KEY_RULES.verdict(facts),
        [
            Section("Estimates", [_estimates(model, found)]),
            Section("Subsets", [facts.filters, _OTHER, _candidates(model, found)]),
            Section("Provenance", [Terms(provenance.terms)]),
        ],
        meta=["Key parameters", f"{facts.people} people", f"{facts.visits} visits",
              provenance.made[:10]],
        hero=Picture("solution-space", "Subsets by reliability and movement explained",
                     "Each mark is one subset of parameters; filled marks pass all filters, for "
                     "which the lower end of the ICC's interval counts."),
        keys=[
            Key(str(facts.keys), f"of {facts.size}", "key parameters", facts.names),
            *([Key(str(facts.fixed), f"of {facts.size}", "parameters fixed", "as assumed")]
              if facts.keys else []),
            Key(facts.least, "", "lowest ICC of the best subset", facts.begins),
        ],
        figures={"solution-space": partial(_draw, found)},
        copy=copied,
        data={
            "chosen": model.named(found.chosen),
            "size": subsets.size,
            "subsets": len(subsets.subsets),
            "sweep": [
                {"bound": one.bound, "size": one.size, "subsets": [*map(model.named, one.subsets)]}
                for one in found.sweep
            ],
        },
        provenance=provenance,
    )  # fmt: skip


def _candidates(model: ParametricModel, found: KeyParameters) -> Finding:
    rows = [
        (model.words(item.subset), item.variance, item.vaf, item.reliability, item.certain,
         item.diversity, item.kept)
        for item in found.candidates
    ]  # fmt: skip
    heads = ["subset", "largest_variance", "mean_vaf_percent", "least_icc", "least_icc_low",
             "pathways", "kept"]  # fmt: skip
    labels = {"mean_vaf_percent": "Mean VAF (%)", "least_icc": "Lowest ICC",
              "least_icc_low": "95 % CI from"}  # fmt: skip
    table = pd.DataFrame(rows, columns=heads)
    return Finding("candidates", table, "Subsets, best first.", labels=labels)


def _estimates(model: ParametricModel, found: KeyParameters) -> Finding:
    """Table of mean and SD over subjects, in physical units."""
    rows: list[dict[str, Any]] = []
    for index in range(model.size):
        fits = [("all", found.nominal[index])]
        if index in found.chosen:
            fits.append(("chosen", found.estimates[found.chosen.index(index)]))
        for free, values in fits:
            row: dict[str, Any] = {"parameter": model.word(index), "unit": model.units[index]}
            row |= {"free": free, **_mean_sd(values, "")}
            if free == "chosen":
                for visit, own in enumerate(values.T, start=1):
                    row |= _mean_sd(own, f"_visit_{visit}")
            value, low, high, *_ = icc(values, "A,k", "generalised")
            rows.append(row | {"icc": value, "icc_low": low, "icc_high": high})
    caption = (
        "Mean and SD over people, with all parameters free and with only the chosen ones free; "
        "ICC(A,k) between visits with its generalised 95 % interval."
    )
    labels = {"icc": "ICC", "icc_low": "95 % CI low", "icc_high": "95 % CI high", "sd": "SD"}
    labels |= {f"sd_visit_{k}": f"SD visit {k}" for k in range(1, found.nominal.shape[2] + 1)}
    return Finding("estimates", pd.DataFrame(rows), caption, labels=labels, digits=3)


def _mean_sd(values: Array, visit: str) -> dict[str, float]:
    found = pd.Series(values.ravel())
    return {f"mean{visit}": float(found.mean()), f"sd{visit}": float(found.std())}


def _draw(found: KeyParameters) -> Figure:
    figure = new_figure(HALF, 3.2)
    ax = figure.subplots()
    ax.set_title("Movement explained, mean VAF (%)")
    for item in found.candidates:
        colour = BLUE if item.kept else MUTED
        ax.plot(item.reliability, item.vaf, "o", color=colour, markersize=8,
                markerfacecolor=BLUE if item.kept else PAPER)  # fmt: skip
    ax.set_xlabel("Lowest ICC of the subset (0 to 1)")
    return figure
