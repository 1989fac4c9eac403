"""The report of a reliability study: page, tables as CSV, result.json, figures."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup

from impc.reporting.document import Lines, Picture, Report, Section, Verdict
from impc.reporting.provenance import Provenance
from impc.studies.reliability.figures import reliability_figures
from impc.studies.reliability.findings import findings
from impc.studies.reliability.tables import reliability_tables
from impc.studies.reliability.verdict import answer

if TYPE_CHECKING:
    from impc.arrays import Array
    from impc.files.inputs import Inputs
    from impc.studies.reliability.analysis import Reliability, Trials

__all__ = ["reliability_report"]

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
