"""Report of a reliability study."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from impc.assess.several_tests import holm
from impc.errors import DataError
from impc.reporting.document import Check, Checks, Copy, Report, Section, Terms
from impc.reporting.finding import Finding, Level, Picture
from impc.reporting.provenance import Provenance
from impc.reporting.rendering import number, probability, sentence_case
from impc.reporting.verdict import Key
from impc.studies.reliability.analysis import MEASURES
from impc.studies.reliability.anova import learning_trend
from impc.studies.reliability.figures import reliability_figures
from impc.studies.reliability.icc import complete_rows, icc
from impc.studies.reliability.verdict import (
    change_text,
    icc_text,
    interval_band,
    known,
    lowest,
    measure_name,
    reliability_verdict,
    shown_score,
    word_of,
)

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from impc.arrays import Array
    from impc.files.digests import Inputs
    from impc.reporting.document import Block
    from impc.studies.reliability.analysis import MeasureResult, Reliability, Trials

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


def reliability_report(trials: Trials, result: Reliability, command: str, inputs: Inputs) -> Report:
    """Report of `impc reliability`."""
    words, tables, band = trials.words, reliability_findings(trials, result), result.band
    people, visits = len(result.subjects), len(result.visits)
    size = f"{people} × {visits} × {max(map(len, trials.cells.values()))}"
    sways = [item for item in known(result) if item.measure == "rms"]
    keys = [Key(size, "", "people × visits × trials")]
    copied: Copy | str = "There is no text to copy: no ICC could be computed."
    provenance = Provenance(command=command, inputs=inputs)
    ends = {"low": number(band.low), "high": number(band.high)}
    recordings = (
        f"{sum(map(len, trials.cells.values()))} trials of {people} people; perturbed from "
        "{low} to {high} Hz".format(**ends)
    )
    sections: dict[str, list[Block]] = {
        "Conditions": [tables["conditions"]] if len(result.conditions) > 1 else [],
        "Response to the perturbation": [_RESPONSES, tables["cmc"]],
        "Visits": [one for name, one in tables.items()
                   if name.startswith(("visits", "components")) and one.rows],
        "Checks": [Checks(_checks(result, words))],
        "Provenance": [Terms([("Recordings", recordings), *provenance.terms])],
    }  # fmt: skip
    if sways:
        keys = [*_keys(sways, words), *keys]
        results = "; ".join(
            f"{measure_name(item, words)} {item.condition}: {icc_text(item)}, smallest detectable "
            f"change {change_text(item)}"
            for item in sways
        )
        copied = Copy(_METHODS.format(size=size, **ends), f"{sentence_case(results)}.")
        own: list[Block] = [tables["icc-rms"], tables["icc-energy"]]
        sections = {"ICC": own, "Change of one person": [_BLAND_ALTMAN], **sections}
    return Report(
        "impc reliability", "reliability report", reliability_verdict(result, words),
        [Section(title, blocks) for title, blocks in sections.items() if blocks],
        meta=("Reliability", f"{people} people", f"{visits} visits", ", ".join(result.conditions)),
        hero=_HERO if sways else None,
        keys=keys,
        figures=reliability_figures(trials, result),
        copy=copied,
        beside=[] if sways else [one for name, one in tables.items() if name[:4] == "icc-"],
        data={"passband": {"low": band.low, "high": band.high}, "notes": result.notes},
        provenance=provenance,
    )  # fmt: skip


def _keys(sways: Sequence[MeasureResult], words: Mapping[str, str]) -> list[Key]:
    """Key numbers: lowest ICC, and smallest detectable change of a person."""
    least = lowest(sways)
    value, _, interval = icc_text(least).removeprefix("ICC ").partition(" ")
    change, _, unit = change_text(sways[0]).partition(" ")
    return [
        Key(value, "ICC", f"lowest: {measure_name(least, words)}, {least.condition}",
            f"{interval.strip('()')}; ICC(A,k), generalised interval"),
        Key(change, unit, "smallest detectable change of one person",
            f"{measure_name(sways[0], words)}, {sways[0].condition}"),
    ]  # fmt: skip


def _checks(result: Reliability, words: Mapping[str, str]) -> list[Check]:
    """Checks of completeness and learning."""
    notes = dict.fromkeys(note for item in result.measures for note in item.notes)
    lacking = "; ".join([*notes, *result.notes])
    found = [Check(Level.AMBER if lacking else Level.GREEN, "Complete",
                   f"{lacking or 'All people have all visits and trials'}.")]  # fmt: skip
    tests = [item for item in known(result) if item.measure == "rms" and item.trend is not None]
    if tests:
        p = holm(np.array([item.trend.p for item in tests if item.trend]))
        changed = [f"{measure_name(item, words)}, {item.condition}"
                   for item, one in zip(tests, p, strict=True) if one <= 0.05]  # fmt: skip
        said = f"No change of sway over the visits was found ({probability(min(p))} or more, "
        said += "corrected by Holm's method)."
        if changed:
            said = f"Sway changes from visit to visit: {'; '.join(changed)}."
        found.append(Check(Level.AMBER if changed else Level.GREEN, "Learning", said))
    return found


def reliability_findings(trials: Trials, result: Reliability) -> dict[str, Finding]:
    """All findings by name."""
    words = trials.words
    found = [_correlations(result, words), _conditions(result, words)]
    for measure in MEASURES:
        own = [item for item in result.measures if item.measure == measure]
        own.sort(key=lambda item: result.outputs.index(item.output))
        found += [_icc(measure, own, words), _visits(measure, own, words, result.visits),
                  _components(measure, own, words)]  # fmt: skip
    return {item.name: item for item in found}


def _table(
    name: str, rows: Sequence[Mapping[str, Any]], caption: str, folded: str = "", **labels: str
) -> Finding:
    """Finding whose names of outputs and empty notes are in the files only."""
    table = pd.DataFrame(rows)
    hidden = ["output", *(["notes"] if "notes" in table and not table["notes"].any() else [])]
    return Finding(name, table, caption, folded=folded, digits=3, labels=labels, hidden=hidden)


def _row(item: MeasureResult, words: Mapping[str, str], **shown: float) -> dict[str, Any]:
    """Common columns of a row, and numbers in the shown unit of the score."""
    factor, unit = shown_score(item)
    row = {"measure": measure_name(item, words), "output": item.output}
    scaled: dict[str, Any] = {name: factor * value for name, value in shown.items()}
    return row | {"condition": item.condition} | (scaled | {"unit": unit} if shown else {})


def _icc(measure: str, own: Sequence[MeasureResult], words: Mapping[str, str]) -> Finding:
    rows = []
    for item in own:
        row = _row(item, words)
        if item.icc is not None and item.error is not None:
            (value, low, high, people, _), other = item.icc, icc(item.scores, "A,k")
            row |= {"icc": value, "low": low, "high": high, "low_f": other.low}
            row |= {"high_f": other.high, "reliability": interval_band(low, high)}
            mean, sd, _ = _mean_sd(np.mean(complete_rows(item.scores)[0], axis=1))
            row |= _row(item, words, mean=mean, sd=sd, sem=item.error.sem, mdc=item.error.mdc)
            row |= {"people": people}
        rows.append(row | {"notes": "; ".join(item.notes)})
    caption = (
        "ICC(A,k), agreement of the mean over visits, with two 95 % intervals: generalised (Tian "
        "and Cappelleri 2004), used on this page, and F (McGraw and Wong 1996), too narrow for few "
        "and different visits. Mean and SD: over people, of the mean over visits. SEM and smallest "
        "detectable change refer to a single visit."
    )
    labels = {"low": "Low (generalised)", "high": "High (generalised)", "low_f": "Low (F)"}
    labels |= {"icc": "ICC", "high_f": "High (F)", "sem": "SEM", "sd": "SD", "people": "n (people)"}
    folded = "" if measure == "rms" else "ICC of the band energy"
    mdc = "Smallest detectable change"
    return _table(f"icc-{measure}", rows, caption, folded, mdc=mdc, **labels)


def _visits(
    measure: str, own: Sequence[MeasureResult], words: Mapping[str, str], visits: Sequence[str]
) -> Finding:
    rows = []
    for item in own:
        spread: dict[str, float] = {}
        counts: dict[str, int] = {}
        for visit, column in zip(visits, item.scores.T, strict=True):
            mean, sd, counts[f"n_visit_{visit}"] = _mean_sd(column)
            spread |= {f"mean_visit_{visit}": mean, f"sd_visit_{visit}": sd}
        row = _row(item, words, **spread) | counts
        if item.anova is not None:
            row |= {"F": item.anova.F, "p": item.anova.p}
            row |= {"p_greenhouse_geisser": item.anova.p_corrected}
        if item.trend is not None:
            slope, low, high, p = item.trend
            row |= _row(item, words, change_per_visit=slope, low=low, high=high) | {"p_change": p}
        rows.append(row)
    caption = (
        "Mean and SD over n people; analysis of variance over visits, uncorrected and with the "
        "Greenhouse-Geisser correction; change per visit with its 95 % CI."
    )
    labels = {f"sd_visit_{visit}": f"SD visit {visit}" for visit in visits}
    labels |= {"p_greenhouse_geisser": "p (Greenhouse-Geisser)", "p_change": "p (change)"}
    return _table(f"visits-{measure}", rows, caption, f"All visits: {MEASURES[measure]}", **labels)


def _conditions(result: Reliability, words: Mapping[str, str]) -> Finding:
    """Paired comparison of all conditions with the first, means over visits."""
    rows, first = [], result.conditions[0]
    for output in result.outputs:
        items = [one for one in result.measures if (one.measure, one.output) == ("rms", output)]
        means = [pd.DataFrame(one.scores).mean(axis=1).to_numpy(float) for one in items]
        for item, own in zip(items[1:], means[1:], strict=True):
            try:
                change, low, high, p = learning_trend(np.column_stack([means[0], own]))
            except DataError:
                change, low, high, p = (np.nan,) * 4
            mean, sd, count = _mean_sd(own)
            row = _row(item, words, mean=mean, sd=sd, difference=change, low=low, high=high)
            rows.append(row | {"people": count, "against": first, "p": p})
    for row, corrected in zip(rows, holm(np.array([row["p"] for row in rows])), strict=True):
        row["p_holm"] = float(corrected)
    caption = (
        "Sway in each condition minus that in the first, means over visits; paired t-test over "
        "people with 95 % CI; the second p is corrected over all rows by Holm's method."
    )
    return _table("conditions", rows, caption, p_holm="p, corrected", sd="SD", people="n (people)")


def _components(measure: str, own: Sequence[MeasureResult], words: Mapping[str, str]) -> Finding:
    rows = []
    for item in own:
        factor, unit = shown_score(item)
        for name, *values in item.components:
            value, low, high = factor**2 * np.array(values)
            numbers = {"value": value, "low": low, "high": high, "unit": f"({unit})²"}
            rows.append(_row(item, words) | {"variance_of": f"{name}s", **numbers})
    caption = "Variance of people, visits and trials, with 95 % CI."
    return _table(f"components-{measure}", rows, caption, f"Components: {MEASURES[measure]}")


def _correlations(result: Reliability, words: Mapping[str, str]) -> Finding:
    rows: list[dict[str, Any]] = []
    for item in result.cmc:
        within, sd_within, _ = _mean_sd(item.within)
        between, sd_between, count = _mean_sd(item.between)
        rows.append({
            "signal": word_of(item.output, words), "output": item.output,
            "condition": item.condition, "within_visits": within, "sd_within": sd_within,
            "between_visits": between, "sd_between": sd_between, "people": count,
            "undefined": item.undefined,
        })  # fmt: skip
    caption = (
        "Coefficient of multiple correlation of the responses within and between visits (1: "
        "identical curves), mean and SD over people; undefined: number of undefined coefficients."
    )
    labels = {"people": "n (people)", "sd_within": "SD within", "sd_between": "SD between"}
    return _table("cmc", rows, caption, "Agreement of the responses in numbers", **labels)


def _mean_sd(values: Array) -> tuple[float, float, int]:
    """Mean, SD and number of the values that are not missing."""
    scores = pd.Series(values)
    return float(scores.mean()), float(scores.std()), int(scores.count())
