"""The controller: three CasADi solvers, the fast path and an independent program agree."""

from __future__ import annotations

import control
import numpy as np
import pytest

from impc.bounds import Bounds, bound_rows, box_bounds
from impc.closed_loop import Status, require_complete, scenario, simulate
from impc.controller import gain_controller, mpc_controller
from impc.errors import (
    BoundsError,
    DataError,
    InfeasibleError,
    InputError,
    PlantError,
    SolverError,
    WeightsError,
)
from impc.mpc import SOLVERS, build_mpc, simulate_mpc, solve_mpc
from impc.plant import Plant, as_plant
from impc.weights import stage_weights
from tests.independent_mpc import first_input, has_plan
from tests.support import random_plant, random_weights

STEPS = 12


@pytest.mark.parametrize("seed", range(8))
def test_solvers_fast_path_and_independent_program_agree(seed: int) -> None:
    """Random stabilisable plants, 1 or 2 inputs, 2 to 6 states, half of them unstable."""
    rng = np.random.default_rng(seed)
    n, m = 2 + seed % 5, 1 + seed % 2
    plant = random_plant(rng, n, m, 1.15 if seed % 4 < 2 else 0.9)
    Q, R = random_weights(rng, n), random_weights(rng, m)
    x_max = 6.0 if seed % 3 == 0 else np.inf
    bounds = box_bounds(plant, u_min=-0.5, u_max=0.5, x_min=-x_max, x_max=x_max)
    controller = mpc_controller(plant, stage_weights(Q, R), bounds, 5)
    # As far out as the program is feasible, so that bounds are active.
    for size in 30.0 * 0.8 ** np.arange(30):
        drive = scenario(plant, size * np.ones(n) / np.sqrt(n), STEPS)
        fast = simulate(controller, drive)
        if fast.complete and Status.ACTIVE in fast.status:
            break
    require_complete(controller, fast)
    assert Status.ACTIVE in fast.status, seed
    assert controller.terminal is not None
    for name in SOLVERS:
        slow = simulate_mpc(build_mpc(controller, name), drive)
        assert slow.complete, (name, slow.status)
        np.testing.assert_allclose(slow.x, fast.x, atol=1e-6, err_msg=name)
        if name != "ipopt":
            np.testing.assert_allclose(slow.x, fast.x, atol=1e-9, err_msg=name)
    terminal = (controller.terminal.H, controller.terminal.h)
    for x, u in zip(fast.x[:-1], fast.u, strict=True):
        other = first_input(plant.A, plant.B, Q, R, 5, x, 0.5, x_max, terminal)
        np.testing.assert_allclose(u, other, atol=1e-8)


@pytest.mark.parametrize("name", SOLVERS)
def test_soft_state_bounds_agree_with_the_fast_path(name: str) -> None:
    rng = np.random.default_rng(5)
    plant = random_plant(rng, 3, 1, 1.1, d=1)
    weights = stage_weights(np.eye(3), 1)
    bounds = box_bounds(plant, u_min=-1, u_max=1, x_min=-0.5, x_max=0.5)
    soft = mpc_controller(plant, weights, bounds, 6, softening=1e3)
    drive = scenario(plant, 0.2 * np.ones(3), disturbance=rng.normal(size=40) * 0.8)
    fast = simulate(soft, drive)
    assert Status.SOFTENED in fast.status
    hard = mpc_controller(plant, weights, bounds, 6)
    assert not simulate(hard, drive).complete
    slow = simulate_mpc(build_mpc(soft, name), drive)
    np.testing.assert_allclose(slow.x, fast.x, atol=1e-6)


def test_softening_changes_nothing_where_the_hard_program_is_feasible(
    example_plant: Plant,
) -> None:
    bounds = box_bounds(example_plant, u_min=-1, u_max=1, x_min=-3.1, x_max=3.1)
    weights = stage_weights(np.eye(2), 1)
    drive = scenario(example_plant, [2, 3], STEPS)
    hard = simulate(mpc_controller(example_plant, weights, bounds, 3), drive)
    soft = simulate(mpc_controller(example_plant, weights, bounds, 3, softening=1e3), drive)
    assert hard.complete
    np.testing.assert_allclose(soft.x, hard.x, atol=1e-12)


