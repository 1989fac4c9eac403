"""Cost weights of a unit within the structure of [fit.structure], and whether the unit refuses it.

Groups are compared in these cost weights: unlike those of any weights they need no convention
(docs/structures.md, docs/cohorts.md).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from impc.assess.structures import assess_structure
from impc.errors import SolverError, WeightsError
from impc.inverse.structured_fit import fit_structured
from impc.studies.fit.asked import fit_structures

if TYPE_CHECKING:
    from impc.inverse.estimates import Estimate
    from impc.inverse.problem import Problem
    from impc.studies.fit.settings import FitSettings


def unit_structure(
    problem: Problem, fitted: Estimate, settings: FitSettings
) -> dict[str, Any] | None:
    """Logarithms of cost weights with ends of 95 %; None where no structure is asked for."""
    if settings.structure is None:
        return None
    structure = fit_structures(problem.plant, settings)[0]
    record: dict[str, Any] = {"name": structure.name, "unknowns": structure.unknowns}
    try:
        found = fit_structured(problem, structure, fitted)
        fit = assess_structure(problem, structure, found, fitted, settings.settle, held_out=False)
    except (SolverError, WeightsError) as error:
        nothing = [np.nan] * structure.count
        ends = dict.fromkeys(("log_cost_weight", "low", "high"), nothing)
        return record | ends | {"refused": True, "p": np.nan, "reason": str(error)}
    return record | {
        "log_cost_weight": [item.value for item in fit.intervals],
        "low": [item.low for item in fit.intervals],
        "high": [item.high for item in fit.intervals],
        "refused": fit.refused,
        "p": np.nan if fit.test is None else fit.test.probability,
        "reason": "",
    }


def structure_row(fit: dict[str, Any]) -> dict[str, Any]:
    """The columns of units.csv, from the content of a `fit`; none without a structure."""
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
    """A `value` that may be missing, as JSON and pandas have it."""
    return float("nan") if value is None else float(value)
