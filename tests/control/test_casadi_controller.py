"""What is said of programs without a solution; test_solvers.py compares solutions."""

from __future__ import annotations

from typing import Any

import control
import numpy as np
import pytest

from experiments.reference_mpc import simulate_mpc, solve_mpc
from impc.checking import replace
from impc.control.casadi_controller import build_mpc
from impc.control.closed_loop import simulate
from impc.control.controller import Controller
from impc.control.feasibility import require_complete
from impc.control.named_solver import SOLVERS
from impc.control.simulation import Simulation, Status, scenario
from impc.errors import DataError, InfeasibleError, PlantError, SolverError
from impc.model.bounds import Bounds, bound_rows
from impc.model.plant import Plant
from impc.model.recordings import Recording
from impc.model.weights import Weights
from tests.exact_mpc import ExactProgram, first_input
from tests.support import random_plant, random_weights

STEPS = 12


def test_a_solver_says_what_happened(example_plant: Plant, example_bounds: Bounds) -> None:
    controller = Controller(example_plant, Weights(np.eye(2), 1), example_bounds, 3)
    for name in SOLVERS:
        mpc = build_mpc(controller, name)
        assert solve_mpc(mpc, [0.1, 0]).status is Status.FREE
        step = solve_mpc(mpc, [1, 3])
        assert step.status is Status.ACTIVE
        assert step.plan.shape == (3, 1)
        assert controller.terminal is not None
        assert np.all(controller.terminal.H @ step.states[-1] <= controller.terminal.h + 1e-8)
        assert solve_mpc(mpc, [30, 1]).status is Status.INFEASIBLE
        run = simulate_mpc(mpc, scenario(example_plant, [30, 1], 3))
        with pytest.raises(InfeasibleError, match=r"^x0: no input sequence keeps the bound u\[0\]"):
            require_complete(controller, run)
        named = simulate(replace(controller, solver=name), scenario(example_plant, [30, 1], 3))
        assert named.status[0] == Status.INFEASIBLE
        assert named.failed_row >= 0


@pytest.mark.parametrize("name", SOLVERS)
def test_a_solver_that_fails_proves_nothing(name: str) -> None:
    """Only the input is bounded, so every program is feasible, but solvers called each infeasible.

    The rows lose their digits on an unstable plant: DAQP finds nothing, and qpOASES and IPOPT
    report infeasibility.
    """
    A = [[2, 1, 0], [0, 2, 0.5], [0, 0, 0.8]]
    plant = Plant(control.ss(A, [[0], [0.1], [1]], np.eye(3), 0, True))
    bounds = Bounds(plant, u_min=-1, u_max=1)
    controller = Controller(plant, Weights(np.eye(3), 1), bounds, 60, terminal_set=False)
    run = simulate_mpc(build_mpc(controller, name), scenario(plant, np.ones(3), 2))
    assert run.status[0] == Status.UNSOLVED
    with pytest.raises(SolverError, match="cannot be determined in double precision"):
        require_complete(controller, run)


@pytest.mark.parametrize("block", range(3))
def test_infeasible_is_said_where_it_is_proved(block: int) -> None:
    """Starts inside, at and outside the feasible set of random plants, by several solvers."""
    said = set()
    for seed in range(15):
        rng = np.random.default_rng([17, block, seed])
        n = 2 + seed % 3
        plant = random_plant(rng, n, 1, 1.2)
        bounds = Bounds(plant, u_min=-1, u_max=1, x_min=-3, x_max=3)
        weights = Weights(np.eye(n), 1)
        controller = Controller(plant, weights, bounds, 6, terminal_set=False)
        x = 10 ** rng.uniform(-0.5, 0.8) * rng.normal(size=n)
        status = solve_mpc(build_mpc(controller, SOLVERS[block]), x).status
        box, one = (np.vstack([np.eye(n), -np.eye(n)]), np.full(2 * n, 3.0)), np.ones(1)
        program = ExactProgram(plant.A, plant.B, weights.Q, weights.R, 6, -one, one, box)
        proved = first_input(program, x, np.zeros(len(program.sides), dtype=bool))
        assert (status is Status.INFEASIBLE) == (proved is None), seed
        said.add(status)
    assert {Status.INFEASIBLE, Status.FREE} <= said


