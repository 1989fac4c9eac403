"""Exact sensitivities against central differences, and invariances of the closed loop."""

from __future__ import annotations

from typing import Any

import control
import numpy as np
import pytest

from impc.checking import replace
from impc.control.closed_loop import prepare_loop, run_loop, simulate, simulate_and_differentiate
from impc.control.compiled_dual import CONVERGED, solve_dual
from impc.control.constraint_rows import Directions, directions
from impc.control.controller import Controller
from impc.control.simulation import Scenario, Simulation, Status, scenario
from impc.model.bounds import Bounds, bound_rows
from impc.model.plant import Plant
from impc.model.riccati import solve_lqr
from impc.model.weights import Weights
from tests.support import differences, random_plant, random_weights

dual: Any = solve_dual


def moved(
    controller: Controller, drive: Scenario, part: str, index: tuple[int, ...], step: float
) -> Simulation:
    """The closed loop with one number of the problem changed by a step."""
    if part == "x0":
        x0 = np.array(drive.x0)
        x0[index] += step
        return simulate(controller, Scenario(x0, drive.disturbance))
    if part == "bounds":
        return simulate(with_bound(controller, index[0], step), drive)
    owner: Any = controller.plant if part in ("A", "B", "E") else controller
    matrix = np.array(getattr(owner, part))
    matrix[index] += step
    if part == "S":
        matrix[index[::-1]] = matrix[index]
    changed: Any = replace(owner, **{part: matrix})
    return simulate(
        replace(controller, plant=changed) if owner is controller.plant else changed, drive
    )


def with_bound(controller: Controller, row: int, step: float) -> Controller:
    """One bound changed by a step, with the penalty of its excess unchanged."""
    rows = bound_rows(controller.bounds, controller.plant)
    names = ("x_min", "x_max", "u_min", "u_max")
    sides = {name: np.array(getattr(controller.bounds, name)) for name in names}
    signal, side, _ = rows.names[row].rsplit(" ", 2)
    states, controls = controller.plant.states, controller.plant.controls
    kind, signals = ("x", states) if signal in states else ("u", controls)
    sides[kind + ("_max" if side == "<=" else "_min")][signals.index(signal)] += (
        step if side == "<=" else -step
    )
    changed = replace(controller, bounds=replace(controller.bounds, **sides))
    if controller.softening is None:
        return changed
    # The penalty is a separate number, not one of the directions.
    return replace(changed, softening=controller.softening * controller.penalty / changed.penalty)


def entries(controller: Controller) -> list[tuple[str, tuple[int, ...]]]:
    """Every number with respect to which the closed loop can be differentiated."""
    plant = controller.plant
    shapes = {
        "K": controller.K.shape,
        "S": controller.S.shape,
        "x0": (plant.n,),
        "bounds": bound_rows(controller.bounds, plant).b.shape,
        "A": plant.A.shape,
        "B": plant.B.shape,
        "E": plant.E.shape,
    }
    return [
        (part, index)
        for part, shape in shapes.items()
        for index in np.ndindex(*shape)
        if part != "S" or index[0] >= index[1]
    ]


def unit_directions(
    controller: Controller, wanted: list[tuple[str, tuple[int, ...]]]
) -> Directions:
    along = directions(controller, len(wanted))
    for column, (part, index) in enumerate(wanted):
        array = getattr(along, part)
        array[(*index, column)] = 1.0
        if part == "S":
            array[(*index[::-1], column)] = 1.0
    return along


def problem(seed: int, softening: float | None) -> tuple[Controller, Scenario, Simulation]:
    """A random loop with input bounds, and mostly state bounds and a terminal set, some active."""
    n, m = 2 + seed % 3, 1 + seed % 3
    x_max = 1.5 if seed % 2 else np.inf
    for attempt in range(10):
        rng = np.random.default_rng([seed, attempt])
        plant = random_plant(rng, n, m, 1.1, d=1)
        weights = Weights(random_weights(rng, n), random_weights(rng, m))
        bounds = Bounds(plant, u_min=-0.4, u_max=0.5, x_min=-x_max, x_max=x_max)
        controller = Controller(plant, weights, bounds, 3, softening=softening)
        push = 0.05 * rng.normal(size=25)
        direction = rng.normal(size=n)
        for size in 5 * 0.9 ** np.arange(60):
            drive = scenario(plant, size * direction, disturbance=push)
            run = simulate(controller, drive)
            if run.complete and np.any(run.status > Status.FREE) and run.weakly_active == 0:
                return controller, drive, run
    raise AssertionError(f"seed {seed} has no active bound")


@pytest.mark.parametrize("softening", [None, 50.0])
@pytest.mark.parametrize(
    "seed",
    [seed if seed < 24 else pytest.param(seed, marks=pytest.mark.full) for seed in range(100)],
)
def test_jacobian_equals_central_differences(seed: int, softening: float | None) -> None:
    """48 random loops, and 152 more in `make full`; every number of each."""
    controller, drive, _ = problem(seed, softening)
    check_jacobian(controller, drive)


