"""The page of a subject of a cohort: a figure, agreement, gain and cost weights of each unit."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup

from impc.reporting.document import Block, Report, Section, Verdict
from impc.reporting.finding import Finding, Picture, table_of
from impc.reporting.style import drawn, journal_style
from impc.studies.cohort.figures import subject_figure
from impc.studies.cohort.study import safe_name

if TYPE_CHECKING:
    from collections.abc import Sequence

    from impc.studies.cohort.engine import Failures, Store
    from impc.studies.cohort.study import Unit


def subject_files(
    subject: str, units: list[Unit], store: Store, failures: Failures
) -> dict[str, bytes]:
    """The page of a subject and the figures on it, by path."""
    sections: list[Section] = []
    figures: dict[str, bytes] = {}
    for unit in units:
        fit = store.fit(unit.name)
        if fit is None:
            reason = failures.units.get(unit.name, "not fitted yet")
            sections.append(Section(unit.name, (f"Not fitted: {reason}",)))
            continue
        with journal_style():
            figures |= drawn({unit.name: subject_figure(fit)})
        sections.append(Section(unit.name, _unit_blocks(unit, fit, failures)))
    group = f", group {units[0].group}" if units[0].group else ""
    report = Report(
        f"impc cohort: {subject}",
        f"Subject {subject}{group}",
        (*_subject_verdict(units, store), Markup('<a href="../report.html">The cohort</a>')),
        sections,
        figures=figures,
        words=kept_words(units, store),
    )
    files = {f"sub-{safe_name(subject)}.html": report.page().encode(), **figures}
    return {f"subjects/{name}": content for name, content in files.items()}


def _subject_verdict(units: list[Unit], store: Store) -> tuple[Verdict, ...]:
    """What the fits of a subject explain, in one sentence."""
    fits = [fit for unit in units if (fit := store.fit(unit.name)) is not None]
    shares = [or_nan(value) for fit in fits for value in fit["vaf"].values()]
    if not fits or np.isnan(shares).any():
        return (Verdict("Not every recording of this subject could be explained to its end."),)
    at_bound = 100 * float(np.mean([fit["saturated"] for fit in fits]))
    return (
        Verdict(
            f"Inverse MPC accounts for {min(shares):.2f} to {max(shares):.2f} % of the outputs; "
            f"the command is at its bound for {at_bound:.1f} % of the time."
        ),
    )


def kept_words(units: Sequence[Unit], store: Store) -> list[tuple[str, str]]:
    """What the signals are, as the first unit that was fitted says."""
    fits = (store.fit(unit.name) for unit in units)
    first = next((fit for fit in fits if fit is not None), {})
    return [(name, meaning) for name, meaning in first.get("words", ())]


def _unit_blocks(unit: Unit, fit: dict[str, Any], failures: Failures) -> list[Block]:
    blocks: list[Block] = [
        Picture(
            unit.name,
            "Recorded and simulated outputs of the first trial",
            "First trial. Grey: recorded. Dashed: simulated from the disturbance alone.",
        )
    ]
    failed = len(failures.replicates.get(unit.name, {}))
    if failed:
        blocks.append(
            f"{failed} bootstrap replicates could not be fitted; the reasons are in "
            "failed_replicates of result.json."
        )
    return [
        *blocks,
        _explained(unit, fit),
        _gain(unit, fit),
        *(line for trial in fit["findings"] for line in trial),
    ]


def _explained(unit: Unit, fit: dict[str, Any]) -> Finding:
    table = table_of(
        fit["outputs"],
        {
            "output": str,
            "vaf_percent": lambda name: or_nan(fit["vaf"][name]),
            "left_out_vaf_percent": lambda name: or_nan(fit["held_out_vaf"][name]),
        },
    )
    caption = (
        f"Variance accounted for, {fit['trials']} trials; the command is at its bound for "
        f"{100 * fit['saturated']:.1f} % of the time."
    )
    return Finding(f"{unit.name}-agreement", table, caption, digits=5)


def _gain(unit: Unit, fit: dict[str, Any]) -> Finding:
    reported = next(iter(fit["readings"].values()))
    entries = [(i, j) for i in range(len(fit["controls"])) for j in range(len(fit["states"]))]
    table = table_of(
        entries,
        {
            "entry": lambda at: f"{fit['controls'][at[0]]} from {fit['states'][at[1]]}",
            "gain": lambda at: float(fit["K"][at[0]][at[1]]),
            "standard_error": lambda at: (
                or_nan(fit["K_deviation"][at[0]][at[1]])
                if fit["K_identified"][at[0]][at[1]]
                else np.nan
            ),
            "gain_of_the_weights": lambda at: float(fit["K_of_weights"][at[0]][at[1]]),
            "weight_of_the_state": lambda at: float(reported["Q"][at[1]][at[1]]),
        },
    )
    caption = (
        "Gain with standard errors (none: the recordings identify this entry only together with "
        "others), beside the gain of the reported weights; and cost weights of the weights of "
        "least "
        "condition number: a choice among all weights with the latter gain."
    )
    return Finding(f"{unit.name}-gain", table, caption)


def or_nan(value: float | None) -> float:
    """A `value` that may be missing, as JSON and pandas have it."""
    return float("nan") if value is None else float(value)
