"""The report of a reliability study: page, tables as CSV, result.json, figures.

Tables of a reliability study: counterparts of tables 2.2 to 2.6, for page and CSV alike.
"""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup

from impc.reporting.document import Lines, Picture, Report, Section, TextTable, Verdict
from impc.reporting.provenance import Provenance
from impc.reporting.rendering import number
from impc.studies.reliability.analysis import MEASURES
from impc.studies.reliability.figures import reliability_figures
from impc.studies.reliability.findings import QUOTED, findings
from impc.studies.reliability.verdict import answer, interval_band, shown_score

if TYPE_CHECKING:
    from impc.arrays import Array
    from impc.files.inputs import Inputs
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
    tables = reliability_tables(result)
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
        tables=tables,
        data=_data(result),
        provenance=Provenance(command=command, inputs=inputs),
        words=[(name, "A condition of this study.") for name in result.conditions],
    )


def _data(result: Reliability) -> dict[str, Any]:
    found: dict[str, dict[str, Any]] = {"icc": {}, "anova": {}, "components": {}}
    for item in result.measures:
        name = f"{item.measure}.{item.output}"
        if item.icc is not None:
            told = {key: getattr(item.icc, key) for key in ("value", "low", "high", "form")}
            told |= {"subjects": item.icc.subjects, "interval": "generalised"}
            if item.error is not None:
                told |= {key: getattr(item.error, key) for key in ("sem", "mdc", "freedom")}
            found["icc"].setdefault(name, {})[item.condition] = told
        if item.anova is not None:
            test = asdict(item.anova)
            test["pairs"] = [asdict(pair) for pair in item.pairs]
            test["trend"] = None if item.trend is None else asdict(item.trend)
            found["anova"].setdefault(name, {})[item.condition] = test
        parts = {part.name: asdict(part) for part in item.components}
        found["components"].setdefault(name, {})[item.condition] = parts
    cmc: dict[str, dict[str, dict[str, float]]] = {"within": {}, "between": {}}
    for curve in result.cmc:
        for kind, values in (("within", curve.within), ("between", curve.between)):
            cmc[kind].setdefault(curve.output, {})[curve.condition] = _mean(values)
    return {
        **found,
        "cmc": cmc,
        "passband": {"low": result.band.low, "high": result.band.high},
        "findings": [asdict(item) for item in findings(result)],
        "notes": result.notes,
    }


def _mean(values: Array) -> float:
    return float(np.nanmean(values)) if np.any(np.isfinite(values)) else float("nan")


_NUMBERS = {"rms": "2.2", "energy": "2.3"}
_VISIT_TABLES = {"rms": "2.5", "energy": "2.6"}


def reliability_tables(result: Reliability) -> dict[str, TextTable]:
    """All tables by the name of their file."""
    tables = {}
    for measure in MEASURES:
        tables[f"icc-{measure}"] = _icc_table(result, measure)
        tables[f"visits-{measure}"] = _visit_table(result, measure)
        tables[f"components-{measure}"] = _component_table(result, measure)
    tables["cmc"] = _cmc_table(result)
    tables["pairs"] = _pair_table(result)
    tables["dissertation"] = _quoted_table()
    return tables


def _of(result: Reliability, measure: str) -> list[MeasureResult]:
    return [item for item in result.measures if item.measure == measure]


def _icc_table(result: Reliability, measure: str) -> TextTable:
    rows = []
    for item in _of(result, measure):
        factor, unit = shown_score(item)
        found, error = item.icc, item.error
        if found is None or error is None:
            rows.append((item.condition, item.output, "-", "-", "-", "-", "; ".join(item.notes)))
            continue
        rows.append(
            (
                item.condition,
                item.output,
                f"{found.value:.2f} ({found.low:.2f}, {found.high:.2f})".replace("nan", "-"),
                interval_band(found.low, found.high),
                f"{factor * error.sem:.3g} {unit}",
                f"{factor * error.mdc:.3g} {unit}",
                "; ".join((f"{found.subjects} subjects", *item.notes)),
            )
        )
    caption = (
        f"Counterpart of table {_NUMBERS[measure]}: between-visit reliability of "
        f"{MEASURES[measure]}, ICC(A,k) of the mean over visits with its generalised 95 % "
        "interval, which allows for few visits that differ; standard error of measurement and "
        "minimal detectable change (95 %) of the score of a single visit. The word is that of the "
        "whole interval."
    )
    heads = ("condition", "output", "ICC(A,k)", "reliability", "SEM", "MDC", "notes")
    return TextTable(caption, heads, rows)


