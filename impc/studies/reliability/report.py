"""The report of a reliability study: page, tables as CSV, result.json, figures.

Its tables are counterparts of tables 2.2 to 2.6.
"""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np
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
    summary = (
        f"{len(result.subjects)} subjects, {len(result.visits)} visits, conditions "
        f"{', '.join(result.conditions)}; passband {result.band.low:.2f} to "
        f"{result.band.high:.2f} Hz, {len(result.band.excited)} excited frequencies."
    )
    # One visit has no reliability: a table of dashes says less than the sentence above it.
    shown = _TABLES if len(result.visits) > 1 else {"1. The visit": ("visits-rms", "visits-energy")}
    shown_names = [name for names in shown.values() for name in names]
    sections = [
        *(
            Section(title, [*([] if number else [_VISITS]), *(tables[name] for name in names)])
            for number, (title, names) in enumerate(shown.items())
        ),
        Section("4. Pictures", _PICTURES),
        Section("5. The dissertation's findings, looked for here", (Lines(found),), folded=True),
        Section("6. Versions", (Markup("<code>{}</code>").format(command),), folded=True),
    ]
    said = answer(result)
    return Report(
        "impc reliability",
        "Reliability of a test",
        (Verdict(said[0]), *((Lines(said[1:]),) if said[1:] else ()), summary, *result.notes),
        sections,
        figures=reliability_figures(trials, result),
        beside=[one for name, one in tables.items() if name not in shown_names],
        data=_data(result),
        provenance=Provenance(command=command, inputs=inputs),
        words=[(name, "A condition of this study.") for name in result.conditions],
    )


def _data(result: Reliability) -> dict[str, Any]:
    return {
        "passband": {"low": result.band.low, "high": result.band.high},
        "dissertation": [asdict(item) for item in findings(result)],
        "notes": result.notes,
    }


_NUMBERS = {"rms": "2.2", "energy": "2.3"}
_VISIT_TABLES = {"rms": "2.5", "energy": "2.6"}


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
        found, error = item.icc, item.error
        row: dict[str, Any] = {"condition": item.condition, "output": item.output}
        if found is not None and error is not None:
            row |= {
                "icc": found.value,
                "low": found.low,
                "high": found.high,
                "reliability": interval_band(found.low, found.high),
                "sem": factor * error.sem,
                "mdc": factor * error.mdc,
                "unit": unit,
                "subjects": found.subjects,
            }
        rows.append(row | {"notes": "; ".join(item.notes)})
    caption = (
        f"Counterpart of table {_NUMBERS[measure]}: between-visit reliability of "
        f"{MEASURES[measure]}, ICC(A,k) of the mean over visits with its generalised 95 % "
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
            row |= {
                "change_per_visit": factor * item.trend.slope,
                "change_low": factor * item.trend.low,
                "change_high": factor * item.trend.high,
                "p_change": item.trend.p,
            }
        rows.append(row)
    caption = (
        f"Counterpart of table {_VISIT_TABLES[measure]}: {MEASURES[measure]} across visits, mean "
        "and SD of the subjects; repeated-measures analysis of variance, uncorrected and after "
        "Greenhouse and Geisser; change from visit to visit with its 95 % interval."
    )
    return Finding(f"visits-{measure}", pd.DataFrame(rows), caption, digits=3)


def _components(own: Sequence[MeasureResult], measure: str) -> Finding:
    rows = [
        {
            "condition": item.condition,
            "output": item.output,
            "unit": f"({shown_score(item)[1]})²",
            "variance_of": f"{part.name}s",
            **{
                name: shown_score(item)[0] ** 2 * float(getattr(part, name))
                for name in ("value", "low", "high")
            },
        }
        for item in own
        for part in item.components
    ]
    caption = f"Variance of subjects, visits and trials behind {MEASURES[measure]}, 95 % intervals."
    return Finding(f"components-{measure}", pd.DataFrame(rows), caption, digits=3)


def _correlations(result: Reliability) -> Finding:
    rows = []
    for item in result.cmc:
        (within, sd_within), (between, sd_between) = map(_mean_sd, (item.within, item.between))
        rows.append(
            (item.condition, item.output, within, sd_within, between, sd_between, item.undefined)
        )
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
        for pair in item.pairs:
            rows.append((item.condition, item.output, MEASURES[item.measure],
                         f"{pair.second} - {pair.first}", factor * float(pair.difference), unit,
                         float(pair.p), float(pair.p_holm)))  # fmt: skip
    heads = ["condition", "output", "measure", "visits", "difference", "unit", "p", "p_holm"]
    caption = "Paired t between visits, without and with Holm's correction."
    return Finding("pairs", pd.DataFrame(rows, columns=heads), caption, digits=3)


def _quoted() -> Finding:
    rows = [
        (_VISIT_TABLES[measure], MEASURES[measure], condition, lower, upper)
        for measure, conditions in QUOTED.items()
        for condition, (lower, upper) in conditions.items()
    ]
    heads = ["table", "measure", "condition", "p_lower_body", "p_upper_body"]
    caption = (
        "Quoted from the dissertation, of its own subjects and not of these: the p-values of its "
        "tables 2.5 and 2.6 that survive."
    )
    return Finding("dissertation", pd.DataFrame(rows, columns=heads), caption)


def _mean_sd(values: Array) -> tuple[float, float]:
    known = values[np.isfinite(values)]
    mean = float(np.mean(known)) if len(known) else np.nan
    return mean, float(np.std(known, ddof=1)) if len(known) > 1 else np.nan
