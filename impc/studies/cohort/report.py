"""Tables, pages and figures of a cohort, made from its folder."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from impc.errors import DataError
from impc.reporting.rendering import TextTable, embedded, number, plain, render_template
from impc.reporting.style import journal_style, render
from impc.studies.cohort.comparison import compare_cohort, measures_of
from impc.studies.cohort.figures import group_figure, memory_figure, subject_figure
from impc.studies.cohort.study import safe_name
from impc.studies.cohort.tables import cohort_tables, table_bytes

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from impc.studies.cohort.comparison import Comparison
    from impc.studies.cohort.engine import Failures
    from impc.studies.cohort.store import Store
    from impc.studies.cohort.study import Study, Unit

__all__ = ["write_report"]

_QUESTIONS = {
    "group": ("Between groups", "Hedges' g"),
    "visit": ("Between visits", "d_z"),
    "change": ("Do groups change differently from visit to visit?", "Hedges' g"),
    "reliability": ("Reliability between visits, ICC(A,1)", ""),
}


def write_report(study: Study, store: Store, failures: Failures, command: str) -> None:
    """Write units.csv, replicates.csv, intervals.csv, comparisons.csv, result.json, pages, figures.

    Parameters
    ----------
    study : Study
    store : Store
        With the results.
    failures : Failures
        What the run that has just ended could not do.
    command : str
        The pages end with it.

    Raises
    ------
    OutputError
        When a file cannot be written.
    """
    tables = cohort_tables(study, store)
    for name, table in tables.items():
        store.write(f"{name}.csv", table_bytes(table))
    try:
        compared = compare_cohort(tables["units"])
    except DataError:
        compared = ()
    rows = [item.__dict__ for item in compared]
    store.write("comparisons.csv", table_bytes(pd.DataFrame(rows)))
    subjects: dict[str, list[Unit]] = {}
    for unit in study.units:
        subjects.setdefault(unit.subject, []).append(unit)
    for subject, units in subjects.items():
        page = _subject_page(subject, units, store, failures)
        store.write(f"subjects/sub-{safe_name(subject)}.html", page.encode())
    page = _page(study, store, tables, compared, subjects, failures, command)
    store.write("report.html", page.encode())
    content = {
        "command": command,
        "units": len(study.units),
        "fitted": len(tables["units"]),
        "failed": failures.units,
        "failed_replicates": failures.replicates,
        "digests": store.digests,
        "comparisons": rows,
    }
    store.write("result.json", (json.dumps(plain(content), indent=1) + "\n").encode())


def _page(
    study: Study,
    store: Store,
    tables: dict[str, pd.DataFrame],
    compared: tuple[Comparison, ...],
    subjects: dict[str, list[Unit]],
    failures: Failures,
    command: str,
) -> str:
    pictures = {"groups": "", "memory": ""}
    with journal_style():
        if len(tables["units"]):
            measures = _most_telling(compared, tables["units"])
            pictures["groups"] = _kept(store, "groups", group_figure(tables["units"], measures))
        memory = memory_figure(store.folder / "cohort.log")
        if memory is not None:
            pictures["memory"] = _kept(store, "memory", memory)
    count = int(study.configuration.fit.get("replicates", 0))
    return render_template(
        "studies/cohort/cohort_page.html",
        summary=(
            f"{len(tables['units'])} of {len(study.units)} units of {len(subjects)} subjects were "
            f"fitted, {len(tables['replicates'])} bootstrap replicates of "
            f"{count * len(tables['units'])} done, {sum(map(len, failures.replicates.values()))} "
            "failed."
        ),
        findings=_findings(compared),
        failures=failures.lines,
        comparisons=_comparison_tables(compared),
        units=_unit_table(tables["units"]),
        subjects={subject: safe_name(subject) for subject in subjects},
        pictures=pictures,
        command=command,
    )


def _kept(store: Store, name: str, figure: Figure) -> str:
    """Write the figure as PNG and PDF; return it for the page."""
    files = render(figure)
    for kind, content in files.items():
        store.write(f"{name}.{kind}", content)
    return embedded(files["png"])


def _findings(compared: tuple[Comparison, ...]) -> list[str]:
    """Differences that stand after Holm's correction."""
    lines = []
    for item in compared:
        if np.isfinite(item.p_holm) and item.p_holm <= 0.05:
            what = f"{item.first} and {item.second}" if item.first else "groups over visits"
            effect = f", effect {item.effect:+.2f}" if np.isfinite(item.effect) else ""
            lines.append(
                f"{item.condition + ': ' if item.condition else ''}{item.measure} differs between "
                f"{what} (p = {item.p_holm:.2g} after Holm{effect})."
            )
    return lines or ["No difference between groups or visits stands after Holm's correction."]


