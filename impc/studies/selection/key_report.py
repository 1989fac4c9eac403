"""Report of `impc key-parameters`."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from impc.reporting.document import Copy, Report, Section, Terms
from impc.reporting.finding import Finding, Level, Picture
from impc.reporting.provenance import Provenance
from impc.reporting.rendering import number
from impc.reporting.style import BLUE, HALF, MUTED, PAPER, PHONE, new_figure
from impc.reporting.verdict import Claim, Key, Verdict
from impc.studies.selection.key_parameters import between_visits
from impc.studies.selection.report import names_of, said

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from impc.arrays import Array
    from impc.files.digests import Inputs
    from impc.studies.selection.key_parameters import KeyParameters
    from impc.studies.selection.model import ParametricModel


def key_report(
    model: ParametricModel, found: KeyParameters, command: str, inputs: Inputs
) -> Report:
    """Report of `impc key-parameters`."""
    names, count, subsets = names_of(model, found.chosen), len(found.chosen), found.selection
    best = found.candidates[0] if found.candidates else None
    icc = "-" if best is None else number(best.reliability, 2)
    limits = f"at most {subsets.bound:g} in every subject and visit"
    filters = (
        f"{len(subsets.subsets)} subsets of {subsets.size} parameters have a variance of {limits} "
        f"(unit: half the search range, squared); {sum(one.kept for one in found.candidates)} of "
        f"the {len(found.candidates)} refitted ones also explain the movement and are reliable "
        "between visits."
    )
    copied: Copy | str = "There is nothing to copy: no subset passes all filters."
    headline = "No subset of parameters passes all filters: precision, fit and reliability."
    verdict = Verdict(Level.AMBER, headline, "Report no parameter of this model as reliable.")
    if best is not None and count:
        headline = f"{count} of {model.size} parameters are key parameters"
        why = "The other values were assumed, and the intervals treat them as exact."
        verdict = Verdict(
            Level.AMBER, f"{headline}, if the others are as assumed.", f"They are {names}.",
            may=[Claim(f"{names[:1].upper()}{names[1:]} as key parameters.", filters)],
            may_not=[Claim("The other parameters, or estimates without the assumed values.", why)],
        )  # fmt: skip
        copied = Copy(
            f"Subsets of {model.size} parameters were kept if their variances were {limits}, if "
            "they explained the recordings, and if they were reliable between visits (ICC(A,k)). "
            "The other parameters were fixed at assumed values.",
            f"Key parameters: {names} (ICC at least {icc}, VAF {number(best.vaf)} %).",
        )
    provenance = Provenance(command=command, inputs=inputs)
    people, visits = found.nominal.shape[1:]
    return Report(
        "impc: key parameters", "key parameter report", verdict,
        [
            Section("Estimates", [_estimates(model, found)]),
            Section("Subsets", [filters, _candidates(model, found)]),
            Section("Provenance", [Terms(provenance.terms)]),
        ],
        meta=["Key parameters", f"{people} subjects", f"{visits} visits", provenance.made[:10]],
        hero=Picture("solution-space", "Subsets by reliability and movement explained",
                     "Each mark is one subset of parameters; filled marks pass all filters."),
        keys=[
            Key(str(count), f"of {model.size}", "key parameters", names),
            Key(str(model.size - count), f"of {model.size}", "parameters fixed", "as assumed"),
            Key(icc, "", "lowest ICC of the best subset", "ICC(A,k) between visits"),
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
        (names_of(model, item.subset), item.variance, item.vaf, item.reliability, item.diversity,
         item.kept)
        for item in found.candidates
    ]  # fmt: skip
    heads = ["subset", "largest_variance", "mean_vaf_percent", "least_icc", "pathways", "kept"]
    labels = {"mean_vaf_percent": "Mean VAF (%)", "least_icc": "Lowest ICC"}
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
            row: dict[str, Any] = {"parameter": said(model, index), "unit": model.units[index]}
            row |= {"free": free, **_mean_sd(values, "")}
            if free == "chosen":
                for visit, own in enumerate(values.T, start=1):
                    row |= _mean_sd(own, f"_visit_{visit}")
            icc = between_visits(values)
            ends = (np.nan,) * 3 if icc is None else (icc.value, icc.low, icc.high)
            rows.append(row | dict(zip(("icc", "icc_low", "icc_high"), ends, strict=True)))
    caption = (
        "Mean and SD over subjects, with all parameters free and with only the chosen ones free; "
        "ICC(A,k) between visits with its 95 % interval."
    )
    labels = {"icc": "ICC", "icc_low": "95 % CI low", "icc_high": "95 % CI high", "sd": "SD"}
    labels |= {f"sd_visit_{k}": f"SD visit {k}" for k in range(1, found.nominal.shape[2] + 1)}
    return Finding("estimates", pd.DataFrame(rows), caption, labels=labels, digits=3)


def _mean_sd(values: Array, visit: str) -> dict[str, float]:
    spread = float(np.nanstd(values, ddof=1)) if values.size > 1 else np.nan
    return {f"mean{visit}": float(np.nanmean(values)), f"sd{visit}": spread}


def _draw(found: KeyParameters, narrow: bool) -> Figure:
    figure = new_figure(PHONE if narrow else HALF, 3.2)
    ax = figure.subplots()
    ax.set_title("Movement explained, mean VAF (%)")
    for item in found.candidates:
        colour = BLUE if item.kept else MUTED
        ax.plot(item.reliability, item.vaf, "o", color=colour, markersize=8,
                markerfacecolor=BLUE if item.kept else PAPER)  # fmt: skip
    ax.set_xlabel("Lowest reliability of the subset, ICC(A,k) (-)")
    return figure
