"""result.json of the example: everything that the table and the page say, for other programs."""

from __future__ import annotations

import json
import platform
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

from impc.example import BOUND, HORIZON, STEPS
from impc.inverse_mpc import AUXILIARY_CONDITION_WEIGHT, CONDITION_WEIGHT

if TYPE_CHECKING:
    from collections.abc import Sequence

    from impc.example import CaseResult, MethodResult
    from impc.identifiability import Identifiability

__all__ = ["example_json", "example_result", "settings", "versions"]

_PACKAGES = ("impc", "casadi", "numpy", "scipy", "control", "numba", "clarabel", "matplotlib")


def example_json(cases: Sequence[CaseResult]) -> str:
    """The text of result.json. A value that is not finite would be an error, not a `NaN`."""
    return json.dumps(example_result(cases), indent=1, allow_nan=False) + "\n"


def example_result(cases: Sequence[CaseResult]) -> dict[str, Any]:
    """The content of result.json; values that do not apply to a method are left out."""
    return {
        "cases": {case.name: _case(case) for case in cases},
        "settings": settings(),
        "versions": versions(),
    }


def settings() -> dict[str, float]:
    """What was chosen for the example."""
    return {
        "bound": BOUND,
        "horizon": HORIZON,
        "steps": STEPS,
        "condition_weight": CONDITION_WEIGHT,
        "auxiliary_condition_weight": AUXILIARY_CONDITION_WEIGHT,
    }


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that make the numbers."""
    return {"python": platform.python_version()} | {name: version(name) for name in _PACKAGES}


def _case(case: CaseResult) -> dict[str, Any]:
    return {
        "x0": case.x0.tolist(),
        "branch": case.branch,
        "truth": {"x": case.truth.x.tolist(), "u": case.truth.u.tolist()},
        "methods": {method.name: _method(method) for method in case.methods},
        "identifiability": _identifiability(case.identifiability),
    }


def _method(method: MethodResult) -> dict[str, Any]:
    values = {
        "Q": None if method.weights is None else method.weights.Q.tolist(),
        "R": None if method.weights is None else method.weights.R.tolist(),
        "K": None if method.K is None else method.K.tolist(),
        "state_misfit": method.state_misfit,
        "max_abs_u": method.max_abs_u,
        "bound_kept": method.bound_kept,
        "residual": method.residual,
        "seconds": method.seconds,
        "simulations": method.simulations,
        "feasible": method.feasible,
    }
    return {name: value for name, value in values.items() if value is not None}


def _identifiability(found: Identifiability) -> dict[str, Any]:
    return {
        "free": found.free,
        "rank": found.rank,
        "chosen": found.chosen,
        "tolerance": found.tolerance,
        "singular_values": found.singular_values.tolist(),
        "others": [
            {
                "Q": item.weights.Q.tolist(),
                "R": item.weights.R.tolist(),
                "condition": item.condition,
                "state_misfit": item.misfit,
            }
            for item in found.others
        ],
    }
