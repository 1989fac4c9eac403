"""Set points and costs of changes against do-mpc, if it is installed (not a dependency)."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import impc
from impc.arrays import Array
from tests.support import random_plant

do_mpc = pytest.importorskip("do_mpc")
pytestmark = pytest.mark.filterwarnings("ignore::FutureWarning", "ignore::UserWarning")

STEPS, HORIZON = 12, 8


def closed_loop(
    plant: impc.Plant, cost: Any, last: Any, change: Array, limit: float, x0: Array
) -> Array:
    """Inputs (STEPS, m) of do-mpc with stage cost, terminal cost and cost of changes."""
    model = do_mpc.model.Model("discrete")
    x = model.set_variable("_x", "x", shape=(plant.n, 1))
    u = model.set_variable("_u", "u", shape=(plant.m, 1))
    model.set_rhs("x", plant.A @ x + plant.B @ u)
    model.setup()
    mpc = do_mpc.controller.MPC(model)
    mpc.settings.n_horizon, mpc.settings.t_step = HORIZON, 1.0
    mpc.settings.nlpsol_opts = {"ipopt.print_level": 0, "print_time": 0, "ipopt.tol": 1e-13}
    mpc.set_objective(lterm=cost(x, u), mterm=last(x))
    mpc.set_rterm(u=change)
    mpc.bounds["lower", "_u", "u"], mpc.bounds["upper", "_u", "u"] = -limit, limit
    mpc.setup()
    state, found = x0.reshape(-1, 1), []
    mpc.x0, mpc.u0 = state, np.zeros((plant.m, 1))
    mpc.set_initial_guess()
    for _ in range(STEPS):
        found.append(mpc.make_step(state).ravel())
        state = plant.A @ state + plant.B @ found[-1][:, None]
    return np.array(found)


@pytest.mark.parametrize("limit", [0.4, 50.0])
def test_a_set_point(limit: float) -> None:
    rng = np.random.default_rng(2)
    plant = random_plant(rng, 3, 2, 1.05)
    Q, R = np.diag([3.0, 1.0, 0.5]), np.diag([1.0, 2.0])
    target = {plant.states[0]: 0.2, plant.states[1]: -0.1}
    bounds = impc.Bounds(plant, u_min=-limit, u_max=limit)
    law = impc.Controller(plant, impc.Weights(Q, R), bounds, HORIZON, terminal_set=False)
    x0 = np.array([0.5, -0.4, 0.3])
    run = law.simulate(x0, steps=STEPS, target=target)
    x_s, u_s = impc.steady_state(plant, target, bounds=bounds)
    P = np.array(impc.solve_lqr(plant, impc.Weights(Q, R)).P)

    def cost(x: Any, u: Any) -> Any:
        return (x - x_s).T @ Q @ (x - x_s) + (u - u_s).T @ R @ (u - u_s)

    wanted = closed_loop(plant, cost, lambda x: (x - x_s).T @ P @ (x - x_s), np.zeros(2), limit, x0)
    assert run.u == pytest.approx(wanted, abs=1e-6)
    assert bool(np.any(run.status == 1)) == (limit < 1)


@pytest.mark.parametrize("limit", [0.3, 50.0])
def test_the_cost_of_changes(limit: float) -> None:
    """The terminal weight of changes includes the last command."""
    plant = random_plant(np.random.default_rng(3), 2, 1, 0.8)
    rates = impc.with_rates(plant)
    Q, r, v = np.diag([2.0, 1.0]), 0.1, 0.7
    bounds = impc.Bounds(rates, x_min={plant.controls[0]: -limit}, x_max={plant.controls[0]: limit})
    weights = impc.Weights(np.diag([2.0, 1.0, r]), v)
    law = impc.Controller(
        rates, weights, bounds, HORIZON, terminal_set=False, terminal_weight=weights.Q
    )
    run = law.simulate([1.5, -2.0, 0.0], steps=STEPS)
    wanted = closed_loop(
        plant,
        lambda x, u: x.T @ Q @ x + r * u**2,
        lambda x: x.T @ Q @ x,
        np.array([v]),
        limit,
        np.array([1.5, -2.0]),
    )
    applied = run.x[1:, 2:]
    assert applied == pytest.approx(wanted, abs=1e-6)
    assert bool(np.any(run.status == 1)) == (limit < 1)
