"""The reference for the hard plants, against other solvers, and solutions that it rejects."""

from __future__ import annotations

from decimal import Decimal

import numpy as np
import pytest

from impc.checking import replace
from impc.control.closed_loop import simulate
from impc.control.simulation import Status
from tests import independent_mpc
from tests.exact_mpc import ROUNDED, ExactProgram, exact
from tests.exact_search import first_input
from tests.hard_plants import faults, hard_case
from tests.support import random_plant, random_weights


@pytest.mark.parametrize("seed", range(8))
def test_any_guess_ends_at_the_answer_of_clarabel(seed: int) -> None:
    """Starts inside and outside the feasible set: a solution exists where HiGHS finds a plan."""
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
        if not independent_mpc.has_plan(plant.A, plant.B, N, x, 0.5, 2.0):
            assert found == [None, None]
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
    t = int(np.flatnonzero(run.status == Status.ACTIVE)[0])
    x, u, status = run.x.copy(), run.u.copy(), run.status.copy()
    status[t + 1 :] = Status.NOT_REACHED
    assert faults(case, replace(run, status=status), 1) == []
    u[t] -= 2e-7 * np.minimum(-bounds.u_min, bounds.u_max) * np.sign(u[t])
    x[t + 1] = plant.A @ x[t] + plant.B @ u[t]
    (found,) = faults(case, replace(run, x=x, u=u, status=status), 1)
    assert found == f"sample {t}: 2.0e-07 of the bound from the reference"
    status[t] = Status.INFEASIBLE
    assert "called infeasible, and there is a plan" in faults(case, replace(run, status=status), 1)
    status[t] = Status.DIVERGED
    (found,) = faults(case, replace(run, status=status), 1)
    assert found == "called diverged with a state in range"
