"""Report of `impc select`."""

from __future__ import annotations

from collections import Counter
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pandas as pd
import scipy.stats

from impc.files.disk import truth_beside
from impc.reporting.document import Check, Checks, Copy, Report, Section, Terms
from impc.reporting.finding import Finding, Level, Picture
from impc.reporting.provenance import Provenance
from impc.reporting.rendering import number
from impc.reporting.style import BLUE, HALF, MUTED, PHONE, RECORDED, RULE, new_figure
from impc.reporting.verdict import Alert, Claim, Key, Verdict

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
_POOR, _AT_LIMIT = 50.0, 0.1  # VAF of a poor model, %; distance to a limit in the figure, %
_BIAS, _WIDTH = "bias_percent_of_the_range", "width_percent_of_the_range"
_LABELS = {
    "low": "95 % CI low", "high": "95 % CI high", "sd": "SD between people", "value": "Estimate",
    _WIDTH: "95 % CI width (% of range)", _BIAS: "Bias from fixing (% of range)",
}  # fmt: skip
_CAPTION = (
    "Blue: identifiable, with 95 % intervals that allow for the SD between people in the other "
    "parameters. Grey dots: fit of all parameters, not identifiable; grey bars: assumed value and "
    "SD between people. One mark per subject; arrows: at a limit of the search."
)
_BY_SUBJECT = (
    "Estimates with 95 % intervals that allow for the SD between people in the fixed parameters. "
    "Others exact: bootstrap intervals if the fixed parameters equal their assumed values. Bias: "
    "to first order, root sum of squares over the fixed parameters, each wrong by one SD."
)
_METHODS = (
    "A model with {size} parameters was fitted to recordings of {people} subjects by least squares "
    "within search limits. The largest subset whose variances, by the Fisher information, are at "
    "most {bound:g} in each subject (unit: half the search range, squared) was selected. The "
    "others were fixed at assumed values; 95 % intervals allow for their SD between people."
)


class _Facts(NamedTuple):
    """Phrases and numbers shared by verdict, checks and the text for a paper."""

    names: str  # Names of the identifiable parameters
    free: str  # Their number in words
    fixed: int  # Number of fixed parameters
    worst: str  # Parameter with the largest bias by fixing the others
    bias: str  # That bias, % of its search range
    shift: str  # Both in words
    kept: bool  # Whether all variances with the prior stay within the bound
    stuck: str  # Estimates at a limit of the search; empty if there are none
    vaf: str  # VAF in words
    poor: bool  # Whether the model explains less than half


def _facts(model: ParametricModel, found: StudySelection, table: pd.DataFrame) -> _Facts:
    chosen, fixed = found.chosen.values(), model.size - len(found.free)
    worst = table.sort_values(_BIAS).to_dict("records")[-1]
    bias = number(worst[_BIAS])
    narrow = all(np.all(one.known.variance <= found.bound) for one in chosen)
    ends = Counter(table.loc[table["note"].str.contains("estimate at"), "parameter"])
    every = float(np.mean([np.mean(one.fit.vaf) for one in found.nominal.values()]))
    least = float(np.mean([np.mean(one.refit.vaf) for one in chosen]))
    return _Facts(
        names_of(model, found.free), f"{len(found.free)} of {model.size} parameters", fixed,
        worst["parameter"], bias, f"{bias} % of the search range ({worst['parameter']})",
        not fixed or narrow, ", ".join(f"{name} in {one} of {len(chosen)}"
                                       for name, one in ends.items()),
        f"{number(every)} % with all parameters, {number(least)} % with the identifiable ones",
        every < _POOR,
    )  # fmt: skip


