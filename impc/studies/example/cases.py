"""The simulation example of section 3.4: one plant, three initial states, seven methods.

The dissertation's own matrices (3.8), initial state and bound are not available. The command line
passes a plant that has the properties described in its text; reference solutions are in tests/.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Array, Frozen, frozen
from impc.assess.assessments import evaluate_method
from impc.assess.weights_test import identifiability
from impc.control.closed_loop import simulate
from impc.control.controller import Controller
from impc.control.feasibility import require_complete
from impc.control.named_solver import COMPILED
from impc.control.simulation import Simulation, scenario
from impc.inverse.problem import Problem, misfit
from impc.inverse.proximal_search import AUXILIARY_CONDITION_WEIGHT
from impc.inverse.table31 import CONDITION_WEIGHT, table_3_1
from impc.model.bounds import Bounds
from impc.model.recordings import Recording
from impc.model.weights import Weights, weight_error

if TYPE_CHECKING:
    from collections.abc import Callable

    from impc.assess.assessments import MethodFit
    from impc.inverse.estimates import Identifiability
    from impc.model.plant import Plant

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
#: Settings of the example by their names on the page and in result.json.
SETTINGS: dict[str, float] = {
    "horizon": HORIZON,
    "steps": STEPS,
    "input_bound": BOUND,
    "condition_weight": CONDITION_WEIGHT,
    "auxiliary_condition_weight": AUXILIARY_CONDITION_WEIGHT,
}
#: Sentences on the dissertation's own plant.
LOST = (
    "The dissertation's own plant, initial state and limit are not available. This plant replaces "
    "them: it shows all properties that the dissertation describes, with other numbers."
)


@dataclass(frozen=True)
class MethodResult(Frozen):
    """Result of one method on one recording."""

    name: str  # Name of the method
    weights: Weights | None  # Scaled to R[0, 0] = 1; None for a gain without weights
    K: Array | None  # Gain (m, n); None if the method has no solution
    simulation: Simulation | None  # Simulation with this gain
    state_misfit: float | None  # 2-norm over all states and steps
    max_abs_u: float | None  # Largest magnitude of an input
    bound_kept: bool | None  # Whether every input is inside the bound, to 1e-9
    residual: float | None  # Distance (3.10) to the true weights
    seconds: float  # Run time of the method without its start, s
    # Number of simulated closed loops with derivatives; 0 for methods that need none
    simulations: int
    feasible: bool | None  # Whether the LMI is feasible; None for other methods


@dataclass(frozen=True)
class CaseResult(Frozen):
    """Results for one initial state."""

    name: str  # One of `CASES`
    x0: Array  # Initial state (n,)
    controller: Controller  # True controller with its terminal set
    truth: Simulation  # The recording
    branch: str  # Branch of Table 3.1 that was taken: ``"LMI"`` or ``"gradient"``
    methods: tuple[MethodResult, ...]
    identifiability: Identifiability  # At the weights of the direct inverse MPC

    def method(self, name: str) -> MethodResult:
        """Result of the method `name`."""
        return next(item for item in self.methods if item.name == name)


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
    truth_weights = true_weights(plant)
    controller = Controller(plant, truth_weights, bounds, HORIZON, solver=solver)
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
    results = [_result(evaluate_method(table[name], bounds), truth_weights) for name in EXAMPLE]
    branch = "gradient" if table["inverse_lqr_lmi"].weights is None else "LMI"
    direct = next(item for item in results if item.name == "inverse_mpc")
    assert direct.weights is not None  # the method raises otherwise
    return CaseResult(
        name,
        frozen(CASES[name]),
        controller,
        truth,
        branch,
        tuple(results),
        identifiability(problem, direct.weights),
    )


def _result(fit: MethodFit, truth: Weights) -> MethodResult:
    found = fit.estimate
    largest = float(fit.largest_input[0]) if fit.runs else None
    return MethodResult(
        name=fit.name,
        weights=found.weights,
        K=found.K,
        simulation=fit.runs[0] if fit.runs else None,
        state_misfit=misfit(found.problem, list(fit.runs)) if fit.runs else None,
        max_abs_u=largest,
        bound_kept=None if largest is None else largest <= BOUND * (1 + 1e-9),
        residual=None if found.weights is None else weight_error(found.weights, truth),
        seconds=found.seconds,
        simulations=found.evaluations,
        feasible=found.weights is not None if fit.name == "inverse_lqr_lmi" else None,
    )