def _visit_table(result: Reliability, measure: str) -> TextTable:
    rows = []
    for item in _of(result, measure):
        factor, unit = shown_score(item)
        scores = factor * item.scores
        cells = []
        for column in scores.T:
            known = column[np.isfinite(column)]
            spread = f" ± {np.std(known, ddof=1):.3g}" if len(known) > 1 else ""
            cells.append(f"{np.mean(known):.3g}{spread}" if len(known) else "-")
        test, trend = item.anova, item.trend
        rows.append(
            (
                item.condition,
                f"{item.output} ({unit})",
                *cells,
                "-" if test is None else number(test.p, 2),
                "-" if test is None else number(test.p_corrected, 2),
                "-"
                if trend is None
                else f"{factor * trend.slope:+.2g} ({factor * trend.low:+.2g}, "
                f"{factor * trend.high:+.2g})",
                "-" if trend is None else number(trend.p, 2),
            )
        )
    caption = (
        f"Counterpart of table {_VISIT_TABLES[measure]}: {MEASURES[measure]} across visits, mean "
        "± SD of the subjects; repeated-measures analysis of variance, uncorrected and after "
        "Greenhouse and Geisser; change from visit to visit."
    )
    visits = tuple(f"visit {name}" for name in result.visits)
    heads = ("condition", "output", *visits, "p", "p (G-G)", "change per visit", "p (change)")
    return TextTable(caption, heads, rows)


def _component_table(result: Reliability, measure: str) -> TextTable:
    rows = []
    for item in _of(result, measure):
        factor, unit = shown_score(item)
        cells = {
            part.name: f"{factor**2 * part.value:.3g} ({factor**2 * part.low:.3g}, "
            f"{factor**2 * part.high:.3g})"
            for part in item.components
        }
        names = ("subject", "visit", "trial")
        rows.append(
            (item.condition, f"{item.output} ({unit})²", *(cells.get(key, "-") for key in names))
        )
    caption = f"Variance of subjects, visits and trials behind {MEASURES[measure]}, 95 % intervals."
    return TextTable(caption, ("condition", "output", "subjects", "visits", "trials"), rows)


def _cmc_table(result: Reliability) -> TextTable:
    rows = []
    for item in result.cmc:
        cells = []
        for values in (item.within, item.between):
            known = values[np.isfinite(values)]
            spread = f" ± {np.std(known, ddof=1):.3f}" if len(known) > 1 else ""
            cells.append(f"{np.mean(known):.3f}{spread}" if len(known) else "-")
        note = f"{item.undefined} undefined" if item.undefined else ""
        rows.append((item.condition, item.output, *cells, note))
    caption = (
        "Counterpart of table 2.4: coefficient of multiple correlation of the transfer functions "
        "from perturbation to angle, mean ± SD over subjects."
    )
    return TextTable(caption, ("condition", "output", "within visits", "between visits", ""), rows)


def _pair_table(result: Reliability) -> TextTable:
    rows = []
    for item in result.measures:
        factor, unit = shown_score(item)
        for pair in item.pairs:
            rows.append(
                (
                    item.condition,
                    item.output,
                    MEASURES[item.measure],
                    f"{pair.second} - {pair.first}",
                    f"{factor * pair.difference:+.3g} {unit}",
                    number(pair.p, 2),
                    number(pair.p_holm, 2),
                )
            )
    heads = ("condition", "output", "measure", "visits", "difference", "p", "p (Holm)")
    return TextTable("Paired t between visits, without and with Holm's correction.", heads, rows)


def _quoted_table() -> TextTable:
    rows = []
    for measure, conditions in QUOTED.items():
        for condition, (lower, upper) in conditions.items():
            rows.append(
                (_VISIT_TABLES[measure], MEASURES[measure], condition, f"{lower}", f"{upper}")
            )
    caption = (
        "Quoted from the dissertation, of its own subjects and not of these: the p-values of its "
        "tables 2.5 and 2.6 that survive."
    )
    return TextTable(
        caption, ("table", "measure", "condition", "p lower body", "p upper body"), rows
    )
