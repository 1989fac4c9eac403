"""Nonlinear equations of motion in CasADi: cart-pole, robot arm, quadrotor, rocket.

The four systems of the benchmark of Jin, Mou and Pappas 2021 (Safe Pontryagin Differentiable
Programming), derived from their mechanics. Each function returns the rate of the state for symbols
or numbers. Attitudes are unit quaternions q = (q0, q1, q2, q3) of the body in the inertial frame.
"""

from __future__ import annotations

from typing import Any

import casadi as ca

GRAVITY = 10.0  # m/s^2, as in the benchmark


def cart_pole(state: Any, force: Any, cart: Any, pole: Any, length: Any) -> Any:
    """Rate of (position, angle, velocity, angular rate) of a cart with a pole that hangs at 0.

    Parameters
    ----------
    state : casadi expression
        m, rad, m/s, rad/s; the angle is 0 when the pole hangs and pi when it stands.
    force : casadi expression
        Force on the cart, N.
    cart, pole : casadi expression or float
        Mass of the cart and point mass at the end of the pole, kg.
    length : casadi expression or float
        Length of the pole, m.
    """
    _, angle, velocity, rate = ca.vertsplit(state)
    sine, cosine = ca.sin(angle), ca.cos(angle)
    # M (acceleration, angular acceleration) = right side, from the Lagrangian.
    mass = ca.vertcat(
        ca.horzcat(cart + pole, pole * length * cosine),
        ca.horzcat(pole * length * cosine, pole * length**2),
    )
    right = ca.vertcat(force + pole * length * rate**2 * sine, -pole * GRAVITY * length * sine)
    return ca.vertcat(velocity, rate, _solved(mass, right))


def robot_arm(state: Any, torque: Any, lengths: tuple[Any, Any], masses: tuple[Any, Any]) -> Any:
    """Rate of (two joint angles, two rates) of two uniform rods in a horizontal plane.

    Parameters
    ----------
    state : casadi expression
        rad, rad/s; the second angle is relative to the first rod.
    torque : casadi expression
        Torques at both joints, N m.
    lengths, masses : pair
        Lengths and masses of the rods, m and kg.
    """
    rate = state[2:]
    (l1, _), (m1, m2) = lengths, masses
    r1, r2 = (length / 2 for length in lengths)
    i1, i2 = (mass * length**2 / 12 for mass, length in zip(masses, lengths, strict=True))
    coupling = m2 * l1 * r2 * ca.cos(state[1])
    second = m2 * r2**2 + i2
    first = m1 * r1**2 + i1 + m2 * l1**2 + second + 2 * coupling
    mass = ca.vertcat(ca.horzcat(first, second + coupling), ca.horzcat(second + coupling, second))
    h = m2 * l1 * r2 * ca.sin(state[1])
    centrifugal = h * ca.vertcat(-(2 * rate[0] + rate[1]) * rate[1], rate[0] ** 2)
    return ca.vertcat(rate, _solved(mass, torque - centrifugal))


def quadrotor(state: Any, thrusts: Any, inertia: Any, mass: Any, span: Any, drag: Any) -> Any:
    """Rate of (position, velocity, attitude, body rates) under four rotors.

    Parameters
    ----------
    state : casadi expression
        (13,): m, m/s, 1, rad/s; gravity is along the third axis.
    thrusts : casadi expression
        Thrusts of the rotors (4,), N.
    inertia : casadi expression
        Principal moments of inertia (3,), kg m^2.
    mass : casadi expression or float
        Mass, kg.
    span : casadi expression or float
        Distance between opposite rotors, m.
    drag : casadi expression or float
        Ratio of the torque about the third axis to the thrust, m.
    """
    moment = ca.vertcat(
        (thrusts[3] - thrusts[1]) * span / 2,
        (thrusts[2] - thrusts[0]) * span / 2,
        (thrusts[0] - thrusts[1] + thrusts[2] - thrusts[3]) * drag,
    )
    force = ca.vertcat(0, 0, ca.sum1(thrusts))
    return _free_body(state, force, moment, inertia, mass, ca.vertcat(0, 0, -GRAVITY))


def rocket(state: Any, force: Any, inertia: Any, mass: Any, length: Any) -> Any:
    """Rate of (position, velocity, attitude, body rates) under a thrust at the tail.

    Parameters
    ----------
    state : casadi expression
        (13,): m, m/s, 1, rad/s; gravity is along the first axis, which is the rocket's.
    force : casadi expression
        Thrust in the body frame (3,), N.
    inertia : casadi expression
        Principal moments of inertia (3,), kg m^2.
    mass, length : casadi expression or float
        Mass in kg, length in m.
    """
    moment = ca.cross(ca.vertcat(-length / 2, 0, 0), force)
    return _free_body(state, force, moment, inertia, mass, ca.vertcat(-GRAVITY, 0, 0))


def rotation(q: Any) -> Any:
    """Rotation matrix (3, 3) from body to inertial coordinates for a unit quaternion q."""
    axis = q[1:]
    cross = ca.skew(axis)
    return ca.DM.eye(3) + 2 * q[0] * cross + 2 * ca.mtimes(cross, cross)


def _free_body(state: Any, force: Any, moment: Any, inertia: Any, mass: Any, gravity: Any) -> Any:
    """Newton-Euler equations: force and moment in the body frame, gravity in the inertial."""
    velocity, q, rates = state[3:6], state[6:10], state[10:13]
    acceleration = ca.mtimes(rotation(q), force) / mass + gravity
    turning = ca.vertcat(-ca.dot(q[1:], rates), q[0] * rates + ca.cross(q[1:], rates)) / 2
    angular = (moment - ca.cross(rates, inertia * rates)) / inertia
    return ca.vertcat(velocity, acceleration, turning, angular)


def _solved(mass: Any, right: Any) -> Any:
    """Solve for two accelerations by Cramer's rule, which gives short expressions."""
    a, b, d = mass[0, 0], mass[0, 1], mass[1, 1]
    determinant = a * d - b * b
    return ca.vertcat(
        (d * right[0] - b * right[1]) / determinant, (a * right[1] - b * right[0]) / determinant
    )
