"""Controllers at and beyond the limit of feasibility: correct, or a status of failure.

The reference is `tests/exact_mpc.py`: the program in u from (Q, R, P), proved in 100 digits; it is
compared with other solvers, and rejects what is no solution.
"""

from __future__ import annotations

from decimal import Decimal

import control
import numpy as np
import pytest

import impc
from impc.control.closed_loop import simulate
from impc.control.simulation import Scenario
from tests import independent_mpc
from tests.exact_mpc import ROUNDED, ExactProgram, exact, first_input
from tests.hard_plants import STEPS, HardCase, faults, hard_case
from tests.support import random_plant, random_weights


def runaway(pole: float, horizon: int) -> HardCase:
    """Three states, two of them unstable, from which no plan comes near the gain."""
    A = [[pole, 1, 0], [0, pole, 0.5], [0, 0, 0.8]]
    plant = impc.Plant(control.ss(A, [[0], [0.1], [1]], np.eye(3), 0, True))
    weights = impc.Weights(np.eye(3), 1)
    bounds = impc.Bounds(plant, u_min=-1, u_max=1)
    controller = impc.Controller(plant, weights, bounds, horizon, terminal_set=False)
    return HardCase(weights, controller, Scenario(np.ones(3), np.zeros((STEPS, 0))))


@pytest.mark.parametrize(("pole", "horizon"), [(2, 20), (2, 30), (2, 60), (1.6, 40), (1.4, 40)])
def test_a_plant_that_runs_away_is_right_or_refused(pole: float, horizon: int) -> None:
    """Regression: the inputs were 5.9, 26.5, none, 5e6 and 1.00003 at a bound of 1."""
    case = runaway(pole, horizon)
    run = simulate(case.controller, case.drive)
    assert run.complete or run.status[run.reached] in (impc.Status.DIVERGED, impc.Status.UNSOLVED)
    assert faults(case, run, 4) == []


def test_soft_rows_on_a_plant_that_runs_away_are_refused_by_name() -> None:
    """No undetermined input is applied."""
    case = runaway(2, 30)
    bounds = impc.Bounds(case.controller.plant, u_min=-1, u_max=1, x_min=-1, x_max=1)
    controller = impc.replace(case.controller, bounds=bounds, softening=50.0)
    run = simulate(controller, case.drive)
    assert run.status[run.reached] == impc.Status.UNSOLVED
    assert np.all(np.abs(run.u) <= 1 + 1e-9)
    with pytest.raises(impc.SolverError, match="cannot be determined in double precision"):
        impc.require_complete(controller, run)


def test_random_plants_are_right_or_say_no() -> None:
    """Sixty small plants of the same kind as the two thousand below."""
    check(range(60), largest=16, samples=1)


@pytest.mark.parametrize("seed", [10115, 10461, 10622, 10820, 10994])
def test_seeds_that_were_wrong_once(seed: int) -> None:
    """No reference, no terminal set, a search of 44 s, one without end, a state just outside."""
    check(range(seed, seed + 1), largest=60, samples=2)


@pytest.mark.slow
@pytest.mark.parametrize("block", range(40))
def test_two_thousand_random_plants_are_right_or_say_no(block: int) -> None:
    check(range(10_000 + 50 * block, 10_050 + 50 * block), largest=60, samples=2)


def check(seeds: range, largest: int, samples: int) -> None:
    """No plant may fail; only a small part may be undetermined in double precision."""
    wrong, unidentified = {}, 0
    for seed in seeds:
        case = hard_case(seed, largest)
        run = simulate(case.controller, case.drive)
        unidentified += impc.Status.UNSOLVED in run.status
        found = faults(case, run, samples)
        if found:
            wrong[seed] = found
    assert wrong == {}
    assert unidentified <= 0.3 * len(seeds)  # 8 of the 60: plants that run away


@pytest.mark.parametrize("seed", range(8))
def test_any_guess_ends_at_the_answer_of_clarabel(seed: int) -> None:
    """Starts inside and outside the feasible set; that there is no answer is proved."""
    rng = np.random.default_rng([18, seed])
    n, m, N = 2 + seed % 3, 1 + seed % 2, 5
    plant = random_plant(rng, n, m, 1.2)
    Q, R = random_weights(rng, n), random_weights(rng, m)
    box = np.vstack([np.eye(n), -np.eye(n)]), np.full(2 * n, 2.0)
    program = ExactProgram(plant.A, plant.B, Q, R, N, np.full(m, -0.5), np.full(m, 0.5), box)
    answers = []
    for size in (0.2, 1.0, 1.9):
        x = size * rng.uniform(-1, 1, size=n)
        none = np.zeros(len(program.sides), dtype=bool)
        found = [first_input(program, x, guess) for guess in (none, rng.random(len(none)) < 0.3)]
        answers.append(found[0])
        if found[0] is None:
            assert found[1] is None
            continue
        other = independent_mpc.first_input(plant.A, plant.B, Q, R, N, x, 0.5, 2.0)
        for u in found:
            assert u is not None
            np.testing.assert_allclose(u, other, atol=1e-7)
    assert answers[0] is not None


def test_what_is_no_answer_is_not_proved() -> None:
    """x+ = x + u from 3 with |u| <= 1 and two steps: the bound, then the bound or just below."""
    one = np.eye(1)
    program = ExactProgram(one, one, one, one, 2, -np.ones(1), np.ones(1))
    x, u = exact([3.0]), exact([[-1.0], [-1.0]])
    cost_weight = program.pull(program.states(x, u), u, exact(np.zeros(4))).ravel()
    right = np.concatenate([exact([0.0, 0.0]), cost_weight])
    assert program.is_optimal(x, u, right, ROUNDED)
    moved = exact([[-1.0], [-1.0 + 1e-9]])
    assert not program.is_optimal(x, moved, right, ROUNDED)
    assert not program.is_optimal(x, moved, right, Decimal("1e-8"))  # the multipliers are others
    assert not program.is_optimal(x, u, 2 * right, ROUNDED)
    assert not program.is_optimal(x, u - exact(1e-9), right, ROUNDED)
    assert not program.is_excluded(x, right)


def test_a_wrong_simulation_is_noticed() -> None:
    """Stopped at its first program, an input off by 2e-7 of the bound, or a wrong status."""
    case = hard_case(10002)
    plant, bounds = case.controller.plant, case.controller.bounds
    run = simulate(case.controller, case.drive)
    t = int(np.flatnonzero(run.status == impc.Status.ACTIVE)[0])
    x, u, status = run.x.copy(), run.u.copy(), run.status.copy()
    status[t + 1 :] = impc.Status.NOT_REACHED
    assert faults(case, impc.replace(run, status=status), 1) == []
    u[t] -= 2e-7 * np.minimum(-bounds.u_min, bounds.u_max) * np.sign(u[t])
    x[t + 1] = plant.A @ x[t] + plant.B @ u[t]
    (found,) = faults(case, impc.replace(run, x=x, u=u, status=status), 1)
    assert found == f"sample {t}: 2.0e-07 of the bound from the reference"
    status[t] = impc.Status.INFEASIBLE
    assert "called infeasible, and there is a plan" in faults(
        case, impc.replace(run, status=status), 1
    )
    status[t] = impc.Status.DIVERGED
    (found,) = faults(case, impc.replace(run, status=status), 1)
    assert found == "called diverged with a state in range"