def check_jacobian(controller: Controller, drive: Scenario, *without: str) -> None:
    """Compare every derivative, except some parts, with fourth-order differences, to 1e-6."""
    wanted = [(part, index) for part, index in entries(controller) if part not in without]
    _, exact = simulate_and_differentiate(controller, drive, unit_directions(controller, wanted))
    for column, (part, index) in enumerate(wanted):
        errors = []
        # Longer differences may cross a change of the active set, shorter ones have more
        # rounding: one of them must agree.
        for step in (1e-5, 1e-4, 1e-6, 1e-7):
            near, far = (
                [moved(controller, drive, part, index, sign * s) for sign in (1, -1)]
                for s in (step, 2 * step)
            )
            worst = 0.0
            for quantity in ("x", "u"):
                inner, outer = (
                    getattr(pair[0], quantity) - getattr(pair[1], quantity) for pair in (near, far)
                )
                difference = (8 * inner - outer) / (12 * step)  # fourth order
                error = np.max(np.abs(getattr(exact, quantity)[..., column] - difference))
                worst = max(worst, error / max(1.0, float(np.max(np.abs(difference)))))
            errors.append(worst)
            if worst < 1e-6:
                break
        assert min(errors) < 1e-6, f"{part}{index}: {errors}"


def test_soft_rows_are_part_of_the_comparison() -> None:
    used = [problem(seed, 50.0)[2].status for seed in range(8)]
    assert any(Status.SOFTENED in status for status in used)
    assert any(Status.ACTIVE in status for status in used)


def test_active_terminal_rows_are_differentiated(example_plant: Plant) -> None:
    """A start at which the terminal set is active: the trajectory without it differs."""
    gain = solve_lqr(example_plant, Weights(np.eye(2), 1)).K

    def law(change: np.ndarray, *, kept: bool = True) -> Controller:
        """With the terminal set of the changed gain and bound."""
        bounds = Bounds(example_plant, u_min=-1, u_max=1 + change[2])
        return Controller.from_gain(example_plant, gain + change[:2], bounds, 2, terminal_set=kept)

    here = np.zeros(3)
    controller, bare = law(here), law(here, kept=False)
    for x0 in np.ndindex(40, 40):
        drive = scenario(example_plant, np.array(x0) / 10, 12)
        run, without = simulate(controller, drive), simulate(bare, drive)
        differs = np.max(np.abs(run.x - without.x)) > 1e-3
        if run.complete and differs and run.weakly_active == 0:
            break
    assert run.complete
    assert differs
    wanted = [("K", (0, 0)), ("K", (0, 1)), ("bounds", (0,))]
    along = unit_directions(controller, wanted)
    exact = simulate_and_differentiate(controller, drive, along)[1].x.reshape(-1, 3)
    found = differences(lambda change: simulate(law(change), drive).x, here, 1e-7)
    np.testing.assert_allclose(exact, found, rtol=1e-5, atol=1e-6)


def test_samples_at_a_change_of_the_active_set_are_counted(
    example_plant: Plant, example_bounds: Bounds
) -> None:
    controller = Controller(
        example_plant, Weights(np.eye(2), 1), example_bounds, 3, terminal_set=False
    )
    x = np.array([1 / controller.K[0, 0], 0.0])  # u = -Kx is exactly at the bound
    run = simulate(controller, scenario(example_plant, x, 1))
    assert run.weakly_active == 1
    assert simulate(controller, scenario(example_plant, 0.9 * x, 1)).weakly_active == 0


def test_dual_solver_begins_anew_where_the_slack_is_no_number() -> None:
    W, reach, limits = np.eye(2), np.full(2, 2), (np.full(2, np.inf), np.full(2, 1e-12))

    def room() -> tuple[np.ndarray, ...]:
        places, none = np.empty(3, dtype=np.int64), np.zeros(1, dtype=np.int64)
        return np.zeros(2), places, np.empty((3, 3)), np.zeros((3, 2)), none

    def solved(slack: list[float], room: tuple[np.ndarray, ...], count: int) -> tuple[int, int]:
        found: tuple[int, int] = dual(W, reach, W, np.array(slack), *limits, *room, count)
        return found

    first, again = room(), room()
    assert solved([-1.0, -2.0], first, 0) == (CONVERGED, 2)
    _, count = solved([np.nan, -2.0], first, 2)
    assert np.all(np.isfinite(first[0][1:]))
    assert solved([np.nan, -2.0], again, 0)[1] == count
    np.testing.assert_array_equal(first[0], again[0])


@pytest.mark.parametrize("softening", [1e4, None])
@pytest.mark.parametrize("position", [0.4, 2.0, 7.0])
def test_a_long_horizon_is_solved_with_its_first_stages(
    position: float, softening: float | None
) -> None:
    """Against the whole problem: no stage, some, and more than the first 50 are at a limit."""
    system = control.ss([[0, 1], [0.2, 0]], [[0, 0], [1, 1]], [[1, 0]], 0, inputs=["u", "d"])
    plant = Plant(control.c2d(system, 0.02), ["u"])
    bounds = Bounds(plant, u_min=-2.5, u_max=2.5, x_max=[8.0, np.inf])
    weights = Weights(np.diag([4.0, 1.0]), 0.1)
    law = Controller(plant, weights, bounds, 150, terminal_set=False, softening=softening)
    drive = scenario(plant, [position, 0.0], disturbance=np.full((60, 1), 0.3))
    along = directions(law, 4, K=np.eye(2, 4), x0=np.eye(2, 4, 2))
    short = prepare_loop(law, along)
    assert short.stages < 150
    found, slope = run_loop(short, drive)
    whole, exact = run_loop(prepare_loop(law, along, whole=True), drive)
    assert whole.complete
    assert np.array_equal(found.status, whole.status)
    for a, b in ((found.x, whole.x), (found.u, whole.u), (slope.x, exact.x), (slope.u, exact.u)):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-8 * max(1.0, float(np.max(np.abs(b)))))
