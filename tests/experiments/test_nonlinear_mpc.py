"""The nonlinear controller equals the linear one for small angles and differs as their square."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from experiments.nonlinear_check import compare_at
from experiments.nonlinear_mpc import build_nonlinear_mpc, simulate_nonlinear
from impc.control.closed_loop import simulate
from impc.control.controller import Controller
from impc.control.simulation import scenario
from impc.model.bounds import Bounds
from impc.model.plant import Plant
from impc.model.weights import Weights
from plants import yalmip_example


def linear_step(plant: Plant) -> ca.Function:
    x, u = ca.SX.sym("x", plant.n), ca.SX.sym("u", plant.m)
    ahead = ca.DM(np.array(plant.A)) @ x + ca.DM(np.array(plant.B)) @ u
    return ca.Function("step", [x, u], [ahead])


@pytest.mark.parametrize("x0", [[1.0, 3.0], [2.0, 3.0], [2.0, 1.0]])
def test_on_a_linear_plant_it_is_the_linear_controller(x0: list[float]) -> None:
    plant = Plant(yalmip_example())
    weights, bounds = Weights(np.eye(2), 1), Bounds(plant, u_min=-1, u_max=1)
    mpc = build_nonlinear_mpc(linear_step(plant), plant, weights, bounds, 3)
    drive = scenario(plant, x0, 20)
    controller = Controller(plant, weights, bounds, 3, terminal_set=False)
    found, expected = simulate_nonlinear(mpc, drive), simulate(controller, drive)
    assert found.complete
    np.testing.assert_allclose(found.u, expected.u, atol=2e-6)


@pytest.mark.full
def test_on_the_seat_they_part_as_the_square_of_the_angle() -> None:
    """Twice the torque gives four times the relative difference, within 20 %; trials of 1 s."""
    small, double = compare_at(1.0, 1.0), compare_at(2.0, 1.0)
    shares = [item.controllers / item.angle for item in (small, double)]
    assert shares[0] < 1e-3
    assert shares[1] / shares[0] == pytest.approx(4.0, rel=0.2)


def test_a_loop_that_falls_ends_where_it_falls() -> None:
    plant = Plant(yalmip_example())
    weights, bounds = Weights(np.eye(2), 1), Bounds(plant, u_min=-0.01, u_max=0.01)
    mpc = build_nonlinear_mpc(linear_step(plant), plant, weights, bounds, 3)
    run = simulate_nonlinear(mpc, scenario(plant, [3.0, 3.0], 400))
    assert not run.complete
    assert 0 < run.reached < 400
    np.testing.assert_array_equal(run.x[run.reached + 1], run.x[-1])
