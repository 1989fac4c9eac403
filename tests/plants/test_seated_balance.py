"""The seated-balance plant: its equations, its linearisation and the reference's numbers."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
import scipy.linalg

from plants import (
    SeatedBalanceParameters,
    body_dynamics,
    continuous_seated_balance_plant,
    delayed_muscle,
    nonlinear_dynamics,
    runge_kutta_step,
    seated_balance_for,
    seated_balance_plant,
    seated_balance_step_for,
    seated_parameters_for,
    ternary_torque,
)
from plants._checks import Array
from plants.seated_balance import seated_balance_slopes
from tests.support import extrapolated_slope


def random_parameters(rng: np.random.Generator) -> SeatedBalanceParameters:
    base = SeatedBalanceParameters()
    factors = rng.uniform(0.5, 2.0, len(fields(base)))
    return SeatedBalanceParameters(
        **{f.name: getattr(base, f.name) * x for f, x in zip(fields(base), factors, strict=True)}
    )


def test_slopes_of_the_matrices_are_differences() -> None:
    p = random_parameters(np.random.default_rng(7))
    for name, slopes in seated_balance_slopes(p, 0.01, 5).items():
        value = getattr(p, name)

        def moved(t: float, name: str = name, value: float = value) -> Array:
            plant = seated_balance_plant(replace(p, **{name: value + t}), 0.01, 5)
            return np.hstack([plant.A, plant.B])

        slope, differences = np.hstack(slopes), extrapolated_slope(moved, 1e-2 * value)
        np.testing.assert_allclose(slope, differences, atol=1e-6 * np.max(np.abs(slope)))


def energies(p: SeatedBalanceParameters) -> tuple[ca.SX, ca.SX, ca.SX]:
    """Kinetic and potential energy from the positions of the two centres of mass."""
    state = ca.SX.sym("state", 4)
    angles, rates = state[:2], state[2:]
    lower = p.l1 * ca.vertcat(ca.sin(angles[0]), ca.cos(angles[0]))
    joint = p.l12 * ca.vertcat(ca.sin(angles[0]), ca.cos(angles[0]))
    upper = joint + p.l2 * ca.vertcat(ca.sin(angles[1]), ca.cos(angles[1]))
    speeds = [ca.jtimes(place, angles, rates) for place in (lower, upper)]
    kinetic = 0.5 * sum(m * ca.sumsqr(v) for m, v in zip((p.m1, p.m2), speeds, strict=True))
    kinetic += 0.5 * (p.J1 * rates[0] ** 2 + p.J2 * rates[1] ** 2)
    potential = p.gravity * (p.m1 * lower[1] + p.m2 * upper[1])
    potential += 0.5 * (p.k_r * angles[0] ** 2 + p.k_h * (angles[0] - angles[1]) ** 2)
    return state, kinetic, potential


def test_equations_are_those_of_lagrange() -> None:
    rng = np.random.default_rng(7)
    for _ in range(5):
        p = random_parameters(rng)
        state, kinetic, potential = energies(p)
        rates = state[2:]
        momentum = ca.gradient(kinetic, state)[2:]
        inputs = ca.SX.sym("input", 2)
        u, d = inputs[0], inputs[1]
        slip = rates[0] - rates[1]
        forces = ca.vertcat(d - u - p.c_r * rates[0] - p.c_h * slip, u + p.c_h * slip)
        slope = ca.gradient(kinetic - potential, state)[:2]
        coriolis = ca.jtimes(momentum, state, ca.vertcat(rates, 0, 0))
        acceleration = ca.solve(ca.jacobian(momentum, state)[:, 2:], forces + slope - coriolis)
        lagrange = ca.Function("lagrange", [state, inputs], [ca.vertcat(rates, acceleration)])
        x, w = rng.normal(size=4), rng.normal(size=2) * 10
        np.testing.assert_allclose(
            body_dynamics(p)(x, w).full(), lagrange(x, w).full(), rtol=1e-10, atol=1e-10
        )


def test_linearisation_is_the_central_difference_of_the_nonlinear_equations() -> None:
    rng = np.random.default_rng(7)
    for p in (SeatedBalanceParameters(), random_parameters(rng)):
        plant, dynamics = continuous_seated_balance_plant(p), nonlinear_dynamics(p)
        exact = np.hstack([plant.A, plant.B])
        for unit, column in zip(np.eye(12), exact.T, strict=True):

            def moved(t: float, unit: Array = unit, dynamics: Any = dynamics) -> Array:
                return np.asarray(dynamics(t * unit[:10], t * unit[10:]).full()[:, 0])

            found = extrapolated_slope(moved)
            np.testing.assert_allclose(found, column, rtol=1e-8, atol=1e-8)


def test_numbers_of_the_reference() -> None:
    plant = continuous_seated_balance_plant()
    A = plant.A[:4, :4]
    np.testing.assert_allclose(
        A[2:], [[-7.959, -5.419, -2.478, 1.1419], [13.0633, 21.3689, 2.376, -1.4282]], atol=5.1e-5
    )
    np.testing.assert_allclose(plant.A[:4, -1], [0, 0, -0.4568, 0.5713], atol=5e-5)
    np.testing.assert_allclose(plant.B[:4, 1], [0, 0, 0.2672, -0.1896], atol=5e-5)
    poles = sorted(np.linalg.eigvals(A), key=lambda pole: (pole.real, pole.imag))
    np.testing.assert_allclose(poles, [-5.376, -1.211 - 1.811j, -1.211 + 1.811j, 3.892], atol=6e-4)
    p = SeatedBalanceParameters()
    assert (p.m1 * p.l1 + p.m2 * p.l12) * p.gravity == pytest.approx(141.5, abs=0.05)
    assert p.m2 * p.l2 * p.gravity == pytest.approx(100.9, abs=0.05)
    sampled = seated_balance_plant()
    assert np.abs(np.linalg.eigvals(sampled.A)).max() == pytest.approx(1.0397, abs=5e-5)
    reach = [np.linalg.matrix_power(sampled.A, k) @ sampled.B[:, :1] for k in range(10)]
    table = np.hstack(reach) / np.linalg.norm(np.hstack(reach), axis=1, keepdims=True)  # no units
    assert np.linalg.matrix_rank(table) == 10


def test_the_intent_of_the_reference_has_its_gain_and_extremes() -> None:
    """Under the ternary torque.

    The reference weights the delay states by 1e-2 in the companion form, where they are so small
    that this is no weight at all: 0 here.
    """
    plant, direction = seated_balance_plant(), np.array([0.70, 0.65, 0.22, 0.20])
    direction /= np.linalg.norm(direction)
    Q = np.diag([2e4, 2e4, 500.0, 500.0, *[0.0] * 5, 1e-2])
    Q[:4, :4] += 6e5 * np.outer(direction, direction)
    B = plant.B[:, :1]
    P = scipy.linalg.solve_discrete_are(plant.A, B, Q, np.eye(1))
    K = np.linalg.solve(1 + B.T @ P @ B, B.T @ P @ plant.A)[0]
    np.testing.assert_allclose(K[:4], [814.34, 1478.09, 325.57, 365.90], atol=5.1e-3)
    assert K[9] == pytest.approx(2.561, abs=5e-4)
    radius = np.abs(np.linalg.eigvals(plant.A - np.outer(B, K))).max()
    assert radius == pytest.approx(0.9677, abs=5e-5)
    step, states = runge_kutta_step(nonlinear_dynamics(), 0.01), [np.zeros(10)]
    for d in ternary_torque():
        states.append(step(states[-1], [-K @ states[-1], d]).full()[:, 0])
    extremes = np.degrees(np.abs(states).max(axis=0)[:2])
    np.testing.assert_allclose(extremes, [6.96, 5.20], atol=6e-3)
    assert np.abs(states[:-1] @ K).max() == pytest.approx(9.5, abs=0.05)
    correlation = np.corrcoef(np.array(states)[:, 0], np.array(states)[:, 1])[0, 1]
    assert correlation == pytest.approx(-0.984, abs=1e-3)


def test_sampled_plants_are_the_nonlinear_plant() -> None:
    """For small motions the linear one; for large ones a person's body, to the error of a step."""
    person = seated_balance_for(sample_time=0.02)
    fine = runge_kutta_step(nonlinear_dynamics(seated_parameters_for()), 0.02, substeps=40)
    rng = np.random.default_rng(7)
    x, w = rng.normal(size=10), rng.normal(size=2)
    small = fine(1e-4 * x, 1e-4 * w).full()[:, 0]
    np.testing.assert_allclose(small, 1e-4 * (person.A @ x + person.B @ w), atol=1e-10)
    far = 0.2 * x
    expected = fine(far, w).full()[:, 0]
    np.testing.assert_allclose(person.body()(far, w).full()[:, 0], expected, atol=1e-5)
    step = seated_balance_step_for(sample_time=0.0005)
    for _ in range(40):
        far = step(far, w).full()[:, 0]
    np.testing.assert_allclose(far, expected, atol=1e-12)


