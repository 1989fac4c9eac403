"""Closed loop with a nonlinear body: trajectory, derivatives, machine code."""

from __future__ import annotations

import casadi as ca
import control
import numpy as np
import pytest
import scipy.integrate

import impc
from impc.arrays import Array
from impc.cli.seat import seat_controller
from impc.control.body_steps import address, next_state, slopes_along
from impc.control.closed_loop import simulate
from impc.control.simulation import Scenario
from impc.inverse.residuals import residual_only
from impc.model.bounds import bound_rows
from plants.seated_balance import nonlinear_dynamics
from plants.seated_subject import seated_parameters_for
from tests.control.hanging_body import pendulum
from tests.support import differences, posed, slopes

STEPS = 60
PUSH = np.repeat(np.random.default_rng(3).choice([-1.0, 0.0, 1.0], STEPS // 6), 6)[:, None]
START = np.array([0.6, -0.4])


def law(plant: impc.Plant, limit: float = 1.5, rate: float = np.inf) -> impc.Controller:
    bounds = impc.Bounds(plant, u_min=-limit, u_max=limit, x_min=[-9, -rate], x_max=[9, rate])
    weights = impc.Weights(np.diag([3.0, 1.0]), 0.2)
    return impc.Controller(plant, weights, bounds, 8, terminal_set=False, softening=50.0)


def drive(plant: impc.Plant) -> Scenario:
    return impc.scenario(plant, START, disturbance=PUSH)


@pytest.mark.full
def test_every_operation_is_casadis_and_its_slopes_are_differences() -> None:
    """Each at 50 points where it is smooth; the largest difference found was 2e-8."""
    x, w = ca.SX.sym("x", 2), ca.SX.sym("w", 2)
    a, b = x[0] + 0.3, x[1] * w[0] + 0.2
    terms = [
        a / b, -a, a * a, a + a, ca.sin(a), ca.cos(a), ca.tan(a), ca.sqrt(a), 1 / a, ca.exp(b),
        ca.log(a), a**b, a**3.7, ca.fabs(b), ca.sign(b), ca.tanh(a), ca.sinh(b), ca.cosh(b),
        ca.asin(b), ca.acos(b), ca.atan(a), ca.atan2(a, b), ca.fmin(a, b), ca.fmax(a, b),
        a * (a < b), b * (a <= b), ca.if_else(a == b, a, b), ca.if_else(a != b, a, b),
        a * ca.logic_not(a < b), b * ca.logic_and(a > 0.4, b < 0.3),
        a * ca.logic_or(a > 0.4, b < 0.3), ca.hypot(a, b), ca.log1p(a), ca.expm1(b), a - b,
    ]  # fmt: skip
    weights = np.cos(np.arange(len(terms)))
    total = sum(weight * term for weight, term in zip(weights, terms, strict=True))
    # Zero value and slopes at rest, so that it is a valid body: products of squares.
    ahead = ca.vertcat(0.5 * x[0] + w[0], w[1] + total * x[0] ** 2)
    inputs = ["u", "d"]
    system = control.ss([[0.5, 0], [0, 0]], np.eye(2), np.eye(2), 0, 0.1, inputs=inputs)
    function = ca.Function("f", [x, w], [ahead])
    plant = impc.Plant(system, ["u"], body=function)
    points = np.random.default_rng(1).uniform(0.05, 0.6, (50, 4))
    given = points[:, :2], points[:, 2:3], points[:, 3:]

    def moved(point: Array) -> Array:
        return np.ravel(function(point[:2], point[2:]).full())

    found = np.concatenate(slopes_along(plant, *given), axis=2)
    wanted = np.array([differences(moved, point) for point in points])
    assert np.allclose(found, wanted, rtol=1e-6, atol=1e-6)
    for state, u, d, point in zip(*given, points, strict=True):
        assert np.allclose(next_state(plant, state, u, d), moved(point), rtol=1e-13)


def test_what_a_condition_leaves_out_may_be_infinite() -> None:
    """The body starts at rest, where the unused branch divides by zero."""
    x, w = ca.SX.sym("x"), ca.SX.sym("w")
    wave = ca.if_else(x == 0, 1, ca.sin(x) / x)
    system = control.ss([[0.5]], [[1.0]], [[1.0]], 0, 0.1, inputs=["u"])
    plant = impc.Plant(system, ["u"], body=ca.Function("f", [x, w], [x * wave / 2 + w]))
    still = np.zeros((1, 1))
    A, B, _ = slopes_along(plant, still, still, np.zeros((1, 0)))
    assert next_state(plant, np.zeros(1), np.zeros(1), np.zeros(0)) == 0
    assert (A.item(), B.item()) == (0.5, 1.0)


@pytest.mark.parametrize("rate", [np.inf, 0.4])
def test_derivatives_equal_central_differences_with_active_bounds(rate: float) -> None:
    """By gain, limit and initial state. Largest difference found: 3e-9 of the largest entry."""
    plant = pendulum()
    controller = law(plant, rate=rate)
    along = impc.directions(
        controller,
        5,
        K=np.eye(2, 5),
        x0=np.eye(2, 5, 2),
        bounds=np.outer(~bound_rows(controller.bounds, plant).on_state, np.eye(5)[4]),
    )
    run, moved = impc.simulate_and_differentiate(controller, drive(plant), along)
    assert run.complete
    np.testing.assert_array_equal(simulate(controller, drive(plant)).x, run.x)
    assert 0.2 < np.mean(run.status > impc.Status.FREE) < 0.9
    # Without a bound the rate reaches 0.55; with a bound of 0.4 the push takes it to 0.50.
    assert (np.max(np.abs(run.x[1:, 1])) < 0.5) == np.isfinite(rate)

    def at(step: Array) -> Array:
        limit = 1.5 + step[4]
        made = impc.Controller.from_gain(
            plant, np.array(controller.K) + step[:2], law(plant, limit, rate).bounds, 8,
            terminal_set=False, softening=50.0,
        )  # fmt: skip
        return np.array(simulate(made, impc.scenario(plant, START + step[2:4], disturbance=PUSH)).x)

    found, wanted = moved.x.reshape(-1, 5), differences(at, np.zeros(5))
    assert np.all(np.max(np.abs(found - wanted), axis=0) <= 1e-6 * np.max(np.abs(wanted), axis=0))


def test_parameters_move_the_body_as_differences_say() -> None:
    """Stiffness and damping affect matrices and body; difference found: 1e-10 of the largest."""
    names = ["stiffness", "damping"]
    family = impc.PlantFamily(lambda values: pendulum(*values.tolist()), names, [2.0, 0.3])
    controller = law(pendulum())
    outputs = simulate(controller, drive(controller.plant)).outputs
    trial = impc.Recording(controller.plant, outputs, np.vstack([PUSH, PUSH[-1:]]), START)
    problem = posed(controller, trial, terminal_set=False, family=family, unknown_start=True)
    K, S = np.array(controller.K), np.array(controller.S)

    def residual(logarithms: Array) -> Array:
        return residual_only(problem.at(problem.starts, logarithms), K, S)

    found, wanted = slopes(problem, K, S)[2], differences(residual, np.zeros(2), 1e-5)
    size = np.max(np.abs(wanted), axis=0)
    assert np.all(size > 0.1)
    assert np.all(np.abs(found - wanted) < 1e-6 * size)


def test_a_sample_of_the_seat_is_that_of_another_integrator() -> None:
    """The closed loop at up to 10 degrees: each step by DOP853 from the previous state.

    Largest difference found: 1e-8 rad, 7e-7 rad/s, where the linear plant is off by 7e-3 rad/s.
    """
    controller = seat_controller({}, 40.0)
    plant = controller.plant
    torque = np.repeat([[15.0], [-15.0], [15.0]], 25, axis=0)
    run = simulate(controller, impc.scenario(plant, np.zeros(plant.n), disturbance=torque))
    assert np.degrees(np.max(np.abs(run.x[:, :2]))) > 6
    exact, drift = nonlinear_dynamics(seated_parameters_for()), []
    for k in range(0, 75, 5):
        held = np.append(run.u[k], torque[k])

        def rates(_: float, x: Array, held: Array = held) -> Array:
            return np.ravel(exact(x, held).full())

        ahead = scipy.integrate.solve_ivp(
            rates, (0, plant.dt), np.array(run.x[k]), method="DOP853", rtol=1e-12, atol=1e-13
        ).y[:, -1]
        assert np.allclose(run.x[k + 1], ahead, rtol=0, atol=1e-6)
        drift.append(plant.A @ run.x[k] + plant.B @ run.u[k] + plant.E @ torque[k] - ahead)
    assert np.max(np.abs(drift)) > 1e-3


def test_the_loop_function_differentiates_through_the_body() -> None:
    """By gain, initial state and push, in forward and reverse mode."""
    plant = pendulum()
    controller = law(plant)
    loop = impc.closed_loop_function(controller, STEPS)
    K, x0, d = ca.MX.sym("K", 1, 2), ca.MX.sym("x0", 2), ca.MX.sym("d", STEPS, 1)
    x, _ = loop(K, 1, x0, d)
    parts = [ca.jacobian(x[-1, :].T, K), ca.jacobian(x[-1, :].T, x0), ca.gradient(x[-1, 0], d)]
    at = np.array(controller.K), START, PUSH
    by_gain, by_start, by_push = (
        part.full() for part in ca.Function("slope", [K, x0, d], parts)(*at)
    )

    def end(gain: Array, start: Array, push: Array) -> Array:
        return np.ravel(loop(gain, 1, start, push)[0][-1, :].full())

    pairs = [
        (by_gain, differences(lambda gain: end(gain, *at[1:]), at[0])),
        (by_start, differences(lambda start: end(at[0], start, PUSH), START)),
        (by_push.T, differences(lambda push: end(*at[:2], push)[:1], PUSH)),
    ]
    for found, wanted in pairs:
        np.testing.assert_allclose(found, wanted, rtol=1e-5, atol=1e-7)


def test_bodies_that_differ_by_parameters_share_their_code() -> None:
    """A family of plants is compiled once; each member has its own constants."""
    one, other = pendulum(2.1), pendulum(2.2)
    assert one.body is not None
    assert other.body is not None
    assert address(one.body, 2, moving=True) == address(other.body, 2, moving=True)
    assert address(one.body, 2, moving=True) != address(one.body, 2, moving=False)
    given = np.array([0.4, -0.2]), np.array([0.3]), np.array([0.1])
    assert np.any(next_state(one, *given) != next_state(other, *given))
