"""Report of `impc select`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import scipy

from impc.arrays import Array
from impc.files.digests import Inputs
from impc.files.disk import truth_beside
from impc.levels import Level
from impc.reporting.document import Check, Checks, Copy, Report, Section, Terms
from impc.reporting.finding import Finding, Picture
from impc.reporting.provenance import Provenance
from impc.reporting.rendering import number
from impc.reporting.style import BLUE, HALF, MUTED, RECORDED, RULE, new_figure
from impc.reporting.verdict import Key
from impc.studies.selection.analysis import StudySelection
from impc.studies.selection.fisher import unseen_scalings
from impc.studies.selection.model import ParametricModel
from impc.studies.selection.verdict import BIAS, SELECT_RULES, STUCK, SelectFacts

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_AT_LIMIT = 0.1  # Distance in % of the search range that counts as at a limit
_WIDTH = "width_percent_of_the_range"
_LABELS = {
    "low": "95 % CI low", "high": "95 % CI high", "sd": "SD between people", "value": "Estimate",
    _WIDTH: "95 % CI width (% of range)", BIAS: "Bias from fixing (% of range)",
}  # fmt: skip
_CAPTION = (
    "Blue: fitted, with 95 % intervals that allow for the SD between people in the other "
    "parameters. Grey dots: fit of all parameters; grey bars: assumed value and SD between people. "
    "One mark per person and visit; arrows: at a limit of the search."
)
_BY_SUBJECT = (
    "Estimates with 95 % intervals that allow for the SD between people in the fixed parameters. "
    "Others exact: bootstrap intervals if the fixed parameters equal their assumed values. Bias: "
    "to first order, root sum of squares over the fixed parameters, each wrong by one SD."
)
_METHODS = (
    "A model with {size} parameters was fitted to recordings of {whom} by least squares within "
    "search limits. The largest subset whose variances, by the Fisher information, are at most "
    "{bound:g} in each of them (unit: half the search range, squared) was selected. The others "
    "were fixed at assumed values; 95 % intervals allow for their SD between people."
)


def selection_report(
    model: ParametricModel,
    found: StudySelection,
    command: str,
    inputs: Inputs | None,
    truths: Mapping[str, Array],
    whom: tuple[int, int] = (1, 1),
) -> Report:
    """Report of `impc select`; `truths` (k,) by subject; `whom`: number of people and visits."""
    table = _intervals(model, found, truths)
    facts, truth, size = SelectFacts(model, found, table), _truth(table), model.size
    verdict, provenance = SELECT_RULES.verdict(facts), Provenance(command=command, inputs=inputs)
    said = [f"{whom[0]} {'person' if whom[0] == 1 else 'people'}"]
    said += [f"{whom[1]} visits"] * (whom[1] > 1)
    copied: Copy | str = "There is no text to copy: no parameter may be reported."
    if verdict.level is not Level.RED:
        results = f"{facts.estimated} of {size} parameters could be estimated ({facts.names})."
        results += f" {facts.reached} ended at the search range." * bool(facts.open_names)
        results += f" Because the others were fixed, {facts.shift}." * bool(facts.fixed)
        methods = _METHODS.format(size=size, whom=" with ".join(said), bound=found.bound)
        copied = Copy(methods, f"{results} VAF: {facts.vaf}.")
    return Report(
        "impc: parameters that can be estimated", "parameter report", verdict,
        [
            Section("Parameters", [
                Finding("parameters", _by_parameter(model, found, table),
                        "Medians over people and visits, and largest bias.", labels=_LABELS,
                        hidden=() if any(model.meanings) else ["symbol"], digits=3),
                Finding("intervals", table, _BY_SUBJECT, folded="All people in numbers",
                        labels=_LABELS, hidden=["symbol"]),
            ]),
            Section("Checks", [Checks([*_checks(model, found, facts), *truth])]),
            Section("Provenance", [Terms(provenance.terms)]),
        ],
        meta=["Selection of parameters", *said, provenance.made[:10]],
        hero=Picture("parameters", "Estimates of all parameters in their search ranges", _CAPTION),
        keys=[
            Key(str(facts.estimated), f"of {size}", "parameters estimated", facts.names),
            Key(str(facts.fixed), f"of {size}", "parameters fixed", "at assumed values"),
            Key(number(facts.worst[BIAS]) if facts.fixed else "0", "% of the search range",
                "largest bias from fixing", facts.worst["parameter"] if facts.fixed else ""),
        ],
        figures={"parameters": partial(_forest, model, found)},
        copy=copied,
        data=_data(model, found) | {"truth": truth[0].text if truth else None},
        provenance=provenance,
    )  # fmt: skip


def _checks(model: ParametricModel, found: StudySelection, facts: SelectFacts) -> list[Check]:
    scalings = dict.fromkeys(
        names
        for item in found.nominal.values()
        for names in unseen_scalings(model, item.information)
    )
    together = " ".join(
        f"These {len(names)} can all be {math.e:.1f} times larger without a change that exceeds "
        f"the noise: {model.words([model.names.index(name) for name in names])}."
        for names in scalings
    )
    good, doubt, note = Level.GREEN, Level.AMBER, Level.NOTE
    ends = (
        f"{facts.reached} end at the search range."
        if facts.open_names
        else ("All 95 % intervals are inside the search range.")
    )
    rows = [
        (good if facts.kept else doubt, "Bias from fixing",
         f"If each fixed parameter is wrong by one SD between people, {facts.shift}. The intervals "
         "allow for it." if facts.fixed else "No parameter is fixed."),
        (doubt if facts.open_names else good, "Search range",
         f"{ends} Estimates at a limit: {facts.stuck or 'none'}."),
        (Level.RED if facts.poor else good, "Movement explained", f"VAF {facts.vaf}."),
        *([(note, "Combinations", together)] if together else []),
        (note, "Another method", f"LASSO selects {model.words(found.lasso)}."),
        (note, "Another question", "impc key-parameters asks which parameters are repeatable "
         "between visits and allows wider intervals, so it may name others."),
    ]  # fmt: skip
    return [Check(*row) for row in rows]


def _by_parameter(
    model: ParametricModel, found: StudySelection, intervals: pd.DataFrame
) -> pd.DataFrame:
    table = pd.DataFrame({
        "parameter": [model.word(index) for index in range(model.size)], "symbol": model.names,
        "unit": model.units, "assumed": model.typical, "sd": model.deviation,
    }).iloc[_ordered(model, found)]  # fmt: skip
    kinds = {"value": "median", _WIDTH: "median", BIAS: "max"}
    return table.join(intervals.groupby("symbol").agg(kinds), on="symbol")


def _intervals(
    model: ParametricModel, found: StudySelection, truths: Mapping[str, Array]
) -> pd.DataFrame:
    rows: list[dict[str, Any]] = []
    for subject, item in found.chosen.items():
        bias, known, free = _bias(model, found, subject), item.known, list(found.free)
        places = np.stack([known.value, known.low, known.high]) - model.low[free]
        places *= 50 / model.gain[free]
        for place, index in enumerate(found.free):
            low, high = float(known.low[place]), float(known.high[place])
            row: dict[str, Any] = {
                "subject": subject, "parameter": model.word(index), "symbol": model.names[index],
                "unit": model.units[index], "value": float(known.value[place]), "low": low,
                "high": high, "note": note_of(*map(float, places[:, place])),
                _WIDTH: 50 * (high - low) / model.gain[index], BIAS: bias[place],
            }  # fmt: skip
            exact = [item.refit.theta[index], *item.exact[:, place]]
            for name, value in zip(("value", "low", "high"), exact, strict=True):
                row[f"others_exact_{name}"] = float(value)
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


def note_of(value: float, low: float, high: float) -> str:
    """Note on an interval that reaches an end of the search range (positions in %); else empty."""
    ends = ["lower"] * (low < _AT_LIMIT) + ["upper"] * (high > 100 - _AT_LIMIT)
    if not ends:
        return ""
    said = "not determined" if len(ends) > 1 else f"one-sided: ends at the {ends[0]} limit"
    return said + STUCK * (not _AT_LIMIT <= value <= 100 - _AT_LIMIT)


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


def _forest(model: ParametricModel, found: StudySelection) -> Figure:
    """Forest plot of all parameters in their search ranges, identifiable ones first."""
    order, people = _ordered(model, found), len(found.chosen)
    figure = new_figure(HALF, 0.8 + 0.34 * len(order))
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
        ax.text(-5, row, model.word(index), color=colour, va="center", ha="right")
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
    return {
        "selected": {"fim": names(found.free), "lasso": names(found.lasso)},
        "common": names(sorted(set(found.free) & set(found.lasso))),
        "deviation": dict(zip(model.names, model.deviation, strict=True)),
        "vaf": {
            "nominal": {key: item.fit.vaf for key, item in nominal},
            "fim": {key: item.refit.vaf for key, item in chosen},
            "lasso": {key: None if fit is None else fit.vaf for key, fit in lasso.items()},
        },
        "unseen_scalings": {key: unseen_scalings(model, item.information) for key, item in nominal},
        "subsets": [
            {"bound": item.bound, "subsets": [names(subset) for subset in item.subsets]}
            for item in found.worst_case
        ],
    }