@pytest.mark.parametrize("order", [0, 1, 5, 8])
def test_names_and_order_of_the_signals(order: int) -> None:
    body = ["theta1", "theta2", "theta1_rate", "theta2_rate"]
    delays = [f"delay_{k}" for k in range(1, order + 1)]
    for plant, dt in (
        (seated_balance_plant(delay_order=order), 0.01),
        (continuous_seated_balance_plant(delay_order=order), 0.0),
    ):
        assert plant.state_labels == [*body, *delays, "muscle_torque"]
        assert plant.input_labels == ["command", "perturbation"]
        assert plant.output_labels == ["theta1", "theta2"]
        assert plant.dt == dt
        assert not np.any(plant.D)
    # The command reaches the bodies only through the chain.
    continuous = continuous_seated_balance_plant(delay_order=order)
    chain = delayed_muscle(0.08, 0.06, order)
    np.testing.assert_allclose(continuous.A[4:, 4:], chain.A, atol=1e-12)
    np.testing.assert_allclose(continuous.B[4:, 0], chain.B, atol=1e-12)
    assert not np.any(continuous.B[:4, 0])


@pytest.mark.parametrize(
    ("name", "samples", "says", "seat", "trunk"),
    [
        ("theta1", 0, "right edge of the seat goes down", 1, 0),
        ("theta2", 0, "head goes to the right", 0, 1),
        ("theta1_rate", 1, "to the right", 1, None),
        ("theta2_rate", 1, "to the right", None, 1),
        ("perturbation", 5, "turns the right edge of the seat down", 1, None),
        ("command", 25, "trunk to the right and the seat to the left", -1, 1),
        ("muscle_torque", 5, "trunk to the right and the seat to the left", -1, 1),
    ],
)
def test_the_drawn_body_moves_in_the_stated_direction(
    name: str, samples: int, says: str, seat: int | None, trunk: int | None
) -> None:
    """After some samples: 1 is to the right, -1 to the left; None if nothing is said."""
    system, step = seated_balance_plant(), runge_kutta_step(nonlinear_dynamics(), 0.01)
    given = 0.1 * np.array([one == name for one in (*system.state_labels, *system.input_labels)])
    x, u = given[:-2], given[-2:]
    for _ in range(samples):
        x = step(x, u).full().ravel()
    board, _, lower, *_, head = system.drawing(x)
    left, right = board[np.argsort(board[:, 0])]
    assert says in system.directions[name]
    assert seat in (None, np.sign(np.round(left[1] - right[1], 12)))
    assert trunk in (None, np.sign(np.round(np.mean(head[:8, 0]) - lower[1, 0], 12)))