REFERENCE_INPUTS = {
    (1, 3): [1, 1, 1, 0.30451, -0.25464, -0.24685, -0.11827, -0.02918, 0.00543, 0.01026],
    (2, 3): [-0.1554, 1, 1, 0.5971, 0.1049],
    (2, 1): [-1, -1, 0.9549, 0.9633, 0.4701],
}


@pytest.mark.parametrize(("x0", "inputs"), REFERENCE_INPUTS.items())
def test_example_inputs_are_those_of_the_reference(
    example_plant: Plant, example_bounds: Bounds, x0: tuple[int, int], inputs: list[float]
) -> None:
    controller = mpc_controller(example_plant, stage_weights(np.eye(2), 1), example_bounds, 3)
    run = require_complete(controller, simulate(controller, scenario(example_plant, x0, 20)))
    np.testing.assert_allclose(run.u[: len(inputs), 0], inputs, atol=1e-4)


def test_a_solver_says_what_happened(example_plant: Plant, example_bounds: Bounds) -> None:
    controller = mpc_controller(example_plant, stage_weights(np.eye(2), 1), example_bounds, 3)
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


@pytest.mark.parametrize("name", SOLVERS)
def test_a_solver_that_fails_proves_nothing(name: str) -> None:
    """Nothing but the input is bounded, so every program has plans; each was called infeasible.

    The rows lose their digits as the plant runs away: DAQP finds nothing, and qpOASES and IPOPT
    say that there is nothing.
    """
    A = [[2, 1, 0], [0, 2, 0.5], [0, 0, 0.8]]
    plant = as_plant(control.ss(A, [[0], [0.1], [1]], np.eye(3), 0, True))
    bounds = box_bounds(plant, u_min=-1, u_max=1)
    controller = mpc_controller(plant, stage_weights(np.eye(3), 1), bounds, 60, terminal_set=False)
    run = simulate_mpc(build_mpc(controller, name), scenario(plant, np.ones(3), 2))
    assert run.status[0] == Status.UNSOLVED
    with pytest.raises(SolverError, match="could not be told in double precision"):
        require_complete(controller, run)


@pytest.mark.parametrize("block", range(3))
def test_infeasible_is_said_where_linear_programming_finds_no_plan(block: int) -> None:
    """Starts inside, at and outside of what a random plant can keep, each with another solver."""
    said = set()
    for seed in range(15):
        rng = np.random.default_rng([17, block, seed])
        n = 2 + seed % 3
        plant = random_plant(rng, n, 1, 1.2)
        bounds = box_bounds(plant, u_min=-1, u_max=1, x_min=-3, x_max=3)
        weights = stage_weights(np.eye(n), 1)
        controller = mpc_controller(plant, weights, bounds, 6, terminal_set=False)
        x = 10 ** rng.uniform(-0.5, 0.8) * rng.normal(size=n)
        status = solve_mpc(build_mpc(controller, SOLVERS[block]), x).status
        assert (status is Status.INFEASIBLE) == (not has_plan(plant.A, plant.B, 6, x, 1.0, 3.0)), (
            seed
        )
        said.add(status)
    assert {Status.INFEASIBLE, Status.FREE} <= said


def test_an_infeasible_start_names_the_bound_and_the_step(
    example_plant: Plant, example_bounds: Bounds
) -> None:
    controller = mpc_controller(example_plant, stage_weights(np.eye(2), 1), example_bounds, 3)
    run = simulate(controller, scenario(example_plant, [3, 1], 20))
    assert run.reached == 0
    with pytest.raises(InfeasibleError, match=r"^x0: no input sequence keeps the bound u\[0\]"):
        require_complete(controller, run)
    boxed = box_bounds(example_plant, x_max=1)
    outside = mpc_controller(example_plant, stage_weights(np.eye(2), 1), boxed, 3)
    run = simulate(outside, scenario(example_plant, [3, 1], 20))
    with pytest.raises(InfeasibleError, match=r"keeps the bound x\[0\] <= 1 0 samples ahead"):
        require_complete(outside, run)


def test_the_loop_stays_feasible_from_every_feasible_start() -> None:
    """Recursive feasibility: the property that the terminal set is for."""
    seed = 11
    print("seed", seed)
    rng = np.random.default_rng(seed)
    feasible = 0
    for _ in range(25):
        plant = random_plant(rng, 3, 1, 1.1)
        bounds = box_bounds(plant, u_min=-1, u_max=0.7, x_min=-2, x_max=3)
        weights = stage_weights(random_weights(rng, 3), 1)
        controller = mpc_controller(plant, weights, bounds, 4)
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


