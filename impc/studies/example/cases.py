"""The simulation example of section 3.4: one plant, three initial states, seven methods.

The dissertation's own matrices (3.8), initial state and bound are lost. The plant that the command
line passes here is a stand-in that shows everything its text says; the reference solution of each
method is in tests/.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from impc.arrays import Array, Frozen, frozen
from impc.assess.identified_directions import Identifiability, identifiability
from impc.control.closed_loop import Scenario, Simulation, require_complete, scenario, simulate
from impc.control.controller import Controller
from impc.inverse.direct_and_reduced import (
    AUXILIARY_CONDITION_WEIGHT,
    CONDITION_WEIGHT,
    auxiliary_weights,
    inverse_mpc,
    inverse_mpc_reduced,
    output_penalty_weights,
)
from impc.inverse.gain_search import fit_gain
from impc.inverse.inverse_lqr import inverse_lqr_gradient, inverse_lqr_lmi
from impc.inverse.problem import Problem, misfit
from impc.model.bounds import Bounds
from impc.model.recordings import Recording
from impc.model.riccati import solve_lqr
from impc.model.weights import Weights, normalised, weight_error

if TYPE_CHECKING:
    from collections.abc import Callable

    from impc.model.plant import Plant

__all__ = [
    "BOUND",
    "CASES",
    "HORIZON",
    "LOST",
    "SETTINGS",
    "STEPS",
    "CaseResult",
    "MethodResult",
    "run_case",
    "true_weights",
]

_T = TypeVar("_T")

#: Initial states by name.
CASES: dict[str, tuple[float, float]] = {"A": (1.0, 3.0), "B": (2.0, 3.0), "C": (2.0, 1.0)}
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
    "The dissertation's own plant (3.8), initial state and input bound are lost. "
    "This plant stands in for them: it shows everything that the dissertation says of its own, "
    "but its numbers are not the dissertation's."
)


@dataclass(frozen=True)
class MethodResult(Frozen):
    """What one method makes of the recording.

    Attributes
    ----------
    name : str
        One of the seven, as in the first column of the table.
    weights : Weights or None
        Scaled to R[0, 0] = 1; None for a gain without weights.
    K : Array or None
        Gain (m, n); None when the method has no answer.
    simulation : Simulation or None
        The recording as the method explains it.
    state_misfit : float or None
        2-norm over all states and steps.
    max_abs_u : float or None
        Largest magnitude of an input.
    bound_kept : bool or None
        Whether every input is inside the bound, to 1e-9.
    residual : float or None
        (3.10), against the true weights.
    seconds : float
        Time of this method alone in s, given what it starts from.
    simulations : int
        Closed loops simulated, with derivatives, on the way; 0 for methods that need none.
    feasible : bool or None
        For the LMI.
    """

    name: str
    weights: Weights | None
    K: Array | None
    simulation: Simulation | None
    state_misfit: float | None
    max_abs_u: float | None
    bound_kept: bool | None
    residual: float | None
    seconds: float
    simulations: int
    feasible: bool | None


@dataclass(frozen=True)
class CaseResult(Frozen):
    """One initial state: the truth, the methods in the order of the table, and what was determined.

    Attributes
    ----------
    name : str
        One of `CASES`.
    x0 : Array
        Initial state (n,).
    controller : Controller
        The true one, with its terminal set.
    truth : Simulation
        The recording.
    branch : str
        Branch of Table 3.1 that was taken: ``"LMI"`` or ``"gradient"``.
    methods : tuple of MethodResult
    identifiability : Identifiability
        At the weights of the direct inverse MPC.
    """

    name: str
    x0: Array
    controller: Controller
    truth: Simulation
    branch: str
    methods: tuple[MethodResult, ...]
    identifiability: Identifiability

    def method(self, name: str) -> MethodResult:
        """The result of a method by its name."""
        return next(item for item in self.methods if item.name == name)


def true_weights(plant: Plant) -> Weights:
    """Return Q = I, R = 1, the weights that the methods are to find again, equation (3.9)."""
    return Weights(np.eye(plant.n), np.eye(plant.m))


def run_case(
    plant: Plant, name: str, *, progress: Callable[[str], None] = lambda _: None
) -> CaseResult:
    """Simulate the true controller from a case's initial state and run every method on it.

    Parameters
    ----------
    plant : Plant
        Two states, one input.
    name : str
        ``"A"``, ``"B"`` or ``"C"``.
    progress : callable, optional
        Called with the name of each method when it is done.

    Raises
    ------
    ImpcError
        When a method fails.
    """
    bounds = Bounds(plant, u_min=-BOUND, u_max=BOUND)
    truth_weights = true_weights(plant)
    controller = Controller(plant, truth_weights, bounds, HORIZON)
    truth = require_complete(controller, simulate(controller, scenario(plant, CASES[name], STEPS)))
    # Scale and condition weights as the equations have them: the table is in the plant's own units.
    problem = Problem(
        plant, bounds, HORIZON, (Recording(plant, truth.x),), output_scale=np.ones(plant.n)
    )
    runner = _Runner(problem, truth_weights, progress)

    gain = runner.timed("feedback_gain", lambda: fit_gain(problem.without_bounds()))
    runner.add_gain(gain.K, gain.evaluations)
    lmi = runner.timed("inverse_lqr_lmi", lambda: inverse_lqr_lmi(plant, gain.K))
    runner.add_regulator(lmi.weights, 0, feasible=lmi.weights is not None)
    gradient = runner.timed("inverse_lqr_gradient", lambda: inverse_lqr_gradient(plant, gain.K))
    runner.add_regulator(gradient.weights, 0)
    auxiliary = runner.timed(
        "inverse_lqr_auxiliary", lambda: auxiliary_weights(plant, gain.K, gradient.weights)
    )
    runner.add_regulator(auxiliary.weights, 0)
    start = auxiliary.weights if lmi.weights is None else lmi.weights
    output = runner.timed(
        "inverse_lqr_output",
        lambda: output_penalty_weights(problem, start, condition_weight=CONDITION_WEIGHT),
    )
    runner.add_regulator(output.weights, output.evaluations)
    direct = runner.timed(
        "inverse_mpc", lambda: inverse_mpc(problem, start, condition_weight=CONDITION_WEIGHT)
    )
    runner.add_constrained(direct.weights, direct.evaluations)
    reduced = runner.timed("inverse_mpc_reduced", lambda: inverse_mpc_reduced(problem))
    runner.add_constrained(reduced.weights, reduced.gain.evaluations)
    return CaseResult(
        name,
        frozen(CASES[name]),
        controller,
        truth,
        "gradient" if lmi.weights is None else "LMI",
        tuple(runner.results),
        identifiability(problem, direct.weights),
    )


class _Runner:
    """Times each method and judges its answer on the recording."""

    def __init__(self, problem: Problem, truth: Weights, progress: Callable[[str], None]) -> None:
        self.problem = problem
        self.truth = truth
        self.progress = progress
        self.results: list[MethodResult] = []
        self.name = ""
        self.seconds = 0.0

    def timed(self, name: str, call: Callable[[], _T]) -> _T:
        begin = time.perf_counter()
        answer = call()
        self.name, self.seconds = name, time.perf_counter() - begin
        return answer

    def add_gain(self, gain: Array, simulations: int) -> None:
        self._add(gain, None, self._linear(gain), simulations, None)

    def add_regulator(
        self, weights: Weights | None, simulations: int, feasible: bool | None = None
    ) -> None:
        if weights is None:
            self._add(None, None, None, simulations, feasible)
            return
        gain = solve_lqr(self.problem.plant, weights).K
        self._add(gain, weights, self._linear(gain), simulations, feasible)

    def add_constrained(self, weights: Weights, simulations: int) -> None:
        problem = self.problem
        controller = Controller(problem.plant, weights, problem.bounds, problem.horizon)
        run = require_complete(controller, simulate(controller, self._drive()))
        self._add(controller.K, weights, run, simulations, None)

    def _add(
        self,
        gain: Array | None,
        weights: Weights | None,
        run: Simulation | None,
        simulations: int,
        feasible: bool | None,
    ) -> None:
        largest = None if run is None else float(np.max(np.abs(run.u)))
        self.results.append(
            MethodResult(
                name=self.name,
                weights=None if weights is None else normalised(weights),
                K=gain,
                simulation=run,
                state_misfit=None if run is None else misfit(self.problem, [run]),
                max_abs_u=largest,
                bound_kept=None if largest is None else largest <= BOUND * (1 + 1e-9),
                residual=None if weights is None else weight_error(weights, self.truth),
                seconds=self.seconds,
                simulations=simulations,
                feasible=feasible,
            )
        )
        self.progress(self.name)

    def _linear(self, gain: Array) -> Simulation:
        problem = self.problem
        unlimited = problem.without_bounds().bounds
        controller = Controller.from_gain(
            problem.plant, gain, unlimited, problem.horizon, terminal_set=False
        )
        return simulate(controller, self._drive())

    def _drive(self) -> Scenario:
        return scenario(self.problem.plant, self.problem.recordings[0].x0, STEPS)
