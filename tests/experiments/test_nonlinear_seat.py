"""A small study of subjects who predict with the full equations."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from experiments.nonlinear_seat import first_torques, fitted_person
from impc.cli.seat import HORIZON, seat_controller, seat_weights
from impc.control.closed_loop import simulate
from impc.control.simulation import scenario
from impc.model.riccati import solve_lqr
from impc.nonlinear.problem import OptimalControlProblem
from plants import seated_balance_for, ternary_torque

pytestmark = pytest.mark.full


def test_the_first_torque_from_a_tilt_is_that_of_the_optimality_conditions() -> None:
    """IPOPT with single shooting, compared with Newton's method on all states at once.

    They agree to 8e-9 N m; the numbers are those of experiments/nonlinear_seat.md.
    """
    plant = seat_controller({}, np.inf).plant
    weights = seat_weights(plant)
    x, u, effort = ca.SX.sym("x", plant.n), ca.SX.sym("u"), ca.SX.sym("effort")
    Q, P = (ca.DM(np.array(item)) for item in (weights.Q, solve_lqr(plant, weights).P))
    problem = OptimalControlProblem(
        x, u, {"effort": effort}, seated_balance_for().body()(x, ca.vertcat(u, 0)),
        ca.bilin(Q, x, x) + effort * u**2, HORIZON, terminal_cost=ca.bilin(P, x, x),
    )  # fmt: skip
    for together, gap in ((False, -0.428), (True, -3.278)):
        (full, linear), *_ = first_torques([np.radians(6.0)], together=together)
        x0 = np.zeros(plant.n)
        x0[:2] = np.radians(6.0) * np.array([1, together])
        assert full == pytest.approx(problem.plan({"effort": 1.0}, x0).u[0, 0], abs=1e-6)
        assert full - linear == pytest.approx(gap, abs=1e-3)


def test_the_fit_of_a_person_who_predicts_linearly_is_not_off() -> None:
    controller = seat_controller({}, 6.0)
    torque = ternary_torque(5.0, duration=3.0, rate=100.0)
    drive = scenario(controller.plant, np.zeros(controller.plant.n), disturbance=torque)
    found = fitted_person(controller, drive, simulate(controller, drive), np.ones((1, 10)))
    assert found.error < 1e-6
    assert found.torque < 1e-6
    assert found.vaf == pytest.approx(100, abs=1e-9)
