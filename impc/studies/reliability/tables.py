"""Tables of a reliability study: counterparts of tables 2.2 to 2.6, for page and CSV alike."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from impc.reporting.document import TextTable
from impc.reporting.rendering import number
from impc.studies.reliability.analysis import MEASURES
from impc.studies.reliability.findings import QUOTED
from impc.studies.reliability.verdict import interval_band, shown_score

if TYPE_CHECKING:
    from impc.studies.reliability.analysis import MeasureResult, Reliability

__all__ = ["reliability_tables"]

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