@pytest.mark.parametrize(
    ("sides", "horizon", "x0", "said"),
    [
        ({"u_min": -1, "u_max": 1}, 3, [3, 1], r"^x0: no input sequence keeps the bound u\[0\]"),
        ({"u_min": -1, "u_max": 1}, 3, [90, 3], r"u\[0\] <= 1 in the terminal set, at sample 3"),
        ({"u_min": -1, "u_max": 1}, 2, [3, 3], "terminal set.*terminal_set=False"),
        ({"x_max": 1}, 3, [3, 1], r"keeps the bound x\[0\] <= 1 at sample 0 of"),
    ],
)
def test_an_infeasible_start_names_the_bound_and_the_step(
    example_plant: Plant, sides: dict[str, Any], horizon: int, x0: list[float], said: str
) -> None:
    bounds = Bounds(example_plant, **sides)
    controller = Controller(example_plant, Weights(np.eye(2), 1), bounds, horizon)
    run = simulate(controller, scenario(example_plant, x0, 20))
    assert run.reached == 0
    with pytest.raises(InfeasibleError, match=said):
        require_complete(controller, run)


def test_a_start_beyond_feasibility_is_nan_and_no_recording() -> None:
    """Regression: the state was frozen with u = 0, and weights were inferred without a warning."""
    plant = Plant(control.ss([[2.0]], [[1]], [[1]], 0, 1))
    law = Controller(plant, Weights(1, 1), Bounds(plant, u_min=-1, u_max=1), 3)
    with pytest.warns(UserWarning, match="sample 0: .*; later samples are NaN"):
        run = law.simulate([2.0], steps=5)
    assert run.status[0] == Status.INFEASIBLE
    assert run.x[0] == 2.0
    assert np.all(np.isnan(run.x[1:]))
    assert np.all(np.isnan(run.u))
    with pytest.raises(DataError, match="NaN"):
        Recording(plant, run.x)


def ended(plant: Plant, statuses: list[Status]) -> Simulation:
    steps = len(statuses)
    codes = np.array(statuses, dtype=np.int8)
    return Simulation(plant, np.zeros((steps + 1, 2)), np.zeros((steps, 1)), codes, 0, -1)


@pytest.mark.parametrize("status", list(Status))
def test_every_status_is_said_in_words(status: Status, example_plant: Plant) -> None:
    """Statuses with an input are not failures; a failure's description is in the error."""
    assert len(status.sentence) > 10
    controller = Controller(
        example_plant, Weights(np.eye(2), 1), Bounds(example_plant, u_max=1, u_min=-1), 3
    )
    run = ended(example_plant, [Status.FREE, status, Status.NOT_REACHED])
    assert not run.complete
    run = ended(example_plant, [Status.FREE, status])
    assert (run.complete, run.reached) == ((True, 2) if status <= Status.SOFTENED else (False, 1))
    if status <= Status.SOFTENED:
        assert require_complete(controller, run) is run
    elif status is not Status.INFEASIBLE:
        with pytest.raises(SolverError, match=f"sample 1.*{status.sentence}"):
            require_complete(controller, run)


def test_the_loop_stays_feasible_from_every_feasible_start() -> None:
    """Recursive feasibility, the property that the terminal set guarantees."""
    seed = 11
    print("seed", seed)
    rng = np.random.default_rng(seed)
    feasible = 0
    for _ in range(25):
        plant = random_plant(rng, 3, 1, 1.1)
        bounds = Bounds(plant, u_min=-1, u_max=0.7, x_min=-2, x_max=3)
        weights = Weights(random_weights(rng, 3), 1)
        controller = Controller(plant, weights, bounds, 4)
        run = simulate(controller, scenario(plant, rng.uniform(-2, 2, 3), 60))
        if run.reached == 0:
            continue
        feasible += 1
        assert run.complete
        assert np.all(run.u <= 0.7 + 1e-9)
        assert np.all(run.u >= -1 - 1e-9)
        assert np.all(run.x <= 3 + 1e-9)
        assert np.all(run.x >= -2 - 1e-9)
    assert feasible >= 5


def test_units_1e200_apart_do_not_decide_what_an_input_reaches() -> None:
    """The same plant in other units; scipy's balancing casts its scales to integers and warns."""
    units = np.diag([1e-100, 1e100])
    for link, reached in ((0.4, True), (0.0, False)):
        A = np.array([[1.2, link], [2.6, 0.5]])
        moved = control.ss(np.linalg.inv(units) @ A @ units, [[0], [1]], np.eye(2), 0, True)
        if reached:
            assert Plant(moved).n == 2
        else:
            with pytest.raises(PlantError, match="is not stabilisable"):
                Plant(moved)


def test_only_finite_bounds_make_rows(example_plant: Plant) -> None:
    rows = bound_rows(Bounds(example_plant, u_max=2, x_min=[-1, -np.inf]), example_plant)
    assert rows.names == ("u[0] <= 2", "x[0] >= -1")
    np.testing.assert_array_equal(rows.b, [2, 1])
