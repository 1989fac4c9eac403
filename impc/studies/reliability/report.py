"""Report of a reliability study."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from impc.arrays import Array
from impc.assess.several_tests import holm
from impc.files.digests import Inputs
from impc.levels import Level
from impc.reporting.document import Block, Check, Checks, Copy, Report, Section, Terms
from impc.reporting.finding import Finding, Picture
from impc.reporting.provenance import Provenance
from impc.reporting.rendering import number, probability, sentence_case
from impc.reporting.verdict import Key
from impc.studies.reliability import verdict as rules
from impc.studies.reliability.analysis import (
    MEASURES,
    CmcResult,
    MeasureResult,
    Reliability,
    Trials,
)
from impc.studies.reliability.figures import reliability_figures

_HERO = Picture(
    "icc", "ICC of every measure with its interval, over bands from poor to excellent",
    "1 is perfect. A measure is called reliable if its whole interval is good or excellent. Blue: "
    "sway (RMS); grey: energy in the band of the perturbation.",
)  # fmt: skip
_BLAND_ALTMAN = Picture(
    "bland-altman", "Bland-Altman plot: difference of first and last visit over their mean",
    "One dot per person: last visit minus first (vertical) over the mean of both. Line: mean; "
    "grey: 95 % limits of agreement. A change below the smallest detectable change may be due to "
    "the error of the test alone.",
)  # fmt: skip
_RESPONSES = Picture(
    "transfer-visits", "Responses of one person at all visits",
    "One person and condition, all visits, mean over trials. The phase is left out if chance alone "
    "can reach the coherence (95 %).",
)  # fmt: skip
_METHODS = (
    "Reliability was assessed on {size} people, visits and trials. The score of a visit is the "
    "mean over its trials of the root mean square of a tilt about upright (sway), or of its energy "
    "from {low} to {high} Hz. Agreement between visits: ICC(A,k) of McGraw and Wong (1996) with "
    "the generalised 95 % interval of Tian and Cappelleri (2004). The smallest detectable change "
    "(95 %) refers to single visits and uses Student's t distribution."
)
_ICC = (
    "ICC(A,k), agreement of the mean over visits, with two 95 % intervals: generalised (Tian "
    "and Cappelleri 2004), used on this page, and F (McGraw and Wong 1996), too narrow for few "
    "and different visits. Mean and SD: over people, of the mean over visits. SEM and smallest "
    "detectable change refer to a single visit."
)
_VISITS = (
    "Mean and SD over n people; analysis of variance over visits, uncorrected and with the "
    "Greenhouse-Geisser correction; change per visit with its 95 % CI."
)
_CMC = (
    "Coefficient of multiple correlation of the responses within and between visits (1: "
    "identical curves), mean and SD over people; undefined: number of undefined coefficients."
)


def reliability_report(trials: Trials, result: Reliability, command: str, inputs: Inputs) -> Report:
    """Report of `impc reliability`."""
    tables, band, facts = reliability_findings(result), result.band, rules.Facts(result)
    people, visits, sways = facts.people, facts.visits, facts.sways
    size = f"{people} × {visits} × {max(map(len, trials.cells.values()))}"
    keys = [Key(size, "", "people × visits × trials")]
    copied: Copy | str = "There is no text to copy: no ICC could be computed."
    provenance = Provenance(command=command, inputs=inputs)
    ends = {"low": number(band.low), "high": number(band.high)}
    recordings = (
        f"{sum(map(len, trials.cells.values()))} trials of {people} people; perturbed from "
        "{low} to {high} Hz".format(**ends)
    )
    sections: dict[str, list[Block]] = {
        "Response to the perturbation": [_RESPONSES, tables["cmc"]],
        "Visits": [tables[f"visits-{measure}"] for measure in MEASURES],
        "Checks": [Checks(_checks(result, facts))],
        "Provenance": [Terms([("Recordings", recordings), *provenance.terms])],
    }
    if sways:
        keys = [*_keys(sways), *keys]
        results = "; ".join(
            f"{item.name} {item.condition}: {rules.icc_text(item)}, smallest detectable change "
            f"{rules.change_text(item)}"
            for item in sways
        )
        copied = Copy(_METHODS.format(size=size, **ends), f"{sentence_case(results)}.")
        own: list[Block] = [tables["icc-rms"], tables["icc-energy"]]
        sections = {"ICC": own, "Change of one person": [_BLAND_ALTMAN], **sections}
    return Report(
        "impc reliability", "reliability report", rules.RULES.verdict(facts),
        [Section(title, blocks) for title, blocks in sections.items()],
        meta=("Reliability", f"{people} people", f"{visits} visits", ", ".join(result.conditions)),
        hero=_HERO if sways else None,
        keys=keys,
        figures=reliability_figures(trials, result),
        copy=copied,
        beside=[] if sways else [tables["icc-rms"], tables["icc-energy"]],
        data={"passband": {"low": band.low, "high": band.high}, "notes": result.notes},
        provenance=provenance,
    )  # fmt: skip


def _keys(sways: Sequence[MeasureResult]) -> list[Key]:
    """Key numbers: lowest ICC, and smallest detectable change of a person."""
    least = rules.lowest(sways)
    value, _, interval = rules.icc_text(least).removeprefix("ICC ").partition(" ")
    change, _, unit = rules.change_text(sways[0]).partition(" ")
    return [
        Key(value, "ICC", f"lowest: {least.name}, {least.condition}",
            f"{interval.strip('()')}; ICC(A,k), generalised interval"),
        Key(change, unit, "smallest detectable change of one person",
            f"{sways[0].name}, {sways[0].condition}"),
    ]  # fmt: skip


def _checks(result: Reliability, facts: rules.Facts) -> list[Check]:
    """Checks of completeness and learning."""
    notes = dict.fromkeys(note for item in result.measures for note in item.notes)
    lacking = "; ".join([*notes, *result.notes])
    found = [Check(Level.AMBER if lacking else Level.GREEN, "Complete",
                   f"{lacking or 'All people have all visits and trials'}.")]  # fmt: skip
    tests = [item for item in facts.sways if np.isfinite(item.trend.p)]
    if tests:
        p = holm(np.array([item.trend.p for item in tests]))
        changed = [f"{item.name}, {item.condition}"
                   for item, one in zip(tests, p, strict=True) if one <= 0.05]  # fmt: skip
        said = f"No change of sway over the visits was found ({probability(min(p))} or more, "
        said += "corrected by Holm's method)."
        if changed:
            said = f"Sway changes from visit to visit: {'; '.join(changed)}."
        found.append(Check(Level.AMBER if changed else Level.GREEN, "Learning", said))
    return found


def reliability_findings(result: Reliability) -> dict[str, Finding]:
    """All findings by name."""
    found = [_correlations(result.cmc)]
    for measure in MEASURES:
        own = [item for item in result.measures if item.measure == measure]
        own.sort(key=lambda item: [one.output for one in result.measures].index(item.output))
        found += [_icc(measure, own), _visits(measure, own, result.visits)]
    return {item.name: item for item in found}


def _table(
    name: str, rows: Sequence[Mapping[str, Any]], caption: str, folded: str = "", **labels: str
) -> Finding:
    """Finding without empty columns; names of outputs and empty notes are in the files only."""
    table = pd.DataFrame(rows).dropna(axis=1, how="all")
    hidden = ["output"] + ["notes"] * ("notes" in table and not table["notes"].any())
    return Finding(name, table, caption, folded=folded, digits=3, labels=labels, hidden=hidden)


def _row(item: MeasureResult, **columns: Any) -> dict[str, Any]:
    named = {"measure": item.name, "output": item.output, "condition": item.condition}
    return named | columns


def _icc(measure: str, own: Sequence[MeasureResult]) -> Finding:
    rows = []
    for item in own:
        value, low, high, people, _ = item.icc
        mean, sd, _ = _spread(item.scores.mean(axis=1))
        rows.append(_row(
            item, icc=value, low=low, high=high, low_f=item.icc_f.low, high_f=item.icc_f.high,
            reliability=rules.interval_band(low, high) if people else None, mean=mean, sd=sd,
            sem=item.error.sem, mdc=item.error.mdc, unit=item.unit, people=people,
            notes="; ".join(item.notes),
        ))  # fmt: skip
    labels = {"low": "Low (generalised)", "high": "High (generalised)", "low_f": "Low (F)"}
    labels |= {"icc": "ICC", "high_f": "High (F)", "sem": "SEM", "sd": "SD", "people": "n (people)"}
    folded = "" if measure == "rms" else "ICC of the band energy"
    mdc = "Smallest detectable change"
    return _table(f"icc-{measure}", rows, _ICC, folded, mdc=mdc, **labels)


def _visits(measure: str, own: Sequence[MeasureResult], visits: Sequence[str]) -> Finding:
    rows = []
    for item in own:
        row = _row(item)
        for visit, column in zip(visits, item.scores.T, strict=True):
            names = f"mean_visit_{visit}", f"sd_visit_{visit}", f"n_visit_{visit}"
            row |= dict(zip(names, _spread(column), strict=True))
        (F, p, corrected), (slope, low, high, p_change) = item.anova, item.trend
        rows.append(row | {
            "unit": item.unit, "F": F, "p": p, "p_greenhouse_geisser": corrected,
            "change_per_visit": slope, "low": low, "high": high, "p_change": p_change,
        })  # fmt: skip
    labels = {f"sd_visit_{visit}": f"SD visit {visit}" for visit in visits}
    labels |= {"p_greenhouse_geisser": "p (Greenhouse-Geisser)", "p_change": "p (change)"}
    return _table(f"visits-{measure}", rows, _VISITS, f"All visits: {MEASURES[measure]}", **labels)


def _correlations(items: Sequence[CmcResult]) -> Finding:
    rows = []
    for item in items:
        (within, sd_within, _), (between, sd_between, count) = map(
            _spread, (item.within, item.between)
        )
        rows.append({
            "signal": item.signal, "output": item.output, "condition": item.condition,
            "within_visits": within, "sd_within": sd_within, "between_visits": between,
            "sd_between": sd_between, "people": count, "undefined": item.undefined,
        })  # fmt: skip
    labels = {"people": "n (people)", "sd_within": "SD within", "sd_between": "SD between"}
    return _table("cmc", rows, _CMC, "Agreement of the responses in numbers", **labels)


def _spread(values: Array) -> tuple[float, float, int]:
    """Mean, SD and number of the values that are not missing."""
    scores = pd.Series(values)
    return float(scores.mean()), float(scores.std()), int(scores.count())