def selection_report(
    model: ParametricModel,
    found: StudySelection,
    command: str,
    inputs: Inputs,
    truths: Mapping[str, Array],
) -> Report:
    """Report of `impc select`; `truths` are the true parameters (k,) of simulated subjects."""
    table = _intervals(model, found, truths)
    facts, truth = _facts(model, found, table), _truth(table)
    fixed, people, size = facts.fixed, len(found.chosen), model.size
    provenance = Provenance(command=command, inputs=inputs)
    copied: Copy | str = "There is no text to copy: the model does not explain the movement."
    if not facts.poor:
        results = f"{facts.free} were identifiable together ({facts.names}). VAF: {facts.vaf}."
        if fixed:
            results += f" Fixing the others may bias an estimate by up to {facts.shift}."
        copied = Copy(_METHODS.format(size=size, people=people, bound=found.bound), results)
    return Report(
        "impc: parameters that can be estimated", "parameter report", _verdict(facts),
        [
            Section("Parameters", [
                Finding("parameters", _by_parameter(model, found, table),
                        "Medians over subjects, and largest bias.", labels=_LABELS,
                        hidden=() if any(model.meanings) else ["symbol"], digits=3),
                Finding("intervals", table, _BY_SUBJECT, folded="All subjects in numbers",
                        labels=_LABELS, hidden=["symbol"]),
            ]),
            Section("Checks", [Checks([*_checks(model, found, facts), *truth])]),
            Section("Provenance", [Terms(provenance.terms)]),
        ],
        meta=["Selection of parameters", f"{people} subjects", provenance.made[:10]],
        hero=Picture("parameters", "Estimates of all parameters in their search ranges", _CAPTION),
        keys=[
            Key(str(len(found.free)), f"of {size}", "parameters identifiable", facts.names),
            Key(str(fixed), f"of {size}", "parameters fixed", "at assumed values"),
            Key(facts.bias if fixed else "0", "% of the search range", "largest bias from fixing",
                facts.worst if fixed else ""),
        ],
        figures={"parameters": partial(_forest, model, found)},
        copy=copied,
        data=_data(model, found) | {"truth": truth[0].text if truth else None},
        provenance=provenance,
    )  # fmt: skip


def _verdict(facts: _Facts) -> Verdict:
    if facts.poor:
        headline = "The model explains less than half of this movement."
        return Verdict(Level.RED, headline, "Do not interpret its parameters.")
    fixed, kept, stuck = facts.fixed, facts.kept, facts.stuck
    condition = f", if the other {fixed} {'is' if fixed == 1 else 'are'} as assumed" * bool(fixed)
    shifted = " If a fixed parameter is wrong, these are biased." * (not kept)
    alert = Alert(
        Level.AMBER, "The estimates depend on parameters that were fixed",
        f"Fixing the other {fixed} may bias an estimate by up to {facts.shift}.",
        "If a subject differs from the assumed values, the estimates are biased. The intervals on "
        "this page include this error; intervals for exactly known values do not.",
        ["Report the assumed values, and the intervals on this page.",
         "Measure fixed parameters in another experiment, or use a richer movement of the target."],
    )  # fmt: skip
    may = [Claim(f"{facts.free} are identifiable together.", f"{facts.names}."),
           Claim("Their estimates, with the assumed values of the others.",
                 "With the intervals on this page.")]  # fmt: skip
    may_not = [
        (fixed, "The fixed parameters.", "Their values are assumed, not estimated."),
        (
            not kept,
            "Differences between subjects.",
            f"Fixing the others may bias estimates by up to {facts.shift}.",
        ),
        (stuck, "Estimates at a limit of the search.", f"{stuck} subjects."),
        (True, "That other parameters have no effect.", "The recordings cannot separate them."),
    ]
    return Verdict(
        Level.GREEN if kept and not stuck else Level.AMBER,
        f"{facts.free} can be estimated{condition}.",
        f"The recordings identify {facts.names} together.{shifted}",
        [] if kept else [alert], may, [Claim(text, why) for there, text, why in may_not if there],
    )  # fmt: skip


