"""Report of a cohort: tables, pages and figures, made from the results in its folder."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
from markupsafe import Markup

from impc.checking import replace
from impc.files.checks import FELL
from impc.levels import Level
from impc.reporting.document import Block, Check, Checks, Copy, Lines, Report, Section, Terms
from impc.reporting.exchange import long_finding, long_rows
from impc.reporting.finding import Finding, Picture
from impc.reporting.provenance import Provenance
from impc.reporting.rendering import number, sentence_case
from impc.reporting.verdict import Key, Verdict
from impc.reporting.writer import write_files
from impc.studies.cohort.figures import forest, subject_figure
from impc.studies.cohort.results import Cohort, cohort_tables, row_of
from impc.studies.cohort.study import Study, Unit, safe_name
from impc.studies.cohort.tasks import Failures, Store
from impc.studies.cohort.unit_result import LOGARITHM
from impc.studies.cohort.verdict import RULES
from impc.studies.fit.facts import between

_BESIDE = {
    "units": "All numbers of every fit, angles in radians.",
    "replicates": "Gain and parameters of every bootstrap replicate, angles in radians.",
    "intervals": "Percentiles of the bootstrap replicates.",
}
_QUESTIONS = {
    "group": "between groups",
    "visit": "between visits",
    "condition": "between conditions",
    "change": "change per visit, between groups",
    "reliability": "ICC(A,1) between visits",
}
_METHODS = (
    "The recordings of {people} people were analysed by inverse model predictive control, one fit "
    "for each person, visit and condition. Means over people are those of a random-effects "
    "meta-analysis: each fit counts by the inverse of its variance plus the variance between "
    "people (DerSimonian and Laird), with robust standard errors (HC2) and Satterthwaite's degrees "
    "of freedom. Groups were compared on the means of people over their visits (effect size: "
    "Hedges' g), visits and conditions by the differences of each person (Cohen's d). "
    "P-values were corrected by Holm's method over the measures of one question."
)
#: Name of a level -> badge of a fit in a table, and the level; worst last.
_BADGES = {
    "green": ("Ready", Level.GREEN),
    "amber": ("Check", Level.AMBER),
    "red": ("Do not report", Level.RED),
}
_HOME = Markup('<a href="../report.html">All subjects</a>')
_INTERVAL = {"low": "95 % CI low", "high": "95 % CI high"}
_CURVES = "First trial. Grey: recorded. Blue: model, simulated from the perturbation."


def write_report(
    study: Study, store: Store, failures: Failures, command: str, *, pdf: bool = False
) -> Report:
    """Write the tables, result.json, pages and figures of a study."""
    tables, subjects = cohort_tables(study, store), dict[str, list["Unit"]]()
    for unit in study.units:
        subjects.setdefault(unit.subject, []).append(unit)
    for subject, own in subjects.items():
        # Written one by one: the pages of a thousand subjects would fill the memory.
        page = _subject_page(subject, own, store, failures)
        write_files(store.folder, {_address(subject): page.page().encode()})
    fits = filter(None, (store.fit(unit.name) for unit in study.units))
    first: dict[str, Any] = next(fits, {"shown": {}})
    cohort = Cohort(tables["units"], first["shown"], failures.units, study.reference)
    known = {name: cohort.units.get(f"K_determined{name[1:]}") for name in cohort.measures}
    unknown = {name: len(one) - int(one.sum()) for name, one in known.items() if one is not None}
    data = {
        "units": len(study.units),
        "fitted": len(cohort.units),
        "failed": failures.units,
        "failed_replicates": failures.replicates,
        "digests": store.digests,
        "not_determined": {name: count for name, count in unknown.items() if count},
        "outliers": list(cohort.units["unit"][cohort.far.notna()]) if cohort.outliers else [],
    }
    beside = [Finding(name, table, _BESIDE[name]) for name, table in tables.items()]
    report = _page(study, cohort, _checks(study, failures, cohort), command)
    units = {name: one["unit_si"] for name, one in first["shown"].items()}
    long = [
        line for row in tables["units"].to_dict("records") for line in long_rows(row, units, row)
    ]
    report = replace(report, data=data, beside=[*beside, long_finding(long)])
    write_files(store.folder, report.files(pdf=pdf))
    return report


def _page(study: Study, cohort: Cohort, checks: Sequence[Check], command: str) -> Report:
    """Report of a cohort."""
    verdict, name = RULES.verdict(cohort), cohort.of(cohort.measure)["name"]
    people = len({unit.subject for unit in study.units})
    provenance = Provenance(command=command)
    recordings = f"{sum(len(unit.files) for unit in study.units)} files of {people} people"
    compared: list[Block] = [comparisons(cohort)] if cohort.compared else []
    copied: Copy | str = "There is no comparison to copy."
    if cohort.lead is not None:
        others = " ".join(f"{claim.text} {claim.why}" for claim in verdict.may[1:])
        without = cohort.without_warned() if verdict.alerts else ""
        results = f"{verdict.headline} {verdict.sentence} {others}{without}".strip()
        copied = Copy(_METHODS.format(people=people), results)
    caption = (
        "One row per fit, with its 95 % CI if there is one. Grey band: mean of the people with its "
        "95 % CI; a fit with a wide interval counts little. Lines that reach the edge go on. "
        "Hollow: not determined. Square: far from the others of its group, look at this fit."
    )
    alternative = f"{sentence_case(name)} of every person, by group, with intervals"
    return Report(
        "impc cohort", "cohort report", verdict,
        [
            Section("Comparisons", compared or ["None: there is one group and one visit only."]),
            Section("Subjects", [subjects(study, cohort)]),
            Section("Checks", [Checks(checks)]),
            Section("Provenance", [Terms([("Recordings", recordings), *provenance.terms])]),
        ],
        meta=("Cohort", f"{people} people", f"{len(study.units)} fits requested"),
        hero=Picture("people", alternative, caption) if name else None,
        keys=_keys(cohort),
        figures={"people": partial(forest, cohort)} if name else {},
        copy=copied,
        provenance=provenance,
    )  # fmt: skip


def _address(subject: str) -> str:
    return f"subjects/sub-{safe_name(subject)}.html"


def _keys(cohort: Cohort) -> list[Key]:
    (name, known, of), fits = cohort.determined, len(cohort.units)
    keys = []
    if cohort.lead is not None:
        value, ends, unit = cohort.amount(cohort.lead)
        what = f"difference, {cohort.of(cohort.lead.measure)['name']}"
        keys = [Key(value, unit, what, f"95 % CI {ends}")]
    if name:
        keys.append(Key(f"{known} of {of}", "people", f"{name} determined", "others count little"))
    return [*keys, Key(f"{cohort.warned} of {fits}", "fits", "with a warning", "see Subjects")]


def comparisons(cohort: Cohort) -> Finding:
    """Table of all comparisons; logarithms are shown as ratios."""
    rows = []
    for item in cohort.compared:
        own, column = np.array([item.estimate, item.low, item.high]), cohort.of(item.measure)
        ends, unit, si = cohort.shown(item.measure, own), column["unit"], column["unit_si"]
        if item.question == "reliability":
            ends, unit, si = own, "-", "-"
        elif item.measure.startswith(LOGARITHM):
            unit = "ratio"
        rows.append({
            "measure": column["name"], "question": _QUESTIONS[item.question],
            "condition": item.condition,
            "compared": f"{item.second} - {item.first}" if item.first else "",
            **dict(zip(("difference", "low", "high"), map(float, ends), strict=True)),
            "unit": unit, "n": item.n, "sd_between": item.between * column["scale"],
            "effect": item.effect, "p": item.p, "p_holm": item.p_holm, "note": item.note,
            "difference_si": item.estimate, "low_si": item.low, "high_si": item.high, "unit_si": si,
        })  # fmt: skip
    table = pd.DataFrame(rows)
    weights = (
        "Cost weights are those of the structure, compared as ratios."
        if "structure_refused" in cohort.units.columns
        else "Central cost weights are a convention, the same for all people: compare gains first."
    )
    caption = (
        "Difference of means (second minus first) or ICC(A,1), with 95 % CI. n: number of people. "
        "SD: how much people differ, without the uncertainty of their fits. Effect: Hedges' g; "
        "between visits or conditions Cohen's d of the differences. p_holm: corrected over the "
        f"measures of one question. {weights}"
    )
    heads = ("question", "condition", "compared", "note")
    return Finding(
        "comparisons", table, caption, digits=3,
        folded="All comparisons in numbers" if len(table) > 12 else "",
        labels={**_INTERVAL, "p_holm": "p_holm", "sd_between": "SD between people"},
        hidden=[
            *(name for name in heads if table[name].nunique() < 2),
            *("difference_si", "low_si", "high_si", "unit_si"),
        ],
    )  # fmt: skip


def subjects(study: Study, cohort: Cohort) -> Finding:
    """Table of all units with a badge and a link to their pages."""
    column, signals = cohort.of(cohort.measure), {
        name: f"{one['signal']}, VAF (%)" for name, one in cohort.columns.items()
        if name.startswith("vaf.")
    }  # fmt: skip
    name, unit = column["name"], column["unit"]
    found = cohort.units.join(cohort.ends).assign(far=cohort.far) if name else cohort.units
    made = {row["unit"]: row for row in found.to_dict("records")}
    rows = [_subject_row(one, made.get(one.name), cohort) for one in study.units]
    heads = ["subject", "group", "visit", "condition", "verdict", "value", "low", "high",
             "determined", *signals, "at_limit_percent", "why"]  # fmt: skip
    table = pd.DataFrame(rows, columns=heads)
    table.insert(5, "measure", name)
    table.insert(9, "unit", unit)
    si = [f"{head}_si" for head in ("value", "low", "high")]
    table[si] = table[["value", "low", "high"]].astype(float) / column["scale"]
    table["unit_si"] = column["unit_si"]
    plain = [one for one in ("group", "visit", "condition", "why") if table[one].nunique() < 2]
    return Finding(
        "subjects", table,
        "All subjects and visits; click a heading to sort. Determined: the recordings identify "
        "the gain, and its 95 % interval is not wider than the gain itself.",
        digits=4,
        labels={**signals, **_INTERVAL, "value": f"{name} ({unit})",
                "at_limit_percent": "At limit (% of time)"},
        hidden=["measure", "unit", *si, "unit_si", *plain],
        links={one.subject: _address(one.subject) for one in study.units},
        badges=dict(_BADGES.values()) | {"Not fitted": Level.RED},
    )  # fmt: skip


def _subject_row(unit: Unit, own: Mapping[Any, Any] | None, cohort: Cohort) -> dict[str, Any]:
    """Row of a unit from its own row in the table of results."""
    row = {head: getattr(unit, head) for head in ("subject", "group", "visit", "condition")}
    if own is None:
        return row | {"verdict": "Not fitted", "why": cohort.failed.get(unit.name, "")}
    why = [] if own["level"] == Level.GREEN.value else [own["headline"]]
    if np.isfinite(own["far"]):
        why.append(f"Look at it: a gain is {own['far']:.2g} times its group's median.")
    at_limit = 100 * float(own["saturated"])
    verdict, _ = _BADGES[own["level"]]
    found = {**own, **row, "verdict": verdict, "at_limit_percent": at_limit}
    return found | {"why": " ".join(why)}


def _checks(study: Study, failures: Failures, cohort: Cohort) -> list[Check]:
    """Checks over all fits; amber if they restrict what may be reported."""
    units, total, warned = cohort.units, len(study.units), cohort.warned
    fits, (name, known, of) = len(units), cohort.determined
    never = int(np.sum(units["saturated"] == 0)) if fits else 0
    refused = int(units.get("structure_refused", pd.Series(dtype=bool)).sum())
    drawn = fits * study.replicates
    lost = sum(map(len, failures.replicates.values()))
    fallen = _fallen(study, failures, cohort)
    cases = (
        (True, fits == total, "Fits", f"{fits} of {total} fits are complete."),
        (True, not warned, "Warnings", f"{warned} of {fits} fits have a warning."),
        (name, known == of, "Determined",
         f"The {name} is determined in {known} of {of} people; the others count little."),
        (fits, not cohort.outliers, "Outliers",
         f"{cohort.outliers} of {fits} fits are far from the others of their group."),
        (never, None, "Limit",
         f"{never} of {fits} fits never reach the torque limit, so they cannot check it."),
        ("structure_refused" in units.columns, refused <= 0.1 * fits, "Structure",
         f"Rejected in {refused} of {fits} fits; at a level of 5 %, one in 20 is expected by "
         "chance."),
        (drawn, not lost, "Bootstrap",
         f"{drawn - lost} of {drawn} bootstrap replicates are complete, {lost} failed."),
        (not fallen, True, "Falls", "No person fell in any trial."),
        (fallen, False, "Falls",
         f"Trials with a fall were left out ({fallen}). If one group falls more often, the other "
         "trials may understate the difference between groups: also compare the numbers of "
         "falls."),
    )  # fmt: skip
    levels = {True: Level.GREEN, False: Level.AMBER, None: Level.NOTE}
    return [Check(levels[passed], head, said) for there, passed, head, said in cases if there]


def _fallen(study: Study, failures: Failures, cohort: Cohort) -> str:
    """Number of trials with a fall in each group: "2 in group a"; empty without a fall."""
    rows = cohort.units.to_dict("records")
    kept, lost = {row["unit"]: row["trials"] for row in rows}, Counter[str]()
    for unit in study.units:
        all_fell = FELL in failures.units.get(unit.name, "")
        left = kept.get(unit.name, 0 if all_fell else len(unit.files))
        lost[unit.group or "all"] += len(unit.files) - left
    groups = sorted(lost.items()) if lost.total() else []
    return ", ".join(f"{count} in group {group}" for group, count in groups)


def _subject_page(subject: str, units: list[Unit], store: Store, failures: Failures) -> Report:
    """Report of one subject, with a section for each visit and condition."""
    fits = {unit.name: fit for unit in units if (fit := store.fit(unit.name)) is not None}
    sections, first = [], next(iter(fits), "")
    for unit in units:
        title = ", ".join(filter(None, (unit.visit and f"Visit {unit.visit}", unit.condition)))
        blocks: list[Block] = [f"Not fitted: {failures.units.get(unit.name, 'not fitted yet')}."]
        if unit.name in fits:
            shown = Picture(unit.name, "Recorded and modelled outputs", _CURVES)
            blocks = [*([shown] if unit.name != first else []), *_blocks(unit, fits[unit.name])]
        sections.append(Section(title or "Fit", blocks))
    verdict = Verdict(Level.RED, "No recording of this subject could be fitted.", "")
    if fits:  # verdict of the fit with the worst level
        worst = max((fit["verdict"] for fit in fits.values()),
                    key=lambda one: [*_BADGES].index(one["level"]))  # fmt: skip
        verdict = Verdict(Level(worst["level"]), worst["headline"], worst["sentence"])
    group = [f"Group {units[0].group}"] if units[0].group else []
    return Report(
        f"impc cohort: {subject}", "subject report", verdict, sections,
        meta=(_HOME, f"Subject {subject}", *group, f"{len(fits)} of {len(units)} fits"),
        hero=Picture(first, "Recorded and modelled outputs", _CURVES) if first else None,
        keys=_subject_keys(fits[first]) if first else (),
        figures={name: partial(subject_figure, fit) for name, fit in fits.items()},
    )  # fmt: skip


def _subject_keys(fit: Mapping[str, Any]) -> list[Key]:
    row = row_of(fit)
    least, name = min((value, name) for name, value in row.items() if name.startswith("vaf."))
    words = fit["shown"][name]["signal"]
    return [
        Key(number(least, 4), "%", "explained (VAF)", f"lowest: {words}"),
        Key(number(100 * row["saturated"]), "% of the time", "at the torque limit"),
        *(Key(number(one["gain"]), one["unit"], f"gain on {one['state']}",
              f"95 % CI {between(one['low'], one['high'])}")
          for one in _gains(fit) if one["determined"]),
    ][:3]  # fmt: skip


def _blocks(unit: Unit, fit: Mapping[str, Any]) -> list[Block]:
    row, explained = row_of(fit), []
    for name, column in fit["shown"].items():
        if name.startswith("vaf."):
            held_out = row[f"held_out_{name}"]
            left_out = f" (left-out trials: {number(held_out, 4)} %)"
            said = f"{number(row[name], 4)} % of {column['signal']}"
            explained.append(said + left_out * bool(np.isfinite(held_out)))
    gains = pd.DataFrame(_gains(fit))
    notes = [line for trial in fit["findings"] for line in trial]
    shares = " and ".join(explained)
    return [
        f"{row['headline']} Explained in {row['trials']} trials (VAF): {shares}.",
        Finding(f"{unit.name}-gain", gains, "Feedback gain.", digits=3, labels=_INTERVAL,
                hidden=["control"] if gains["control"].nunique() < 2 else []),
        *([Lines(notes)] if notes else []),
    ]  # fmt: skip


def _gains(fit: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Entries of the gain with a meaning, in shown units."""
    row, rows = row_of(fit), []
    for name, column in fit["shown"].items():
        if name.startswith("K.") and not column["inner"]:
            entry = name.removeprefix("K")
            ends = {end: column["scale"] * row[f"K_{end}{entry}"] for end in ("low", "high")}
            rows.append({
                "state": column["signal"], "control": column["control"],
                "gain": column["scale"] * row[name], **ends, "unit": column["unit"],
                "determined": bool(row[f"K_determined{entry}"]),
            })  # fmt: skip
    return rows
