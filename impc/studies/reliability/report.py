"""All files of a reliability study: page, tables as CSV, result.json, figures."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from impc.reporting.csv_text import csv_bytes
from impc.reporting.rendering import embedded, plain, render_template
from impc.studies.reliability.figures import reliability_figures
from impc.studies.reliability.findings import findings
from impc.studies.reliability.tables import reliability_tables

if TYPE_CHECKING:
    from impc.arrays import Array
    from impc.files.inputs import Inputs
    from impc.studies.reliability.analysis import Reliability, Trials

__all__ = ["reliability_files"]


def reliability_files(
    trials: Trials, result: Reliability, command: str, inputs: Inputs
) -> dict[str, bytes]:
    """Build all files; nothing is written. They name the `command` and its `inputs`."""
    figures = reliability_figures(trials, result)
    tables = reliability_tables(result)
    pictures = {
        name.removesuffix(".png"): embedded(content)
        for name, content in figures.items()
        if name.endswith(".png")
    }
    page = render_template(
        "studies/reliability/reliability_page.html",
        summary=(
            f"{len(result.subjects)} subjects, {len(result.visits)} visits, conditions "
            f"{', '.join(result.conditions)}; passband {result.band.low:.2f} to "
            f"{result.band.high:.2f} Hz, {len(result.band.excited)} excited frequencies."
        ),
        findings=findings(result),
        notes=result.notes,
        tables=tables,
        pictures=pictures,
        command=command,
    )
    return {
        "report.html": page.encode(),
        "result.json": _json(result, command, inputs),
        **{f"{name}.csv": csv_bytes(table.heads, table.rows) for name, table in tables.items()},
        **figures,
    }


def _json(result: Reliability, command: str, inputs: Inputs) -> bytes:
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
    content = {
        **found,
        "cmc": cmc,
        "passband": {"low": result.band.low, "high": result.band.high},
        "findings": [asdict(item) for item in findings(result)],
        "notes": result.notes,
        "command": command,
        "sha256": inputs.plain(),
    }
    return (json.dumps(plain(content), indent=1, allow_nan=False) + "\n").encode()


def _mean(values: Array) -> float:
    return float(np.nanmean(values)) if np.any(np.isfinite(values)) else float("nan")
