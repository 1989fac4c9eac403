"""Equations of motion against conservation of energy and momentum, and against small motions."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from plants.rigid_bodies import GRAVITY, cart_pole, quadrotor, robot_arm, rocket, rotation


def rate_of(energy: ca.SX, state: ca.SX, rates: ca.SX, values: list[float]) -> float:
    """d(energy)/dt along the motion."""
    slope = ca.jtimes(energy, state, rates)
    return float(ca.Function("rate", [state], [slope])(values))


def test_the_force_on_a_cart_does_the_work_that_its_energy_gains() -> None:
    x = ca.SX.sym("x", 4)
    cart, pole, length, force = 0.7, 0.3, 0.9, 2.0
    tip = ca.vertcat(x[0] + length * ca.sin(x[1]), -length * ca.cos(x[1]))
    velocity = ca.jtimes(tip, x[:2], x[2:])
    energy = cart * x[2] ** 2 / 2 + pole * ca.sumsqr(velocity) / 2 + pole * GRAVITY * tip[1]
    state = [0.2, 1.1, -0.6, 0.8]
    rates = cart_pole(x, force, cart, pole, length)
    assert rate_of(energy, x, rates, state) == pytest.approx(force * state[2])


def test_the_torques_on_an_arm_do_the_work_that_its_energy_gains() -> None:
    x = ca.SX.sym("x", 4)
    lengths, masses, torque = (0.8, 1.3), (1.1, 0.6), ca.DM([0.4, -0.7])
    angles = (x[0], x[0] + x[1])
    elbow = lengths[0] * ca.vertcat(ca.cos(angles[0]), ca.sin(angles[0]))
    energy, joint = ca.SX(0), ca.SX.zeros(2)
    for mass, length, angle in zip(masses, lengths, angles, strict=True):
        centre = joint + length / 2 * ca.vertcat(ca.cos(angle), ca.sin(angle))
        velocity = ca.jtimes(centre, x[:2], x[2:])
        turning = ca.jtimes(angle, x[:2], x[2:])
        energy += mass * ca.sumsqr(velocity) / 2 + mass * length**2 / 12 * turning**2 / 2
        joint = elbow
    state = [0.3, -1.2, 0.9, 0.5]
    rates = robot_arm(x, torque, lengths, masses)
    assert rate_of(energy, x, rates, state) == pytest.approx(0.4 * 0.9 - 0.7 * 0.5)


STATE = [0.3, -0.2, 0.5, 1.0, 0.4, -0.8, 0.8, 0.1, -0.5, 0.31622776601683794, 0.6, -0.9, 0.4]


@pytest.mark.parametrize("body", ["quadrotor", "rocket"])
def test_a_body_keeps_what_its_forces_do_not_change(body: str) -> None:
    x = ca.SX.sym("x", 13)
    J, mass = ca.DM([0.5, 1.2, 0.9]), 1.4
    R, w = rotation(x[6:10]), x[10:]
    if body == "quadrotor":
        rates = quadrotor(x, ca.DM.zeros(4), J, mass, 0.4, 0.01)
        height = x[2]
    else:
        rates = rocket(x, ca.DM.zeros(3), J, mass, 1.0)
        height = x[0]
    kept = [
        mass * ca.sumsqr(x[3:6]) / 2 + ca.dot(J, w**2) / 2 + mass * GRAVITY * height,
        ca.sumsqr(x[6:10]),
        *ca.vertsplit(ca.mtimes(R, J * w)),
    ]
    for item in kept:
        assert rate_of(item, x, rates, STATE) == pytest.approx(0, abs=1e-12)


def test_a_rotation_is_one_and_turns_as_the_hand_does() -> None:
    R = rotation(ca.DM(STATE[6:10])).full()
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    half = np.pi / 4
    quarter = rotation(ca.DM([np.cos(half), 0, 0, np.sin(half)])).full()
    np.testing.assert_allclose(quarter @ [1, 0, 0], [0, 1, 0], atol=1e-12)


def test_each_rotor_turns_the_body_its_own_way() -> None:
    """Rotors 1 and 3 on the first axis, 2 and 4 on the second; drag against their turning."""
    level = ca.DM([0] * 6 + [1, 0, 0, 0] + [0] * 3)
    turned = [
        quadrotor(level, ca.DM(np.eye(4)[k]), ca.DM([1, 1, 1]), 2.0, 0.4, 0.01).full().ravel()
        for k in range(4)
    ]
    expected = [[0, -0.2, 0.01], [-0.2, 0, -0.01], [0, 0.2, 0.01], [0.2, 0, -0.01]]
    for found, angular in zip(turned, expected, strict=True):
        np.testing.assert_allclose(found[10:], angular)
        np.testing.assert_allclose(found[3:6], [0, 0, 0.5 - GRAVITY])


def test_a_side_thrust_at_the_tail_turns_the_rocket() -> None:
    level = ca.DM([0] * 6 + [1, 0, 0, 0] + [0] * 3)
    rates = rocket(level, ca.DM([20, 1, 0]), ca.DM([1, 2, 4]), 2.0, 1.0).full().ravel()
    np.testing.assert_allclose(rates[3:6], [0, 0.5, 0], atol=1e-12)
    np.testing.assert_allclose(rates[10:], [0, 0, -0.5 / 4])
