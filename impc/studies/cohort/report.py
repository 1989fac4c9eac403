"""Tables, page and figures of a cohort, made from its folder."""

from __future__ import annotations

from operator import attrgetter
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
from markupsafe import Markup

from impc.files.checks import FELL
from impc.reporting.document import Lines, Report, Section, Verdict
from impc.reporting.finding import Finding, Picture, table_of
from impc.reporting.provenance import Provenance
from impc.reporting.style import drawn, journal_style
from impc.reporting.writer import write_files
from impc.studies.cohort.comparison import (
    compare_cohort,
    measure_words,
    measures_of,
    not_identified,
    only_identified,
    unidentified_sentences,
)
from impc.studies.cohort.figures import group_figure
from impc.studies.cohort.study import safe_name
from impc.studies.cohort.subject_page import described_signals, subject_files
from impc.studies.cohort.tables import cohort_tables

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from impc.studies.cohort.comparison import Comparison
    from impc.studies.cohort.engine import Failures, Store
    from impc.studies.cohort.study import Study, Unit

_QUESTIONS = {
    "group": "between groups",
    "visit": "between visits",
    "change": "change from visit to visit",
    "mixed": "between groups, over all visits (mixed model of the cost weights)",
    "reliability": "reliability between visits",
}
_COMPARED = (
    "Gains are what the recordings give. Cost weights are {}. Holm's correction is over the "
    "measures of one question."
)
_WITHIN = "those of the structure, compared in their logarithms"
_CENTRE = (
    "those of the analytic centre of all weights with the same gain: a choice, the same for every "
    "subject"
)
_NUMBERS = ("n", "estimate", "low", "high", "effect", "p", "p_holm", "note")
_RUN = Markup(
    "<code>{}</code>. units.csv, replicates.csv, intervals.csv and comparisons.csv hold all "
    "numbers, cohort.log the times."
)
_GROUPS = Picture(
    "groups",
    "Measures of every unit by group",
    "Every unit, by group, visits from left to right; a line joins those of one person. Bars are "
    "means. The measures that differ most.",
)


def write_report(study: Study, store: Store, failures: Failures, command: str) -> None:
    """Write the tables, result.json, pages and figures of a study."""
    tables = cohort_tables(study, store)
    units = tables["units"]
    compared = compare_cohort(units)
    subjects: dict[str, list[Unit]] = {}
    for unit in study.units:
        subjects.setdefault(unit.subject, []).append(unit)
    for subject, own in subjects.items():
        # One after the other: the figures of a thousand subjects would fill the memory.
        write_files(store.folder, subject_files(subject, own, store, failures))
    signals = described_signals(study.units, store)
    figures = _figures(units, compared, signals.get("units", {}))
    left_out = {name: n for name, n in not_identified(units).items() if name in measures_of(units)}
    said = [
        *_findings(compared),
        *_structure_lines(units),
        *unidentified_sentences(left_out, len(units)),
        *_limits(units),
        *_falls(study.units, store, failures),
    ]
    count = int(study.configuration.fit.get("replicates", 0))
    summary = (
        f"{len(units)} of {len(study.units)} units of {len(subjects)} subjects were fitted, "
        f"{len(tables['replicates'])} bootstrap replicates of {count * len(units)} done, "
        f"{sum(map(len, failures.replicates.values()))} failed."
    )
    report = Report(
        "impc cohort",
        f"Groups and visits of {len(subjects)} subjects",
        (Verdict(said[0]), *((Lines(said[1:]),) if said[1:] else ()), summary),
        [
            *([Section("Not fitted", (Lines(failures.lines),))] if failures.lines else ()),
            Section(
                "1. Groups and visits",
                [
                    _COMPARED.format(_WITHIN if "structure_refused" in units.columns else _CENTRE),
                    *([_GROUPS] if figures else []),
                    *([_comparison(compared)] if compared else []),
                ],
            ),
            Section("2. Subjects", [_links(subjects), *_unit_findings(units)]),
            Section("3. The run", [_RUN.format(command)]),
        ],
        figures=figures,
        provenance=Provenance(command=command),
        words=signals.get("words", ()),
        data={
            "units": len(study.units),
            "fitted": len(units),
            "failed": failures.units,
            "failed_replicates": failures.replicates,
            "digests": store.digests,
            "not_identified": left_out,
        },
        beside=[Finding(name, table) for name, table in tables.items()],
    )
    write_files(store.folder, report.files())


def _links(subjects: Iterable[str]) -> str:
    return Markup(", ").join(
        Markup('<a href="subjects/sub-{}.html">{}</a>').format(safe_name(name), name)
        for name in subjects
    )


def _unit_findings(units: pd.DataFrame) -> list[Finding]:
    """How much of every unit is explained; its weights within the structure, where one is asked."""
    if not len(units):
        return []
    shown = [name for name in units.columns if name.startswith(("vaf.", "held_out_vaf."))]
    explained = units[["unit", "group", *shown]].assign(
        at_the_bound_percent=100 * units["saturated"]
    )
    found = [Finding("agreement", explained, "Every unit. units.csv has all numbers.")]
    penalised = [name for name in units.columns if name.startswith("log_cost_weight.")]
    if penalised:
        word = np.where(units["structure_refused"], "refused", "holds")
        cost_weights = units[["unit", "group"]].assign(structure=word)
        for name in penalised:
            label = name.removeprefix("log_cost_weight.")
            for end in ("", "_low", "_high"):
                logarithm = units[f"log_cost_weight{end}.{label}"].astype(float)
                cost_weights[f"{label}{end}"] = np.exp(logarithm.fillna(-np.inf))
        caption = (
            "Cost weights within the structure, with one for the first command, and their "
            "intervals of 95 %; it holds where the recordings do not refuse it."
        )
        found.append(Finding("cost_weights", cost_weights, caption, digits=3))
    return found


