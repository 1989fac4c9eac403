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


def test_a_force_and_torques_do_the_work_that_the_energy_gains() -> None:
    x = ca.SX.sym("x", 4)
    cart, pole, length, force = 0.7, 0.3, 0.9, 2.0
    tip = ca.vertcat(x[0] + length * ca.sin(x[1]), -length * ca.cos(x[1]))
    velocity = ca.jtimes(tip, x[:2], x[2:])
    energy = cart * x[2] ** 2 / 2 + pole * ca.sumsqr(velocity) / 2 + pole * GRAVITY * tip[1]
    rates = cart_pole(x, force, cart, pole, length)
    assert rate_of(energy, x, rates, [0.2, 1.1, -0.6, 0.8]) == pytest.approx(force * -0.6)
    lengths, masses, torque = (0.8, 1.3), (1.1, 0.6), ca.DM([0.4, -0.7])
    energy, joint = ca.SX(0), ca.SX.zeros(2)
    for mass, length, angle in zip(masses, lengths, (x[0], x[0] + x[1]), strict=True):
        along = ca.vertcat(ca.cos(angle), ca.sin(angle))
        velocity = ca.jtimes(joint + length / 2 * along, x[:2], x[2:])
        turning = ca.jtimes(angle, x[:2], x[2:])
        energy += mass * ca.sumsqr(velocity) / 2 + mass * length**2 / 12 * turning**2 / 2
        joint = length * along
    rates = robot_arm(x, torque, lengths, masses)
    work = 0.4 * 0.9 - 0.7 * 0.5
    assert rate_of(energy, x, rates, [0.3, -1.2, 0.9, 0.5]) == pytest.approx(work)


STATE = [0.3, -0.2, 0.5, 1.0, 0.4, -0.8, 0.8, 0.1, -0.5, 0.31622776601683794, 0.6, -0.9, 0.4]
J, MASS = ca.DM([0.5, 1.2, 0.9]), 1.4
LEVEL = ca.DM([0] * 6 + [1, 0, 0, 0] + [0] * 3)


@pytest.mark.parametrize("body", ["quadrotor", "rocket"])
def test_a_body_keeps_what_its_forces_do_not_change(body: str) -> None:
    x = ca.SX.sym("x", 13)
    rates, height = rocket(x, ca.DM.zeros(3), J, MASS, 1.0), x[0]
    if body == "quadrotor":
        rates, height = quadrotor(x, ca.DM.zeros(4), J, MASS, 0.4, 0.01), x[2]
    kept = [
        MASS * ca.sumsqr(x[3:6]) / 2 + ca.dot(J, x[10:] ** 2) / 2 + MASS * GRAVITY * height,
        ca.sumsqr(x[6:10]),
        *ca.vertsplit(ca.mtimes(rotation(x[6:10]), J * x[10:])),
    ]
    for item in kept:
        assert rate_of(item, x, rates, STATE) == pytest.approx(0, abs=1e-12)


def test_a_rotation_is_one_and_turns_as_the_hand_does() -> None:
    R = rotation(ca.DM(STATE[6:10])).full()
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    quarter = rotation(ca.DM([np.cos(np.pi / 4), 0, 0, np.sin(np.pi / 4)])).full()
    np.testing.assert_allclose(quarter @ [1, 0, 0], [0, 1, 0], atol=1e-12)


def test_rotors_and_a_side_thrust_turn_the_body_their_own_way() -> None:
    """Rotors 1 and 3 on the first axis, 2 and 4 on the second; drag against their turning."""
    expected = [[0, -0.2, 0.01], [-0.2, 0, -0.01], [0, 0.2, 0.01], [0.2, 0, -0.01]]
    for thrusts, angular in zip(np.eye(4), expected, strict=True):
        found = quadrotor(LEVEL, ca.DM(thrusts), ca.DM([1, 1, 1]), 2.0, 0.4, 0.01).full().ravel()
        np.testing.assert_allclose(found[10:], angular)
        np.testing.assert_allclose(found[3:6], [0, 0, 0.5 - GRAVITY])
    rates = rocket(LEVEL, ca.DM([20, 1, 0]), ca.DM([1, 2, 4]), 2.0, 1.0).full().ravel()
    np.testing.assert_allclose(rates[3:6], [0, 0.5, 0], atol=1e-12)
    np.testing.assert_allclose(rates[10:], [0, 0, -0.5 / 4])
