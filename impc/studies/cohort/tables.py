"""Tables of a cohort for pandas, R and MATLAB, made from the results in its folder.

    units.csv       one row per unit: labels, verdict, VAF, gain and its standard errors,
                    parameters, logarithms of the cost weights within a structure
    replicates.csv  one row per replicate: labels, number, gain, parameters
    intervals.csv   one row per gain entry or parameter: percentiles of the replicates, empty if the
                    entry is not individually identified

Rows are in the order of the study, columns in the order of the plant. Run times and memory are in
the log, so that the same results give identical files.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import pandas as pd

from impc.arrays import percentiles
from impc.model.plant import UNKNOWN
from impc.studies.cohort.study import LABELS, Study
from impc.studies.cohort.tasks import Store


def cohort_tables(study: Study, store: Store) -> dict[str, pd.DataFrame]:
    """Tables by name (see the module's docstring); units without a fit are omitted."""
    found: dict[str, list[dict[str, Any]]] = {"units": [], "replicates": [], "intervals": []}
    for unit in study.units:
        fit = store.fit(unit.name)
        if fit is None:
            continue
        labels = {"unit": unit.name} | {name: getattr(unit, name) for name in LABELS}
        found["units"].append(labels | row_of(fit))
        names = [*(name for name in fit["row"] if name.startswith("K.")), *fit["parameters"]]
        drawn = []
        for index in range(study.replicates):
            again = store.fit(unit.name, index)
            if again is not None:
                values = (*np.ravel(again["K"]), *again["parameters"])
                drawn.append(dict(zip(names, values, strict=True)))
                found["replicates"].append(labels | {"replicate": index + 1} | drawn[-1])
        if len(drawn) > 1:
            found["intervals"] += [labels | row for row in _intervals(fit, pd.DataFrame(drawn))]
    return {name: pd.DataFrame(rows) for name, rows in found.items()}


def row_of(fit: Mapping[str, Any]) -> dict[str, Any]:
    """Columns of units.csv of a stored fit; missing numbers are NaN."""
    return {name: np.nan if value is None else value for name, value in fit["row"].items()}


def _intervals(fit: dict[str, Any], drawn: pd.DataFrame) -> Iterator[dict[str, Any]]:
    for name, values in drawn.items():
        # Along unidentified directions replicates stay at the start: their spread has no meaning.
        known = fit["row"].get(f"K_identified{str(name)[1:]}", True)
        low, high = percentiles(values, 0.95) if known else (np.nan, np.nan)
        unit = fit["shown"].get(name, {}).get("unit_si", UNKNOWN)
        yield {
            "name": name, "unit": unit, "value": fit["row"][name],
            "low": float(low), "high": float(high), "level": 0.95, "replicates": len(drawn),
        }  # fmt: skip