def test_bad_input_names_the_argument(example_plant: Plant, example_bounds: Bounds) -> None:
    weights = stage_weights(np.eye(2), 1)
    cases: list[tuple[type[Exception], str, object]] = [
        (InputError, "^solver: got 'gurobi'; choose one of", lambda: build_mpc(
            mpc_controller(example_plant, weights, example_bounds, 3), "gurobi")),
        (InputError, "^horizon: got 0; give a whole number", lambda: mpc_controller(
            example_plant, weights, example_bounds, 0)),
        (InputError, "^horizon: got 2.5", lambda: mpc_controller(
            example_plant, weights, example_bounds, 2.5)),  # type: ignore[arg-type]
        (InputError, "^softening: got -1", lambda: mpc_controller(
            example_plant, weights, example_bounds, 3, softening=-1)),
        (InputError, "^gain: does not stabilise", lambda: gain_controller(
            example_plant, [[0, 0]], example_bounds, 3)),
        (DataError, "^gain: expected shape", lambda: gain_controller(
            example_plant, [1, 1], example_bounds, 3)),
        (DataError, "^x0: 1 of 2 entries are NaN or infinite, the first at", lambda: scenario(
            example_plant, [np.nan, 1], 3)),
        (DataError, "^steps: got None", lambda: scenario(example_plant, [1, 1])),
        (WeightsError, "^Q: is not positive semidefinite", lambda: stage_weights(-np.eye(2), 1)),
        (WeightsError, "^R: is not positive definite", lambda: stage_weights(np.eye(2), 0)),
        (InputError, "^Q: is not symmetric", lambda: stage_weights([[1, 2], [0, 1]], 1)),
        (BoundsError, "cross for u", lambda: box_bounds(example_plant, u_min=1, u_max=-1)),
        (BoundsError, "exclude the origin", lambda: box_bounds(example_plant, u_min=1, u_max=2)),
        (BoundsError, "has NaN", lambda: box_bounds(example_plant, u_max=np.nan)),
        (BoundsError, "^x_max: got", lambda: box_bounds(example_plant, x_max=[1, 2, 3])),
        (PlantError, "not stabilisable", lambda: as_plant(
            control.ss(np.diag([2.0, 0.5]), [[0], [1]], np.eye(2), 0, True))),
        (PlantError, "expected a control.StateSpace", lambda: as_plant(np.eye(2))),
        (PlantError, "D: is not zero", lambda: as_plant(control.ss(0.5, 1, 1, 1, True))),
        (PlantError, "NaN or infinite", lambda: as_plant(control.ss(np.nan, 1, 1, 0, True))),
        (PlantError, "is continuous", lambda: mpc_controller(
            as_plant(control.ss(-1, 1, 1, 0)), stage_weights(1, 1),
            box_bounds(as_plant(control.ss(-1, 1, 1, 0))), 3)),
        (PlantError, "controls: .*the inputs are", lambda: as_plant(
            control.ss(0.5, 1, 1, 0, True), ["torque"])),
    ]  # fmt: skip
    for kind, message, call in cases:
        with pytest.raises(kind, match=message) as caught:
            call()  # type: ignore[operator]
        assert "\n" not in str(caught.value)


def test_units_1e200_apart_do_not_decide_what_an_input_reaches() -> None:
    """The same plant in other units; scipy's balancing cast its scales to integers and warned."""
    units = np.diag([1e-100, 1e100])
    for link, reached in ((0.4, True), (0.0, False)):
        A = np.array([[1.2, link], [2.6, 0.5]])
        moved = control.ss(np.linalg.inv(units) @ A @ units, [[0], [1]], np.eye(2), 0, True)
        if reached:
            assert as_plant(moved).n == 2
        else:
            with pytest.raises(PlantError, match="is not stabilisable"):
                as_plant(moved)


def test_only_finite_bounds_make_rows(example_plant: Plant) -> None:
    rows = bound_rows(box_bounds(example_plant, u_max=2, x_min=[-1, -np.inf]), example_plant)
    assert rows.names == ("u[0] <= 2", "x[0] >= -1")
    np.testing.assert_array_equal(rows.b, [2, 1])
