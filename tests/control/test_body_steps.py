"""Closed loop with a nonlinear body: trajectory, derivatives, machine code."""

from __future__ import annotations

import casadi as ca
import control
import numpy as np
import pytest
import scipy.integrate

from experiments.reference_mpc import simulate_mpc
from impc.arrays import Array
from impc.checking import replace
from impc.cli.seat import seat_controller
from impc.control.body_steps import address, body_tape, next_state, slopes_along
from impc.control.casadi_controller import build_mpc
from impc.control.closed_loop import simulate, simulate_and_differentiate
from impc.control.compiled_body import states_along
from impc.control.constraint_rows import directions
from impc.control.controller import Controller
from impc.control.loop_function import closed_loop_function
from impc.control.simulation import Scenario, Status, scenario
from impc.inverse.methods import fit
from impc.inverse.problem import Problem
from impc.inverse.residuals import residual_only
from impc.model.bounds import Bounds, bound_rows
from impc.model.plant import Plant
from impc.model.recordings import Recording
from impc.model.weights import Weights
from plants.seated_balance import nonlinear_dynamics
from plants.seated_subject import seated_parameters_for
from tests.control.hanging_body import linear_body, pendulum, pendulum_family
from tests.support import slopes

STEPS = 60
PUSH = np.repeat(np.random.default_rng(3).choice([-1.0, 0.0, 1.0], STEPS // 6), 6)[:, None]
START = np.array([0.6, -0.4])


def law(plant: Plant, limit: float = 1.5, rate: float = np.inf) -> Controller:
    bounds = Bounds(plant, u_min=-limit, u_max=limit, x_min=[-9, -rate], x_max=[9, rate])
    weights = Weights(np.diag([3.0, 1.0]), 0.2)
    return Controller(plant, weights, bounds, 8, terminal_set=False, softening=50.0)


def drive(plant: Plant) -> Scenario:
    return scenario(plant, START, disturbance=PUSH)


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
    plant = Plant(system, ["u"], body=function)
    rng = np.random.default_rng(1)
    points = rng.uniform(0.05, 0.6, (50, 4))
    given = points[:, :2], points[:, 2:3], points[:, 3:]
    found = np.concatenate(slopes_along(plant, *given), axis=2)
    for j, unit in enumerate(1e-6 * np.eye(4)):
        ends = [
            np.array([function(p[:2], p[2:]).full().ravel() for p in points + sign * unit])
            for sign in (1, -1)
        ]
        assert np.allclose(found[..., j], (ends[0] - ends[1]) / 2e-6, rtol=1e-6, atol=1e-6)
    for state, u, d, point in zip(*given, points, strict=True):
        exact = function(point[:2], point[2:]).full().ravel()
        assert np.allclose(next_state(plant, state, u, d), exact, rtol=1e-13)


def test_what_a_condition_leaves_out_may_be_infinite() -> None:
    """The body starts at rest, where the unused branch divides by zero."""
    x, w = ca.SX.sym("x"), ca.SX.sym("w")
    wave = ca.if_else(x == 0, 1, ca.sin(x) / x)
    system = control.ss([[0.5]], [[1.0]], [[1.0]], 0, 0.1, inputs=["u"])
    plant = Plant(system, ["u"], body=ca.Function("f", [x, w], [x * wave / 2 + w]))
    still = np.zeros((1, 1))
    A, B, _ = slopes_along(plant, still, still, np.zeros((1, 0)))
    assert next_state(plant, np.zeros(1), np.zeros(1), np.zeros(0)) == 0
    assert (A.item(), B.item()) == (0.5, 1.0)


@pytest.mark.parametrize("rate", [np.inf, 0.4])
def test_derivatives_equal_central_differences_with_active_bounds(rate: float) -> None:
    """By gain, limit and initial state. Largest difference found: 3e-9 of the largest entry."""
    plant = pendulum()
    controller = law(plant, rate=rate)
    along = directions(
        controller,
        5,
        K=np.eye(2, 5),
        x0=np.eye(2, 5, 2),
        bounds=np.outer(_on_inputs(controller), np.eye(5)[4]),
    )
    run, moved = simulate_and_differentiate(controller, drive(plant), along)
    assert run.complete
    assert 0.2 < np.mean(run.status > Status.FREE) < 0.9
    # Without a bound the rate reaches 0.55; with a bound of 0.4 the push takes it to 0.50.
    assert (np.max(np.abs(run.x[1:, 1])) < 0.5) == np.isfinite(rate)

    def at(step: Array) -> Array:
        limit = 1.5 + step[4]
        made = Controller.from_gain(
            plant, np.array(controller.K) + step[:2], law(plant, limit, rate).bounds, 8,
            terminal_set=False, softening=50.0,
        )  # fmt: skip
        return np.array(simulate(made, scenario(plant, START + step[2:4], disturbance=PUSH)).x)

    for index, unit in enumerate(1e-6 * np.eye(5)):
        slope = (at(unit) - at(-unit)) / 2e-6
        assert np.max(np.abs(slope - moved.x[..., index])) <= 1e-6 * np.max(np.abs(slope))


def _on_inputs(controller: Controller) -> Array:
    return np.where(bound_rows(controller.bounds, controller.plant).on_state, 0.0, 1.0)


def test_parameters_move_the_body_as_differences_say() -> None:
    """Stiffness and damping affect matrices and body; difference found: 1e-10 of the largest."""
    family = pendulum_family()
    plant = pendulum()
    controller = law(plant)
    run = simulate(controller, drive(plant))
    trial = Recording(plant, run.x @ plant.C.T, np.vstack([PUSH, PUSH[-1:]]), START)
    problem = Problem(
        plant, controller.bounds, 8, [trial], terminal_set=False, family=family, unknown_start=True
    )
    K, S = np.array(controller.K), np.array(controller.S)
    _, _, found, _ = slopes(problem, K, S)
    for index, unit in enumerate(1e-5 * np.eye(2)):
        ends = [residual_only(problem.at(problem.starts, sign * unit), K, S) for sign in (1, -1)]
        slope = (ends[0] - ends[1]) / 2e-5
        assert np.max(np.abs(slope)) > 0.1
        assert np.allclose(found[:, index], slope, atol=1e-6 * np.max(np.abs(slope)))


@pytest.mark.parametrize("limit", [0.7, pytest.param(1e3, marks=pytest.mark.full)])
def test_a_linear_body_is_the_linear_plant(limit: float) -> None:
    """Trajectory, derivatives and fit, with and without saturation."""
    plant = pendulum().linear()
    twin = linear_body(plant)
    mild = PUSH / 2
    K = np.array(law(plant).K)
    runs, fits = [], []
    for one in (plant, twin):
        controller = Controller.from_gain(one, K, law(one, limit).bounds, 8, terminal_set=False)
        along = directions(controller, 4, K=np.eye(2, 4), x0=np.eye(2, 4, 2))
        given = scenario(one, [0.1, 0.0], disturbance=mild)
        runs.append(simulate_and_differentiate(controller, given, along))
        clean = runs[0][0].x @ plant.C.T
        noise = 1e-3 * np.random.default_rng(0).standard_normal(clean.shape)
        trial = Recording(one, clean + noise, np.vstack([mild, mild[-1:]]), [0.1, 0.0])
        problem = Problem(one, controller.bounds, 8, [trial], terminal_set=False)
        fits.append(fit(problem))
    (run, moved), (twin_run, twin_moved) = runs
    assert np.any(run.status > Status.FREE) == (limit < 1)
    assert np.allclose(run.x, twin_run.x, atol=1e-12)
    assert np.allclose(moved.x, twin_moved.x, atol=1e-11)
    assert np.allclose(fits[0].gain, fits[1].gain, rtol=1e-6)


def test_a_sample_of_the_seat_is_that_of_another_integrator() -> None:
    """The closed loop at up to 10 degrees: each step by DOP853 from the previous state.

    Largest difference found: 1e-8 rad, 7e-7 rad
    s, where the linear plant is off by 7e-3 rad
    s.
    """
    controller = seat_controller({}, 40.0)
    plant = controller.plant
    torque = np.repeat([[15.0], [-15.0], [15.0]], 25, axis=0)
    run = simulate(controller, scenario(plant, np.zeros(plant.n), disturbance=torque))
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


def test_other_solvers_and_casadis_controller_move_the_same_body() -> None:
    plant = pendulum()
    controller = law(plant)
    run = simulate(controller, drive(plant))
    other = simulate(replace(controller, solver="daqp"), drive(plant))
    assert np.allclose(other.x, run.x, atol=1e-8)
    assert np.allclose(
        simulate_mpc(build_mpc(controller, "qpoases"), drive(plant)).x, run.x, atol=1e-6
    )
    assert (
        np.max(np.abs(simulate(replace(controller, plant=plant.linear()), drive(plant)).x - run.x))
        > 1e-2
    )


def test_the_loop_function_differentiates_through_the_body() -> None:
    """By gain, initial state and push, in forward and reverse mode."""
    plant = pendulum()
    controller = law(plant)
    loop = closed_loop_function(controller, STEPS)
    K, x0, d = ca.MX.sym("K", 1, 2), ca.MX.sym("x0", 2), ca.MX.sym("d", STEPS, 1)
    x, _ = loop(K, 1, x0, d)
    last = x[-1, :].T
    slope = ca.Function(
        "slope", [K, x0, d], [ca.jacobian(last, K), ca.jacobian(last, x0), ca.gradient(x[-1, 0], d)]
    )
    at = np.array(controller.K), START, PUSH
    by_gain, by_start, by_push = (part.full() for part in slope(*at))

    def end(gain: Array, start: Array, push: Array) -> Array:
        return np.ravel(loop(gain, 1, start, push)[0][-1, :].full())

    h = 1e-6
    for index, unit in enumerate(h * np.eye(2)):
        moved = end(at[0] + unit, START, PUSH) - end(at[0] - unit, START, PUSH)
        assert np.allclose(by_gain[:, index], moved / (2 * h), rtol=1e-5, atol=1e-7)
        moved = end(at[0], START + unit, PUSH) - end(at[0], START - unit, PUSH)
        assert np.allclose(by_start[:, index], moved / (2 * h), rtol=1e-5, atol=1e-7)
    for k in (0, 20, 45, 59):
        push = np.zeros_like(PUSH)
        push[k] = h
        moved = end(at[0], START, PUSH + push) - end(at[0], START, PUSH - push)
        assert np.allclose(by_push[k, 0], moved[0] / (2 * h), rtol=1e-5, atol=1e-7)


def test_bodies_that_differ_by_parameters_share_their_code() -> None:
    """A family of plants is compiled once; each member has its own constants."""
    one, other = pendulum(2.1), pendulum(2.2)
    assert one.body is not None
    assert other.body is not None
    assert address(one.body, 2, moving=True) == address(other.body, 2, moving=True)
    assert address(one.body, 2, moving=True) != address(one.body, 2, moving=False)
    given = np.array([0.4, -0.2]), np.array([0.3]), np.array([0.1])
    assert np.any(next_state(one, *given) != next_state(other, *given))


def test_the_same_states_with_derivatives_and_without() -> None:
    """Identical to the last digit; without derivatives nothing behind the states is written."""
    body = pendulum().body
    x, rest = np.random.default_rng(0).standard_normal((30, 2)), np.zeros((30, 1))
    found = []
    for moving in (False, True):
        tape, ahead = body_tape(body, 2, 4, moving=moving), np.empty((30, 2))
        states_along(tape, x, rest, rest, ahead)
        assert bool(np.any(tape.slopes)) == moving
        found.append(ahead)
    assert np.array_equal(found[0], found[1])