def _checks(model: ParametricModel, found: StudySelection, facts: _Facts) -> list[Check]:
    scalings = dict.fromkeys(names for item in found.nominal.values() for names in item.scalings)
    together = " ".join(
        f"Scaling {names_of(model, [model.names.index(name) for name in names])} together (by a "
        "factor of e) changes the outputs by less than their noise."
        for names in scalings
    )
    good, doubt = Level.GREEN, Level.AMBER
    return [
        Check(good if facts.kept else doubt, "Bias from fixing",
              f"Up to {facts.shift}, if each fixed parameter is wrong by one SD between people. "
              "The intervals allow for it." if facts.fixed else "No parameter is fixed."),
        Check(doubt if facts.stuck else good, "Search limits",
              f"Estimates at a limit of the search: {facts.stuck or 'none'}."),
        Check(Level.RED if facts.poor else good, "Movement explained", f"VAF {facts.vaf}."),
        *([Check(Level.NOTE, "Combinations", together)] if together else []),
        Check(Level.NOTE, "Another method", f"LASSO selects {names_of(model, found.lasso)}."),
    ]  # fmt: skip


def _by_parameter(
    model: ParametricModel, found: StudySelection, intervals: pd.DataFrame
) -> pd.DataFrame:
    table = pd.DataFrame({
        "parameter": [said(model, index) for index in range(model.size)], "symbol": model.names,
        "unit": model.units, "assumed": model.typical, "sd": model.deviation,
    }).iloc[_ordered(model, found)]  # fmt: skip
    kinds = {"value": "median", _WIDTH: "median", _BIAS: "max"}
    return table.join(intervals.groupby("symbol").agg(kinds), on="symbol")


def _intervals(
    model: ParametricModel, found: StudySelection, truths: Mapping[str, Array]
) -> pd.DataFrame:
    rows: list[dict[str, Any]] = []
    for subject, item in found.chosen.items():
        bias = _bias(model, found, subject)
        for place, index in enumerate(found.free):
            low, high = float(item.known.low[place]), float(item.known.high[place])
            row: dict[str, Any] = {
                "subject": subject, "parameter": said(model, index), "symbol": model.names[index],
                "unit": model.units[index], "value": float(item.known.value[place]), "low": low,
                "high": high, "note": _note(model, index, item.known, low, high),
                _WIDTH: 50 * (high - low) / model.gain[index], _BIAS: bias[place],
            }  # fmt: skip
            for name in ("value", "low", "high"):
                row[f"others_exact_{name}"] = float(getattr(item.exact, name)[place])
            if subject in truths:
                row["truth"] = float(truths[subject][index])
                row["inside"] = low <= row["truth"] <= high
            rows.append(row)
    return pd.DataFrame(rows)


def _bias(model: ParametricModel, found: StudySelection, subject: str) -> Array:
    """First-order bias of each estimate if all others are wrong by one SD; % of its range."""
    F, free = np.asarray(found.nominal[subject].information.F), list(found.free)
    rest = [index for index in range(model.size) if index not in free]
    moved = np.linalg.solve(F[np.ix_(free, free)], F[np.ix_(free, rest)])
    return np.asarray(50 * np.linalg.norm(moved * (model.deviation / model.gain)[rest], axis=1))


def _note(model: ParametricModel, index: int, item: PriorFit, low: float, high: float) -> str:
    """Note on an interval that reaches a search limit; else empty."""
    ends = {"lower": low <= model.low[index], "upper": high >= model.high[index]}
    if all(ends.values()):
        return _OPEN
    at = "estimate at its" if index in item.fit.at_bound else "ends at the"
    return "".join(f"one-sided: {at} {name} limit" for name, here in ends.items() if here)


def read_truths(folder: Path, model: ParametricModel) -> dict[str, Array]:
    """True parameters (k,) by subject and visit from truth.json in `folder`; empty if none."""
    known = truth_beside(folder)
    try:
        return {
            subject: np.array([values[name] for name in model.names], dtype=np.float64)
            for subject, values in known["recordings"].items()
        }
    except (AttributeError, KeyError, TypeError, ValueError):  # none, or not a file of impc
        return {}