def _most_telling(compared: tuple[Comparison, ...], units: pd.DataFrame) -> list[str]:
    """Six measures for the picture: those that differ most, else the first ones."""
    ranked = sorted(
        (item for item in compared if item.question == "group" and np.isfinite(item.p)),
        key=lambda item: item.p,
    )
    names = [item.measure for item in ranked] + list(measures_of(units))
    return list(dict.fromkeys(names))[:6]


def _comparison_tables(compared: tuple[Comparison, ...]) -> list[TextTable]:
    tables = []
    for question, (title, effect) in _QUESTIONS.items():
        rows = [_comparison_row(item) for item in compared if item.question == question]
        if not rows:
            continue
        estimate = "ICC" if question == "reliability" else "difference"
        heads = ("measure", "condition", "compared", "n", estimate, "95 %", effect or "effect")
        tables.append(TextTable(title, (*heads, "p", "p, Holm"), tuple(rows)))
    return tables


def _comparison_row(item: Comparison) -> tuple[str, ...]:
    interval = f"{number(item.low)} to {number(item.high)}" if np.isfinite(item.low) else "-"
    pair = f"{item.second} - {item.first}" if item.first else ""
    return (
        item.measure,
        item.condition,
        item.note or pair,
        str(item.n),
        number(item.estimate),
        interval,
        number(item.effect, 2),
        number(item.p, 2),
        number(item.p_holm, 2),
    )


def _unit_table(units: pd.DataFrame) -> TextTable | None:
    if not len(units):
        return None
    shown = [name for name in units.columns if name.startswith(("vaf.", "held_out_vaf."))]
    rows = tuple(
        (
            str(row["unit"]),
            str(row["group"]),
            *(number(_nan(row[name]), 4) for name in shown),
            f"{100 * row['saturated']:.1f}",
        )
        for _, row in units.iterrows()
    )
    heads = ("unit", "group", *(f"{name} %" for name in shown), "at the bound %")
    return TextTable("Every unit. units.csv has all numbers.", heads, rows)


def _subject_page(subject: str, units: list[Unit], store: Store, failures: Failures) -> str:
    sections: list[dict[str, Any]] = []
    for unit in units:
        fit = store.fit(unit.name)
        if fit is None:
            reason = failures.units.get(unit.name, "not fitted yet")
            sections.append({"name": unit.name, "reason": reason})
            continue
        with journal_style():
            picture = _kept(store, f"subjects/{unit.name}", subject_figure(fit))
        sections.append(
            {
                "name": unit.name,
                "reason": "",
                "failed": len(failures.replicates.get(unit.name, {})),
                "picture": picture,
                "tables": [_fit_table(fit), _gain_table(fit)],
                "findings": [line for trial in fit["findings"] for line in trial],
            }
        )
    group = units[0].group
    return render_template(
        "studies/cohort/subject_page.html", subject=subject, group=group, sections=sections
    )


def _fit_table(fit: dict[str, Any]) -> TextTable:
    rows = tuple(
        (
            name,
            number(_nan(fit["vaf"][name]), 5),
            number(_nan(fit["held_out_vaf"][name]), 5),
        )
        for name in fit["outputs"]
    )
    return TextTable(
        f"Variance accounted for, {fit['trials']} trials; the command stands at its bound for "
        f"{100 * fit['saturated']:.1f} % of the time.",
        ("output", "VAF %", "left out %"),
        rows,
    )


def _gain_table(fit: dict[str, Any]) -> TextTable:
    reported = next(iter(fit["readings"].values()))
    rows = []
    for i, control in enumerate(fit["controls"]):
        for j, state in enumerate(fit["states"]):
            rows.append(
                (
                    f"{control} from {state}",
                    number(fit["K"][i][j], 4),
                    number(_nan(fit["K_deviation"][i][j]), 2)
                    if fit["K_told"][i][j]
                    else "not told",
                    number(fit["K_of_weights"][i][j], 4),
                    number(reported["Q"][j][j]) if i == 0 else "",
                )
            )
    caption = (
        "Gain with standard deviations (`not told`: the recordings tell this entry only together "
        "with others), beside the gain of the reported weights; and prices of the weights of least "
        "condition number: a choice among all weights with the latter gain."
    )
    heads = ("entry", "gain", "deviation", "gain of the weights", "price of the state")
    return TextTable(caption, heads, tuple(rows))


def _nan(value: float | None) -> float:
    """A missing number, as JSON and pandas have it."""
    return float("nan") if value is None else float(value)
