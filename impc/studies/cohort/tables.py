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

from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from impc.arrays import percentiles
from impc.assess.assessments import ASSESSMENTS
from impc.model.plant import UNKNOWN
from impc.studies.cohort.study import LABELS

if TYPE_CHECKING:
    from collections.abc import Iterator

    from impc.studies.cohort.engine import Store
    from impc.studies.cohort.study import Study

_CENTRE = "analytic centre (no units)"


def cohort_tables(study: Study, store: Store) -> dict[str, pd.DataFrame]:
    """Tables by name (see the module's docstring); units without a fit are omitted."""
    found: dict[str, list[dict[str, Any]]] = {"units": [], "replicates": [], "intervals": []}
    for unit in study.units:
        fit = store.fit(unit.name)
        if fit is None:
            continue
        labels = {"unit": unit.name} | {name: getattr(unit, name) for name in LABELS}
        found["units"].append(labels | _unit_row(fit))
        drawn = []
        for index in range(study.replicates):
            again = store.fit(unit.name, index)
            if again is not None:
                own = zip(fit["parameters"], again["parameters"], strict=True)
                drawn.append(_gain(fit, "K", again["K"]) | dict(own))
                found["replicates"].append(labels | {"replicate": index + 1} | drawn[-1])
        if len(drawn) > 1:
            found["intervals"] += [labels | row for row in _intervals(fit, pd.DataFrame(drawn))]
    return {name: pd.DataFrame(rows) for name, rows in found.items()}


def _unit_row(fit: dict[str, Any]) -> dict[str, Any]:
    said = {name: fit["verdict"][name] for name in ("level", "headline", "kind")}
    row: dict[str, Any] = {**said, "trials": fit["trials"], "samples": fit["samples"]}
    for name in ASSESSMENTS:
        given = fit[name] if isinstance(fit[name], dict) else {"": fit[name]}
        row |= {f"{name}.{signal}".rstrip("."): value for signal, value in given.items()}
    row["saturated"] = fit["saturated"]
    for name in ("K", "K_deviation", "K_low", "K_high", "K_identified", "K_determined",
                 "K_of_weights"):  # fmt: skip
        row |= _gain(fit, name, fit[name])
    reported = next(iter(fit["readings"].values()))
    of_states = {"dominant": reported["dominant"], "cost_weight": np.diag(reported["Q"])}
    if _CENTRE in fit["readings"]:
        of_states["centre_weight"] = np.diag(fit["readings"][_CENTRE]["Q"])
    for name, values in of_states.items():
        row |= {f"{name}.{state}": float(one)
                for state, one in zip(fit["states"], values, strict=True)}  # fmt: skip
    row |= fit["parameters"]
    return row | structure_row(fit)


def _gain(fit: dict[str, Any], name: str, values: Any) -> dict[str, float]:
    return {
        f"{name}.{control}.{state}": value
        for control, line in zip(fit["controls"], values, strict=True)
        for state, value in zip(fit["states"], line, strict=True)
    }


def _intervals(fit: dict[str, Any], drawn: pd.DataFrame) -> Iterator[dict[str, Any]]:
    estimate = _gain(fit, "K", fit["K"]) | fit["parameters"]
    identified = _gain(fit, "K", fit["K_identified"])
    for name, values in drawn.items():
        # Along unidentified directions replicates stay at the start: their spread has no meaning.
        known = identified.get(str(name), True)
        low, high = percentiles(values, 0.95) if known else (np.nan, np.nan)
        yield {
            "name": name, "unit": fit["units"].get(name, UNKNOWN), "value": estimate[name],
            "low": float(low), "high": float(high), "level": 0.95, "replicates": len(drawn),
        }  # fmt: skip


def structure_row(fit: dict[str, Any]) -> dict[str, Any]:
    """Columns of units.csv on the structure of a `fit`; empty without a structure."""
    found = fit.get("structure")
    if found is None:
        return {}
    heads = {"log_cost_weight": "", "low": "_low", "high": "_high"}
    row: dict[str, Any] = {
        f"log_cost_weight{end}.{unknown}": or_nan(value)
        for name, end in heads.items()
        for unknown, value in zip(found["unknowns"], found[name], strict=True)
    }
    return row | {"structure_refused": bool(found["refused"]), "structure_p": or_nan(found["p"])}


def or_nan(value: float | None) -> float:
    """Replace None by NaN."""
    return float("nan") if value is None else float(value)
