"""The page of a subject of a cohort: a figure, agreement, gain and cost weights of each unit."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from markupsafe import Markup

from impc.reporting.document import Block, Report, Section, Verdict
from impc.reporting.finding import Finding, Picture, table_of
from impc.reporting.style import drawn, journal_style
from impc.studies.cohort.figures import subject_figure
from impc.studies.cohort.study import safe_name
from impc.studies.cohort.tables import or_nan

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
    fits = []
    for unit in units:
        fit = store.fit(unit.name)
        if fit is None:
            reason = failures.units.get(unit.name, "not fitted yet")
            sections.append(Section(unit.name, (f"Not fitted: {reason}",)))
            continue
        fits.append(fit)
        with journal_style():
            figures |= drawn({unit.name: subject_figure(fit)})
        sections.append(Section(unit.name, _unit_blocks(unit.name, fit, failures)))
    group = f", group {units[0].group}" if units[0].group else ""
    shares = [or_nan(value) for fit in fits for value in fit["vaf"].values()]
    verdict = "Not every recording of this subject could be explained to its end."
    if fits and not np.isnan(shares).any():
        at_bound = 100 * float(np.mean([fit["saturated"] for fit in fits]))
        verdict = (
            f"Inverse MPC accounts for {min(shares):.2f} to {max(shares):.2f} % of the outputs; "
            f"the command is at its bound for {at_bound:.1f} % of the time."
        )
    report = Report(
        f"impc cohort: {subject}",
        f"Subject {subject}{group}",
        (Verdict(verdict), Markup('<a href="../report.html">The cohort</a>')),
        sections,
        figures=figures,
        words=described_signals(units, store).get("words", ()),
    )
    files = {f"sub-{safe_name(subject)}.html": report.page().encode(), **figures}
    return {f"subjects/{name}": content for name, content in files.items()}


def described_signals(units: Sequence[Unit], store: Store) -> dict[str, Any]:
    """The fit of the first unit that has one: what its signals are, and their units."""
    return next((fit for unit in units if (fit := store.fit(unit.name)) is not None), {})


def _unit_blocks(name: str, fit: dict[str, Any], failures: Failures) -> list[Block]:
    failed = len(failures.replicates.get(name, {}))
    lost = (
        f"{failed} bootstrap replicates could not be fitted; the reasons are in "
        "failed_replicates of result.json."
    )
    return [
        Picture(
            name,
            "Recorded and simulated outputs of the first trial",
            "First trial. Grey: recorded. Dashed: simulated from the disturbance alone.",
        ),
        *([lost] if failed else []),
        _explained(name, fit),
        _gain(name, fit),
        *(line for trial in fit["findings"] for line in trial),
    ]


def _explained(unit: str, fit: dict[str, Any]) -> Finding:
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
    return Finding(f"{unit}-agreement", table, caption, digits=5)


def _gain(unit: str, fit: dict[str, Any]) -> Finding:
    Q = next(iter(fit["readings"].values()))["Q"]
    rows = []
    for i, control in enumerate(fit["controls"]):
        for j, state in enumerate(fit["states"]):
            known = fit["K_identified"][i][j]
            error = or_nan(fit["K_deviation"][i][j]) if known else np.nan
            rows.append((f"{control} from {state}", fit["K"][i][j], error,
                         fit["K_of_weights"][i][j], Q[j][j]))  # fmt: skip
    heads = ["entry", "gain", "standard_error", "gain_of_the_weights", "weight_of_the_state"]
    caption = (
        "Gain with standard errors (none: the recordings identify this entry only together with "
        "others), beside the gain of the reported weights; and cost weights of the weights of "
        "least condition number: a choice among all weights with the latter gain."
    )
    return Finding(f"{unit}-gain", pd.DataFrame(rows, columns=heads), caption)
