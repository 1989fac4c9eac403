"""Controllers at and beyond the edge of what they can keep: right, or a status that says no.

The reference is `tests/exact_mpc.py`: the program in u from (Q, R, P), proved in a hundred digits.
"""

from __future__ import annotations

import control
import numpy as np
import pytest

from impc.checking import replace
from impc.control.closed_loop import prepare_loop, run_loop, simulate
from impc.control.constraint_rows import build_rows, directions
from impc.control.controller import Controller
from impc.control.infeasibility import proves_infeasible
from impc.control.simulation import Scenario, Status, require_complete, scenario
from impc.errors import SolverError
from impc.model.bounds import Bounds
from impc.model.plant import Plant
from impc.model.weights import Weights
from tests.hard_plants import STEPS, HardCase, faults, hard_case
from tests.support import random_plant, random_weights


def runaway(pole: float, horizon: int) -> HardCase:
    """Three states, two of them unstable, from which no plan comes near the gain."""
    A = [[pole, 1, 0], [0, pole, 0.5], [0, 0, 0.8]]
    plant = Plant(control.ss(A, [[0], [0.1], [1]], np.eye(3), 0, True))
    weights = Weights(np.eye(3), 1)
    bounds = Bounds(plant, u_min=-1, u_max=1)
    controller = Controller(plant, weights, bounds, horizon, terminal_set=False)
    return HardCase(weights, controller, Scenario(np.ones(3), np.zeros((STEPS, 0))))


@pytest.mark.parametrize(
    ("pole", "horizon", "reached"),
    [(2, 20, 16), (2, 30, 16), (2, 60, 16), (1.6, 40, 24), (1.4, 40, 40)],
)
def test_a_plant_that_runs_away_is_driven_at_its_bound(
    pole: float, horizon: int, reached: int
) -> None:
    """The inputs were 5.9, 26.5, none, 5e6 and 1.00003 where the bound is 1."""
    case = runaway(pole, horizon)
    run = simulate(case.controller, case.drive)
    assert run.reached == reached
    assert run.complete or run.status[reached] == Status.DIVERGED
    assert faults(case, run, 4) == []


def test_soft_rows_on_a_plant_that_runs_away_are_refused_by_name() -> None:
    """The recursion over the stages has no rows of states: nothing is applied that is not told."""
    case = runaway(2, 30)
    bounds = Bounds(case.controller.plant, u_min=-1, u_max=1, x_min=-1, x_max=1)
    controller = replace(case.controller, bounds=bounds, softening=50.0)
    run = simulate(controller, case.drive)
    assert run.status[run.reached] == Status.UNSOLVED
    assert np.all(np.abs(run.u) <= 1 + 1e-9)
    with pytest.raises(SolverError, match="could not be told in double precision"):
        require_complete(controller, run)


@pytest.mark.parametrize("seed", range(12))
def test_both_ways_to_an_answer_agree_and_so_do_their_derivatives(seed: int) -> None:
    """Where the rows tell the input, the recursion over the stages gives the same.

    An error measured by a unit of zero is always too large: every program then goes the second way.
    """
    rng = np.random.default_rng([15, seed])
    n, m = 2 + seed % 3, 1 + seed % 3
    plant = random_plant(rng, n, m, 1.1, d=1)
    weights = Weights(random_weights(rng, n), random_weights(rng, m))
    bounds = Bounds(plant, u_min=-0.4, u_max=0.5)
    controller = Controller(plant, weights, bounds, 6, terminal_set=False)
    given = {
        name: rng.normal(size=(*shape, 5))
        for name, shape in (("A", (n, n)), ("B", (n, m)), ("K", (m, n)), ("x0", (n,)))
    }
    metric = rng.normal(size=(m, m, 5))
    moved = {"S": metric + np.swapaxes(metric, 0, 1), "bounds": rng.normal(size=(2 * m, 5))}
    prepared = prepare_loop(controller, directions(controller, 5, **given, **moved))
    x0 = rng.normal(size=n)
    x0 /= np.max(np.abs(controller.K @ x0))  # the gain asks for twice the bound
    drive = scenario(plant, x0, disturbance=0.1 * rng.normal(size=15))
    run, slope = run_loop(prepared, drive)
    other, second = run_loop(replace(prepared, unit=np.zeros(m)), drive)
    assert Status.ACTIVE in run.status
    np.testing.assert_array_equal(other.status, run.status)
    for one, two in ((run, other), (slope, second)):
        for name in ("x", "u"):
            expected = getattr(one, name)
            error = np.max(np.abs(getattr(two, name) - expected))
            assert error <= 1e-9 * max(1.0, float(np.max(np.abs(expected)))), name


def test_nothing_proves_a_feasible_program_infeasible(example_plant: Plant) -> None:
    """Random multipliers, at starts from which a plan keeps every row."""
    rng = np.random.default_rng(16)
    bounds = Bounds(example_plant, u_min=-1, u_max=1, x_min=-3, x_max=3)
    controller = Controller(example_plant, Weights(np.eye(2), 1), bounds, 3)
    rows = build_rows(controller)
    for x0 in ([0.0, 0.0], [1.0, 1.5], [-1.0, -1.5]):
        assert simulate(controller, scenario(example_plant, x0, 1)).complete
        for _ in range(20):
            y = rng.exponential(size=len(rows.b)) * (rng.random(len(rows.b)) < 0.3)
            assert not proves_infeasible(controller, rows, y, np.array(x0))


@pytest.mark.parametrize("block", range(6))
def test_random_plants_are_right_or_say_no(block: int) -> None:
    """Sixty small ones of the same kind as the two thousand below."""
    check(range(10 * block, 10 * block + 10), largest=16, samples=1)


@pytest.mark.parametrize("seed", [10115, 10461, 10622, 10994])
def test_seeds_that_were_wrong_once(seed: int) -> None:
    """No reference; no terminal set; a search of 44 s; a state that rounding left outside."""
    check(range(seed, seed + 1), largest=60, samples=2)


@pytest.mark.slow
@pytest.mark.parametrize("block", range(40))
def test_two_thousand_random_plants_are_right_or_say_no(block: int) -> None:
    check(range(10_000 + 50 * block, 10_050 + 50 * block), largest=60, samples=2)


def check(seeds: range, largest: int, samples: int) -> None:
    """No fault in any; what is not told in double precision is a small part."""
    wrong, untold = {}, 0
    for seed in seeds:
        case = hard_case(seed, largest)
        run = simulate(case.controller, case.drive)
        untold += Status.UNSOLVED in run.status
        found = faults(case, run, samples)
        if found:
            wrong[seed] = found
    assert wrong == {}
    assert untold <= 0.1 * len(seeds)  # 35 of the 2000
