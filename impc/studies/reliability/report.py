"""The report of a reliability study: page, tables as CSV, result.json, figures.

Its tables are counterparts of tables 2.2 to 2.6.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pandas as pd
from markupsafe import Markup

from impc.reporting.document import Lines, Report, Section, Verdict
from impc.reporting.finding import Finding, Picture
from impc.reporting.provenance import Provenance
from impc.studies.reliability.analysis import MEASURES
from impc.studies.reliability.figures import reliability_figures
from impc.studies.reliability.verdict import QUOTED, answer, findings, interval_band, shown_score

if TYPE_CHECKING:
    from collections.abc import Sequence

    from impc.arrays import Array
    from impc.files.digests import Inputs
    from impc.studies.reliability.analysis import MeasureResult, Reliability, Trials

_TABLES = {
    "1. Between visits": ("icc-rms", "icc-energy", "cmc"),
    "2. Over visits": ("visits-rms", "visits-energy", "pairs", "dissertation"),
    "3. Where the variance is": ("components-rms", "components-energy"),
}
_VISIT_TABLES = {"rms": "2.5", "energy": "2.6"}
_PICTURES = (
    Picture(
        "time-series",
        "Perturbation and angles of one trial",
        "Counterpart of figure 2.3: one trial.",
    ),
    Picture(
        "spectra",
        "Power of perturbation and angles",
        "Counterpart of figure 2.4: power at the excited frequencies; the passband is shaded.",
    ),
    Picture(
        "transfer-visits",
        "Transfer functions of one subject over visits",
        "Counterpart of figure 2.5: one subject and condition, every visit.",
    ),
    Picture(
        "transfer-subjects",
        "Transfer functions of several subjects",
        "Counterpart of figure 2.6: one condition and visit, several subjects.",
    ),
)
_VISITS = Picture(
    "visits",
    "Root-mean-square of every person at every visit, one line a person",
    "A line a person, thick the mean: where lines keep their order and their height from visit to "
    "visit, the test is reliable.",
)


def reliability_report(trials: Trials, result: Reliability, command: str, inputs: Inputs) -> Report:
    """Page, result.json, tables and figures; they name the `command` and its `inputs`."""
    tables = reliability_findings(result)
    found = [
        Markup("<strong>{}:</strong> {} ({})").format(
            "Found" if item.found else "Not found", item.statement, item.numbers
        )
        for item in findings(result)
    ]
    said, band = answer(result), result.band
    summary = (
        f"{len(result.subjects)} subjects, {len(result.visits)} visits, conditions "
        f"{', '.join(result.conditions)}; passband {band.low:.2f} to {band.high:.2f} Hz, "
        f"{len(band.excited)} excited frequencies."
    )
    # One visit has no reliability: a table of dashes says less than the sentence above it.
    shown = _TABLES if len(result.visits) > 1 else {"1. The visit": ("visits-rms", "visits-energy")}
    blocks = {title: [tables.pop(name) for name in names] for title, names in shown.items()}
    first, *others = blocks
    sections = [
        Section(first, [_VISITS, *blocks[first]]),
        *(Section(title, blocks[title]) for title in others),
        Section("4. Pictures", _PICTURES),
        Section("5. The dissertation's findings, looked for here", (Lines(found),), folded=True),
        Section("6. Versions", (Markup("<code>{}</code>").format(command),), folded=True),
    ]
    return Report(
        "impc reliability",
        "Reliability of a test",
        (Verdict(said[0]), *((Lines(said[1:]),) if said[1:] else ()), summary, *result.notes),
        sections,
        figures=reliability_figures(trials, result),
        beside=list(tables.values()),
        data={
            "passband": {"low": band.low, "high": band.high},
            "dissertation": [item._asdict() for item in findings(result)],
            "notes": result.notes,
        },
        provenance=Provenance(command=command, inputs=inputs),
        words=[(name, "A condition of this study.") for name in result.conditions],
    )


def reliability_findings(result: Reliability) -> dict[str, Finding]:
    """All findings by name."""
    found = [_correlations(result), _pairs(result), _quoted()]
    for measure in MEASURES:
        own = [item for item in result.measures if item.measure == measure]
        found += [_icc(own, measure), _visits(own, measure, result), _components(own, measure)]
    return {item.name: item for item in found}


def _icc(own: Sequence[MeasureResult], measure: str) -> Finding:
    rows = []
    for item in own:
        factor, unit = shown_score(item)
        row: dict[str, Any] = {"condition": item.condition, "output": item.output}
        if item.icc is not None and item.error is not None:
            value, low, high, subjects, _ = item.icc
            row |= {"icc": value, "low": low, "high": high}
            row |= {"reliability": interval_band(low, high)}
            row |= {"sem": factor * item.error.sem, "mdc": factor * item.error.mdc}
            row |= {"unit": unit, "subjects": subjects}
        rows.append(row | {"notes": "; ".join(item.notes)})
    caption = (
        f"Counterpart of table {'2.2' if measure == 'rms' else '2.3'}: between-visit reliability "
        f"of {MEASURES[measure]}, ICC(A,k) of the mean over visits with its generalised 95 % "
        "interval, which allows for few visits that differ; standard error of measurement (SEM) "
        "and minimal detectable change (MDC, 95 %) of the score of a single visit. The word is "
        "that of the whole interval."
    )
    return Finding(f"icc-{measure}", pd.DataFrame(rows), caption, digits=3)


def _visits(own: Sequence[MeasureResult], measure: str, result: Reliability) -> Finding:
    rows = []
    for item in own:
        factor, unit = shown_score(item)
        row: dict[str, Any] = {"condition": item.condition, "output": item.output, "unit": unit}
        for visit, column in zip(result.visits, (factor * item.scores).T, strict=True):
            row[f"mean_visit_{visit}"], row[f"sd_visit_{visit}"] = _mean_sd(column)
        if item.anova is not None:
            row |= {"F": item.anova.F, "p": item.anova.p}
            row |= {"p_greenhouse_geisser": item.anova.p_corrected}
        if item.trend is not None:
            heads = ("change_per_visit", "change_low", "change_high", "p_change")
            slope, low, high, p = item.trend
            row |= zip(heads, (factor * slope, factor * low, factor * high, p), strict=True)
        rows.append(row)
    caption = (
        f"Counterpart of table {_VISIT_TABLES[measure]}: {MEASURES[measure]} across visits, mean "
        "and SD of the subjects; repeated-measures analysis of variance, uncorrected and after "
        "Greenhouse and Geisser; change from visit to visit with its 95 % interval."
    )
    return Finding(f"visits-{measure}", pd.DataFrame(rows), caption, digits=3)


def _components(own: Sequence[MeasureResult], measure: str) -> Finding:
    rows = []
    for item in own:
        factor, unit = shown_score(item)
        for name, *values in item.components:
            shown = (factor**2 * float(one) for one in values)
            rows.append((item.condition, item.output, f"({unit})²", f"{name}s", *shown))
    heads = ["condition", "output", "unit", "variance_of", "value", "low", "high"]
    table = pd.DataFrame(rows, columns=heads) if rows else pd.DataFrame()
    caption = f"Variance of subjects, visits and trials behind {MEASURES[measure]}, 95 % intervals."
    return Finding(f"components-{measure}", table, caption, digits=3)


def _correlations(result: Reliability) -> Finding:
    rows = [
        (item.condition, item.output, *_mean_sd(item.within), *_mean_sd(item.between),
         item.undefined)
        for item in result.cmc
    ]  # fmt: skip
    heads = ["condition", "output", "within_visits", "sd_within", "between_visits", "sd_between",
             "undefined"]  # fmt: skip
    caption = (
        "Counterpart of table 2.4: coefficient of multiple correlation of the transfer functions "
        "from perturbation to angle, mean and SD over subjects."
    )
    return Finding("cmc", pd.DataFrame(rows, columns=heads), caption, digits=3)


def _pairs(result: Reliability) -> Finding:
    rows = []
    for item in result.measures:
        factor, unit = shown_score(item)
        for first, second, difference, *p in item.pairs:
            visits = f"{second} - {first}"
            rows.append((item.condition, item.output, MEASURES[item.measure], visits,
                         factor * difference, unit, *p))  # fmt: skip
    heads = ["condition", "output", "measure", "visits", "difference", "unit", "p", "p_holm"]
    caption = "Paired t between visits, without and with Holm's correction."
    return Finding("pairs", pd.DataFrame(rows, columns=heads), caption, digits=3)


def _quoted() -> Finding:
    rows = [
        (_VISIT_TABLES[measure], MEASURES[measure], condition, *p)
        for measure, conditions in QUOTED.items()
        for condition, p in conditions.items()
    ]
    heads = ["table", "measure", "condition", "p_lower_body", "p_upper_body"]
    caption = (
        "Quoted from the dissertation, of its own subjects and not of these: the p-values of its "
        "tables 2.5 and 2.6 that survive."
    )
    return Finding("dissertation", pd.DataFrame(rows, columns=heads), caption)


def _mean_sd(values: Array) -> tuple[float, float]:
    known = pd.Series(values)
    return float(known.mean()), float(known.std())
