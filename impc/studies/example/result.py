"""result.json: the numbers of a run for other programs.

    solver                              what solved the quadratic programs
    cases.<A|B|C>.x0
    cases.<A|B|C>.truth                 x, u, Q, R, K of the controller that made the recording
    cases.<A|B|C>.methods.<name>        Q, R, K, state_misfit, max_abs_u, residual, seconds,
                                        simulations; `feasible` for the LMI
    cases.<A|B|C>.identifiability       what the recording determined

A key that does not apply is left out: a gain has no Q, an infeasible LMI nothing but `feasible`
and `seconds`. Matrices are lists of rows.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from impc.model.weights import condition_number
from impc.studies.example.cases import true_weights

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from impc.assess.identified_directions import Identifiability
    from impc.model.weights import Weights
    from impc.reporting.provenance import Provenance
    from impc.studies.example.cases import CaseResult, MethodResult

__all__ = ["example_data"]


def example_data(
    cases: Sequence[CaseResult], provenance: Provenance, settings: Mapping[str, float]
) -> dict[str, Any]:
    """Content of result.json, with the `settings` of the example."""
    plant = cases[0].controller.plant
    return {
        "plant": {"name": provenance.plant_name, "A": plant.A, "B": plant.B, "dt": plant.dt},
        "settings": settings,
        "solver": cases[0].controller.solver,
        "cases": {case.name: _case(case) for case in cases},
    }


def _case(case: CaseResult) -> dict[str, Any]:
    truth = _truth(case)
    return {
        "x0": case.x0,
        "branch": case.branch,
        "truth": truth,
        # The truth stands among the methods too, so that a reader can compare them in one loop.
        "methods": {"truth": truth} | {item.name: _method(item) for item in case.methods},
        "identifiability": _identifiability(case.identifiability),
    }


def _truth(case: CaseResult) -> dict[str, Any]:
    return {
        **_weights(true_weights(case.controller.plant)),
        "K": case.controller.K,
        "max_abs_u": float(np.max(np.abs(case.truth.u))),
        "x": case.truth.x,
        "u": case.truth.u,
    }


def _method(method: MethodResult) -> dict[str, Any]:
    found: dict[str, Any] = {} if method.weights is None else _weights(method.weights)
    optional = {
        "K": method.K,
        "state_misfit": method.state_misfit,
        "max_abs_u": method.max_abs_u,
        "bound_kept": method.bound_kept,
        "residual": method.residual,
        "feasible": method.feasible,
        "x": None if method.simulation is None else method.simulation.x,
        "u": None if method.simulation is None else method.simulation.u,
    }
    found |= {key: value for key, value in optional.items() if value is not None}
    return found | {"seconds": method.seconds, "simulations": method.simulations}


def _weights(weights: Weights) -> dict[str, Any]:
    return {"Q": weights.Q, "R": weights.R, "condition_number": condition_number(weights)}


def _identifiability(found: Identifiability) -> dict[str, Any]:
    return {
        "free": found.free,
        "rank": found.rank,
        "chosen": found.chosen,
        "singular_values": found.singular_values,
        "tolerance": found.tolerance,
        "others": [
            {**_weights(item.weights), "state_misfit": item.misfit} for item in found.others
        ],
    }
