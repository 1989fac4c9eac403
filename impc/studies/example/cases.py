"""The simulation example of section 3.4: one plant, three initial states, seven methods.

The dissertation's own matrices (3.8), initial state and bound are not available. The command line
passes a plant that has the properties described in its text; reference solutions are in tests/.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from impc.arrays import Frozen
from impc.assess.assessments import MethodFit, evaluate_method
from impc.assess.weights_test import identifiability
from impc.control.closed_loop import simulate
from impc.control.controller import Controller
from impc.control.feasibility import require_complete
from impc.control.named_solver import COMPILED
from impc.control.simulation import Simulation, scenario
from impc.inverse.estimates import Identifiability
from impc.inverse.problem import Problem
from impc.inverse.table31 import table_3_1
from impc.model.bounds import Bounds
from impc.model.plant import Plant
from impc.model.recordings import Recording
from impc.model.weights import Weights, weight_error

#: Initial states by name.
CASES: dict[str, tuple[float, float]] = {"A": (1.0, 3.0), "B": (2.0, 3.0), "C": (2.0, 1.0)}
#: The methods, in the order of the table.
EXAMPLE = (
    "feedback_gain",
    "inverse_lqr_lmi",
    "inverse_lqr_gradient",
    "inverse_lqr_auxiliary",
    "inverse_lqr_output",
    "inverse_mpc",
    "inverse_mpc_reduced",
)
#: Horizon of the controller, in samples.
HORIZON = 3
#: Number of samples of a recording.
STEPS = 20
#: Largest magnitude of the input.
BOUND = 1.0
#: Sentences on the dissertation's own plant.
LOST = (
    "The dissertation's own plant, initial state and limit are not available. This plant replaces "
    "them: it shows all properties that the dissertation describes, with other numbers."
)


@dataclass(frozen=True)
class CaseResult(Frozen):
    """Results for one initial state."""

    name: str  # One of `CASES`
    controller: Controller  # True controller with its terminal set
    truth: Simulation  # The recording
    methods: tuple[MethodFit, ...]  # In the order of `EXAMPLE`
    identifiability: Identifiability  # At the weights of the direct inverse MPC

    def method(self, name: str) -> MethodFit:
        """Result of the method `name`."""
        return next(item for item in self.methods if item.name == name)

    @property
    def branch(self) -> str:
        """Branch of Table 3.1 that was taken: the LMI is infeasible, or it is not."""
        return "gradient" if self.method("inverse_lqr_lmi").estimate.weights is None else "LMI"


def true_weights(plant: Plant) -> Weights:
    """True weights Q = I, R = 1 (3.9)."""
    return Weights(np.eye(plant.n), np.eye(plant.m))


def run_case(
    plant: Plant,
    name: str,
    *,
    solver: str = COMPILED,
    progress: Callable[[str], None] = lambda _: None,
) -> CaseResult:
    """Simulate the true controller from an initial state and run every method."""
    bounds = Bounds(plant, u_min=-BOUND, u_max=BOUND)
    controller = Controller(plant, true_weights(plant), bounds, HORIZON, solver=solver)
    truth = require_complete(controller, simulate(controller, scenario(plant, CASES[name], STEPS)))
    # No scaling: the equations of the table are in the plant's own units.
    problem = Problem(
        plant,
        bounds,
        HORIZON,
        (Recording(plant, truth.x),),
        terminal_set=True,
        output_scale=np.ones(plant.n),
        unknown_start=False,
        solver=solver,
    )
    table = table_3_1(problem, absolute=True, progress=progress)
    fits = tuple(evaluate_method(table[method], bounds) for method in EXAMPLE)
    found = identifiability(problem, table["inverse_mpc"].stage_weights)
    return CaseResult(name, controller, truth, fits, found)


def distance(fit: MethodFit) -> float:
    """Distance (3.10) to the true weights; NaN without weights."""
    found, plant = fit.estimate.weights, fit.estimate.problem.plant
    return float("nan") if found is None else weight_error(found, true_weights(plant))