def _findings(compared: tuple[Comparison, ...]) -> list[str]:
    """Differences that stand after Holm's correction; of logarithms as factors."""
    lines = []
    for item in compared:
        if not item.p_holm <= 0.05:
            continue
        effect = f", effect {item.effect:+.2f}" if np.isfinite(item.effect) else ""
        significance = f"p = {item.p_holm:.2g} after Holm{effect}"
        kind, _, feature = item.measure.partition(".")
        if kind == "log_cost_weight" and item.question in ("group", "visit", "mixed"):
            factor, low, high = (f"{np.exp(x):.2g}" for x in (item.estimate, item.low, item.high))
            over = " over all visits" if item.question == "mixed" else ""
            line = (
                f"the cost weight of {feature} is {factor} times as high in {item.second} as in "
                f"{item.first}{over} (95 %: {low} to {high}; {significance})."
            )
        else:
            what = f"{item.first} and {item.second}" if item.first else "groups over visits"
            line = f"{measure_words(item.measure)} differs between {what} ({significance})."
        line = f"{item.condition}: {line}" if item.condition else line
        lines.append(line[0].upper() + line[1:])
    return lines or ["No difference between groups or visits stands after Holm's correction."]


def _structure_lines(units: pd.DataFrame) -> list[str]:
    """Whether the structure holds, unit by unit."""
    if "structure_refused" not in units.columns:
        return []
    refused = int(np.sum(units["structure_refused"]))
    penalised = [name for name in units.columns if name.startswith("log_cost_weight.")]
    absent = np.isnan(units[penalised].to_numpy()) & np.isfinite(units[["structure_p"]].to_numpy())
    zero = int(np.sum(np.any(absent, axis=1)))
    lines = [
        f"The structure of the weights is refused by the recordings of {refused} of {len(units)} "
        "units; at 5 % one in twenty would be by chance."
    ]
    if zero:
        lines.append(
            f"{zero} units want a cost weight of zero somewhere: it has no logarithm, and they "
            "are not in the comparison of that cost weight."
        )
    return lines


def _limits(units: pd.DataFrame) -> list[str]:
    """What those units say of the limit that never reach it."""
    never = int(np.sum(units["saturated"] == 0)) if len(units) else 0
    if not never:
        return []
    return [
        f"{never} of {len(units)} units never reach the limit of their command: they cannot say "
        "inverse MPC from inverse LQR, nor where the limit is."
    ]


def _falls(units: Sequence[Unit], store: Store, failures: Failures) -> list[str]:
    """Trials that were left out because the subject fell, and what that does to a comparison."""
    fallen: dict[str, int] = {}
    for unit in units:
        fit, group = store.fit(unit.name), unit.group or "all"
        all_fell = FELL in failures.units.get(unit.name, "")
        kept = 0 if all_fell else len(unit.files) if fit is None else int(fit["trials"])
        fallen[group] = fallen.get(group, 0) + len(unit.files) - kept
    counts = ", ".join(f"{lost} of group {group}" for group, lost in sorted(fallen.items()))
    if not any(fallen.values()):
        return []
    return [
        f"Trials in which the subject fell are left out ({counts}). Where one group falls more "
        "often than another, what is left may understate how the groups differ: compare the "
        "numbers of falls as well."
    ]


def _figures(
    units: pd.DataFrame, compared: tuple[Comparison, ...], names: Mapping[str, str]
) -> dict[str, bytes]:
    measures = _most_telling(compared, units) if len(units) else []
    with journal_style():
        shown = only_identified(units)
        return drawn({"groups": group_figure(shown, measures, names)} if measures else {})


def _most_telling(compared: tuple[Comparison, ...], units: pd.DataFrame) -> list[str]:
    """Six measures for the picture: those that differ most, else the first ones."""
    ranked = sorted(
        (item for item in compared if item.question == "group" and np.isfinite(item.p)),
        key=lambda item: item.p,
    )
    names = [item.measure for item in ranked] + list(measures_of(units))
    return [name for name in dict.fromkeys(names) if units[name].notna().any()][:6]


def _comparison(compared: tuple[Comparison, ...]) -> Finding:
    table = table_of(
        compared,
        {
            "question": lambda item: _QUESTIONS[item.question],
            "measure": lambda item: measure_words(item.measure),
            "condition": attrgetter("condition"),
            "compared": lambda item: f"{item.second} - {item.first}" if item.first else "",
            **{name: attrgetter(name) for name in _NUMBERS},
        },
    )
    caption = (
        "Difference of means, or ICC(A,1) of the reliability, with its interval of 95 %; effect: "
        "Hedges' g between groups and of changes, d_z between visits."
    )
    return Finding("comparisons", table, caption, digits=3)