def _truth(table: pd.DataFrame) -> list[Check]:
    """Check of the number of true values inside their intervals, if known."""
    if "truth" not in table:
        return []
    known = table.dropna(subset=["truth"])
    exact = known["truth"].between(known["others_exact_low"], known["others_exact_high"])
    few = known["inside"].sum() < scipy.stats.binom.ppf(0.01, len(known), 0.95)
    return [Check(
        Level.AMBER if few else Level.GREEN, "Known truth (simulation)",
        f"True value inside the interval: {known['inside'].sum()} of {len(known)}; "
        f"{exact.sum()} of {len(known)} if the fixed parameters are taken as exact.",
    )]  # fmt: skip


def _forest(model: ParametricModel, found: StudySelection, narrow: bool) -> Figure:
    """Forest plot of all parameters in their search ranges, identifiable ones first."""
    order, people = _ordered(model, found), len(found.chosen)
    figure = new_figure(PHONE if narrow else HALF, 0.8 + (0.47 if narrow else 0.34) * len(order))
    ax = figure.subplots()
    for row, index in enumerate(order):
        free, scale = index in found.free, 50 / model.gain[index]
        colour = BLUE if free else MUTED
        if not free:
            middle, sd = model.typical[index] - model.low[index], model.deviation[index]
            ends = np.clip([scale * (middle - sd), scale * (middle + sd)], 0, 100)
            ax.plot(ends, [row, row], color=RECORDED, linewidth=4.5)
        for k, (name, item) in enumerate(found.chosen.items()):
            height = row + 0.5 * (k + 0.5) / people - 0.25
            values = [found.nominal[name].fit.theta[index]]
            if free:
                place, known = found.free.index(index), item.known
                values = [one[place] for one in (known.value, known.low, known.high)]
            x, *ends = scale * (np.array(values) - model.low[index])
            ax.plot(ends, [height] * len(ends), color=BLUE)
            mark = "<" if x < _AT_LIMIT else ">" if x > 100 - _AT_LIMIT else "o"
            ax.plot(x, height, mark, color=colour, clip_on=False)
        x, y, side = (0, row - 0.4, "left") if narrow else (-5, row, "right")
        ax.text(x, y, said(model, index), color=colour, va="center", ha=side)
    ax.vlines([0, 100], -0.5, len(order) - 0.5, color=RULE, linewidth=0.8, zorder=0)
    ax.set(xlim=(-4, 104), ylim=(len(order) - 0.5, -0.7), yticks=[])
    ax.set_xlabel("Position in the search range (%)")
    ax.spines["left"].set_visible(False)
    return figure


def _ordered(model: ParametricModel, found: StudySelection) -> list[int]:
    return [*found.free, *(index for index in range(model.size) if index not in found.free)]


def _data(model: ParametricModel, found: StudySelection) -> dict[str, Any]:
    names, chosen, nominal = model.named, found.chosen.items(), found.nominal.items()
    lasso = {key: item.lasso.refit for key, item in chosen}
    tables = {key: item.nelder_mead for key, item in chosen if item.nelder_mead is not None}
    return {
        "selected": {
            "fim": names(found.free),
            "lasso": names(found.lasso),
            "nelder_mead": {key: names(item.selected) for key, item in tables.items()},
        },
        "common": names(sorted(set(found.free) & set(found.lasso))),
        "deviation": dict(zip(model.names, model.deviation, strict=True)),
        "seconds": dict(found.seconds),
        "vaf": {
            "nominal": {key: item.fit.vaf for key, item in nominal},
            "fim": {key: item.refit.vaf for key, item in chosen},
            "lasso": {key: None if fit is None else fit.vaf for key, fit in lasso.items()},
        },
        "unseen_scalings": {key: item.scalings for key, item in nominal},
        "subsets": [
            {"bound": item.bound, "subsets": [names(subset) for subset in item.subsets]}
            for item in found.worst_case
        ],
    }


def said(model: ParametricModel, index: int) -> str:
    """Meaning of a parameter in words, or its name."""
    meaning = model.meanings[index] if model.meanings else ""
    return meaning or model.names[index].replace("_", " ")


def names_of(model: ParametricModel, subset: Sequence[int]) -> str:
    """Parameters of a subset in words, separated by commas."""
    return ", ".join(said(model, index) for index in subset)
