"""The simulation example of section 3.4: one plant, three initial states, seven methods.

The dissertation's own matrices (3.8), initial state and bound are lost. The plant that the command
line passes here is a stand-in that shows everything its text says; the reference solution of each
method is in tests/.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Array, Frozen, frozen
from impc.assess.assessments import evaluate_method
from impc.assess.weights_test import Identifiability, identifiability
from impc.control.closed_loop import simulate
from impc.control.controller import Controller
from impc.control.named_solver import COMPILED
from impc.control.simulation import Simulation, require_complete, scenario
from impc.inverse.problem import Problem, misfit
from impc.inverse.proximal_search import AUXILIARY_CONDITION_WEIGHT
from impc.inverse.table31 import CONDITION_WEIGHT, table_3_1
from impc.model.bounds import Bounds
from impc.model.recordings import Recording
from impc.model.weights import Weights, weight_error

if TYPE_CHECKING:
    from collections.abc import Callable

    from impc.assess.assessments import MethodFit
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
#: N of the controller, in samples.
HORIZON = 3
#: Samples of a recording.
STEPS = 20
#: Largest magnitude of the input.
BOUND = 1.0
#: The numbers of the example, as its page and result.json name them.
SETTINGS: dict[str, float] = {
    "horizon": HORIZON,
    "steps": STEPS,
    "input_bound": BOUND,
    "condition_weight": CONDITION_WEIGHT,
    "auxiliary_condition_weight": AUXILIARY_CONDITION_WEIGHT,
}
#: What the page of the example says of the dissertation's own plant.
LOST = (
    "The dissertation's own plant, initial state and limit are lost. This plant stands in for "
    "them: it shows everything that the dissertation says of its own, with other numbers."
)


@dataclass(frozen=True)
class MethodResult(Frozen):
    """What one method makes of the recording."""

    name: str  # One of the seven, as in the first column of the table
    weights: Weights | None  # Scaled to R[0, 0] = 1; None for a gain without weights
    K: Array | None  # Gain (m, n); None when the method has no answer
    simulation: Simulation | None  # The recording as the method explains it
    state_misfit: float | None  # 2-norm over all states and steps
    max_abs_u: float | None  # Largest magnitude of an input
    bound_kept: bool | None  # Whether every input is inside the bound, to 1e-9
    residual: float | None  # (3.10), against the true weights
    seconds: float  # Time of this method alone in s, given what it starts from
    # Closed loops simulated, with derivatives, on the way; 0 for methods that need none
    simulations: int
    feasible: bool | None  # For the LMI


@dataclass(frozen=True)
class CaseResult(Frozen):
    """One initial state: the truth, the methods of the table, and what was determined."""

    name: str  # One of `CASES`
    x0: Array  # Initial state (n,)
    controller: Controller  # The true one, with its terminal set
    truth: Simulation  # The recording
    branch: str  # Branch of Table 3.1 that was taken: ``"LMI"`` or ``"gradient"``
    methods: tuple[MethodResult, ...]
    identifiability: Identifiability  # At the weights of the direct inverse MPC

    def method(self, name: str) -> MethodResult:
        """The result of a method by its name."""
        return next(item for item in self.methods if item.name == name)


def true_weights(plant: Plant) -> Weights:
    """Return Q = I, R = 1, the weights that the methods are to find again, equation (3.9)."""
    return Weights(np.eye(plant.n), np.eye(plant.m))


def run_case(
    plant: Plant,
    name: str,
    *,
    solver: str = COMPILED,
    progress: Callable[[str], None] = lambda _: None,
) -> CaseResult:
    """Simulate the true controller from a case's initial state and run every method on it."""
    bounds = Bounds(plant, u_min=-BOUND, u_max=BOUND)
    truth_weights = true_weights(plant)
    controller = Controller(plant, truth_weights, bounds, HORIZON, solver=solver)
    truth = require_complete(controller, simulate(controller, scenario(plant, CASES[name], STEPS)))
    # Scale and condition weights as the equations have them: the table is in the plant's own units.
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
    assert direct.weights is not None  # it raises where there are none
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
