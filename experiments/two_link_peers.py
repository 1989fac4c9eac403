"""Simulation of the two-link body, and peers that identify its eight feedback gains.

Direct collocation is the formulation of opty (Moore and van den Bogert): the states of all samples
and the gains are unknowns, the midpoint rule between samples is a constraint, and the objective is
the sum of squared differences to the measured states. IPOPT solves it with exact derivatives.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import casadi as ca
import control
import numpy as np
import scipy.linalg
import scipy.optimize

import impc
from impc.arrays import Array
from impc.model.continuous_gain import continuous_gain

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = [
    "DURATION",
    "GAIN",
    "Fits",
    "collocation",
    "fits_of",
    "gravity_stiffness",
    "least_factor",
]
__all__ += ["shooting", "standing", "standing_problem", "standing_recording"]

#: Ankle and hip torque (N m) per ankle and hip angle (rad) and rate (rad/s).
GAIN = np.array([[950.0, 175.0, 185.0, 50.0], [45.0, 290.0, 60.0, 26.0]])

_LEG, _LEG_CENTRE, _TRUNK_CENTRE = 0.878, 0.572, 0.314  # m
_LEG_MASS, _TRUNK_MASS, _LEG_INERTIA, _TRUNK_INERTIA = 32.126, 48.831, 1.799, 2.481  # kg, kg m^2
_GRAVITY = 9.81
#: Duration of a recording, s.
DURATION = 20.0
_STEPS = 4
# Cycles in 240 s of the sum of sines that the platform follows, and their amplitude, m.
_CYCLES = np.array([7, 11, 16, 25, 38, 61, 103, 131, 151, 181, 313, 523.0])
_AMPLITUDE = 0.02
# Residual of a simulation that diverges.
_DIVERGED = 1e3


def accelerations(x: Any, torques: Any, platform: Any) -> tuple[Any, Any]:
    """Accelerations of both joints, rad/s^2; numbers or CasADi expressions."""
    ankle, hip, ankle_rate, hip_rate = x
    coupled = _TRUNK_MASS * _LEG * _TRUNK_CENTRE
    own = _TRUNK_INERTIA + _TRUNK_MASS * _TRUNK_CENTRE**2
    shared = own + coupled * ca.cos(hip)
    legs = _LEG_INERTIA + _LEG_MASS * _LEG_CENTRE**2 + _TRUNK_MASS * _LEG**2
    whole = legs + own + 2 * coupled * ca.cos(hip)
    leg = _LEG_MASS * _LEG_CENTRE + _TRUNK_MASS * _LEG
    trunk = _TRUNK_MASS * _TRUNK_CENTRE
    on_trunk = trunk * (_GRAVITY * ca.sin(ankle + hip) + platform * ca.cos(ankle + hip))
    on_leg = leg * (_GRAVITY * ca.sin(ankle) + platform * ca.cos(ankle))
    turning = coupled * ca.sin(hip)
    at_ankle = torques[0] + on_leg + on_trunk + turning * hip_rate * (2 * ankle_rate + hip_rate)
    at_hip = torques[1] + on_trunk - turning * ankle_rate**2
    determinant = whole * own - shared**2
    return (
        (own * at_ankle - shared * at_hip) / determinant,
        (whole * at_hip - shared * at_ankle) / determinant,
    )


def linear_body() -> tuple[Array, Array]:
    """A (4, 4) and B (4, 3) of the body about upright; inputs: two torques and the platform."""
    rest, step = np.zeros(4), 1e-6
    A, B = np.zeros((4, 4)), np.zeros((4, 3))
    A[:2, 2:] = np.eye(2)
    for column, along in enumerate(step * np.eye(2, 4)):
        A[2:, column] = np.array(accelerations(rest + along, np.zeros(2), 0.0)) / step
    for column, along in enumerate(step * np.eye(2)):
        B[2:, column] = np.array(accelerations(rest, along, 0.0)) / step
    B[2:, 2] = np.array(accelerations(rest, np.zeros(2), step)) / step
    return A, B


def gravity_stiffness() -> float:
    """Gravity torque at the ankle per ankle angle with a straight hip, N m/rad."""
    whole = _LEG_MASS * _LEG_CENTRE + _TRUNK_MASS * (_LEG + _TRUNK_CENTRE)
    return _GRAVITY * whole


def least_factor() -> float:
    """Least common factor of GAIN, to 0.001, from which on the linear loop is stable."""
    A, B = linear_body()
    factors = np.arange(1, 0, -0.001)
    unstable = [np.linalg.eigvals(A - c * B[:, :2] @ GAIN).real.max() >= 0 for c in factors]
    return float(factors[int(np.argmax(unstable))])


def standing(sample_time: float) -> control.StateSpace:
    """Body linearised about upright and sampled with held inputs; all states are outputs."""
    joints = ["ankle", "hip", "ankle_rate", "hip_rate"]
    inputs = ["ankle_torque", "hip_torque", "platform"]
    body = control.ss(*linear_body(), np.eye(4), 0, states=joints, inputs=inputs, outputs=joints)
    return control.c2d(body, sample_time)


def standing_recording(
    seed: int, *, noisy: bool, samples: int = 4000
) -> tuple[float, Array, Array]:
    """Sample time (s), states (samples, 4) and platform accelerations (samples,), m/s^2.

    All are measured with noise of 0.25 degrees (m/s^2). With `noisy`, the feedback also senses the
    states with noise of 1 degree (degree/s).
    """
    rng = np.random.default_rng([2004, seed])
    times, step = np.linspace(0, DURATION, samples, retstep=True)
    turns = 2 * np.pi * _CYCLES / 240
    phases = rng.uniform(0, 2 * np.pi, len(turns))
    platform = -(_AMPLITUDE * turns**2 * np.sin(np.outer(times, turns) + phases)).sum(axis=1)
    sensed = np.radians(1.0 if noisy else 0.0) * rng.standard_normal((samples, 4))

    def slope(x: Array, sample: int, share: float) -> Array:
        now = platform[sample] + share * (platform[sample + 1] - platform[sample])
        error = sensed[sample] + share * (sensed[sample + 1] - sensed[sample])
        torques = GAIN @ (error - x)
        return np.array([x[2], x[3], *accelerations(x, torques, now)])

    x = np.zeros((samples, 4))
    h, share = step / _STEPS, 1 / _STEPS
    for sample in range(samples - 1):
        z = x[sample]
        for part in np.arange(_STEPS) / _STEPS:
            a = slope(z, sample, part)
            b = slope(z + h / 2 * a, sample, part + share / 2)
            c = slope(z + h / 2 * b, sample, part + share / 2)
            d = slope(z + h * c, sample, part + share)
            z = z + h / 6 * (a + 2 * b + 2 * c + d)
        x[sample + 1] = z
    noise = np.radians(0.25)
    measured = x + noise * rng.standard_normal(x.shape)
    return step, measured, platform + noise * rng.standard_normal(samples)


def _closed_loop(linear: bool) -> ca.Function:
    """Slope of the states (4,) with gains (8,) as shares of GAIN, and the platform."""
    x, shares, platform = ca.MX.sym("x", 4), ca.MX.sym("shares", 8), ca.MX.sym("platform")
    torques = -ca.mtimes(ca.reshape(shares * ca.DM(GAIN.ravel()), 4, 2).T, x)
    if linear:
        A, B = linear_body()
        slope = ca.mtimes(ca.DM(A), x) + ca.mtimes(ca.DM(B), ca.vertcat(torques, platform))
    else:
        both = accelerations(ca.vertsplit(x), ca.vertsplit(torques), platform)
        slope = ca.vertcat(x[2], x[3], *both)
    return ca.Function("closed_loop", [x, shares, platform], [slope]).expand()


def collocation(
    recording: tuple[float, Array, Array], start: Array, *, midpoint: bool = True
) -> Array:
    """Gain (2, 4) by direct collocation of the nonlinear body from measured states and `start`."""
    step, measured, platform = recording
    count = len(measured)
    X, shares = ca.MX.sym("X", 4, count), ca.MX.sym("shares", 8)
    before, after = X[:, :-1], X[:, 1:]
    at = (before + after) / 2 if midpoint else after  # otherwise backward Euler
    pushed = (platform[:-1] + platform[1:]) / 2 if midpoint else platform[1:]
    every = ca.repmat(shares, 1, count - 1)
    rates = _closed_loop(False).map(count - 1)(at, every, ca.DM(pushed).T)
    problem: dict[str, Any] = {
        "x": ca.vertcat(ca.vec(X), shares),
        "f": ca.sumsqr(X - ca.DM(measured).T),
        "g": ca.vec(after - before - step * rates),
    }
    quiet: dict[str, Any] = {
        "ipopt.print_level": 0,
        "print_time": False,
        "ipopt.sb": "yes",
        "ipopt.max_iter": 200,
    }
    solver = ca.nlpsol("collocation", "ipopt", problem, quiet | {"error_on_fail": True})
    begin = np.concatenate([measured.ravel(), (start / GAIN).ravel()])
    found = solver(x0=begin, lbg=0, ubg=0)["x"].full().ravel()
    return np.asarray(found[-8:].reshape(2, 4) * GAIN)


def shooting(recording: tuple[float, Array, Array], start: Array, *, linear: bool = False) -> Array:
    """Gain (2, 4) by least squares over simulations, with finite differences, from `start`."""
    step, measured, platform = recording
    slope, count = _closed_loop(linear), len(measured)
    x, shares, ends = ca.MX.sym("x", 4), ca.MX.sym("shares", 8), ca.MX.sym("ends", 2)
    between = (ends[0] + ends[1]) / 2
    a = slope(x, shares, ends[0])
    b = slope(x + step / 2 * a, shares, between)
    c = slope(x + step / 2 * b, shares, between)
    d = slope(x + step * c, shares, ends[1])
    moved = x + step / 6 * (a + 2 * b + 2 * c + d)
    one = ca.Function("one", [x, shares, ends], [moved]).expand()
    whole, pushed = one.mapaccum(count - 1), np.vstack([platform[:-1], platform[1:]])

    def residual(unknowns: Array) -> Array:
        every = np.tile(unknowns[:8, None], count - 1)
        path = np.vstack([unknowns[8:], whole(unknowns[8:], every, pushed).full().T])
        left = np.nan_to_num(path - measured, nan=_DIVERGED)
        return np.clip(left, -_DIVERGED, _DIVERGED).ravel()

    begin = np.concatenate([(start / GAIN).ravel(), measured[0]])
    found = scipy.optimize.least_squares(residual, begin, x_scale="jac", max_nfev=100)
    return np.asarray(found.x[:8].reshape(2, 4) * GAIN)


def one_step(A: Array, B: Array, recording: tuple[float, Array, Array]) -> Array:
    """Held gain (2, 4) by regression of each measured state on the one before (B: 3 inputs)."""
    _, measured, platform = recording
    held = (platform[:-1] + platform[1:]) / 2
    left = measured[1:] - measured[:-1] @ A.T - np.outer(held, B[:, 2])
    torques = np.linalg.lstsq(B[:, :2], left.T)[0].T
    return np.asarray(-np.linalg.lstsq(measured[:-1], torques)[0].T)


def standing_problem(seed: int, *, noisy: bool, samples: int = 4000) -> impc.Problem:
    """Inverse problem as `impc fit` poses it, from one simulated recording."""
    return posed_problem(standing_recording(seed, noisy=noisy, samples=samples))


def posed_problem(recording: tuple[float, Array, Array]) -> impc.Problem:
    """Inverse problem of a recording, with the mean acceleration of each sample."""
    step, states, platform = recording
    plant = impc.Plant(standing(step), ["ankle_torque", "hip_torque"])
    held = np.append((platform[:-1] + platform[1:]) / 2, platform[-1])
    settings = impc.FitSettings(horizon=5)
    return impc.fit_problem(plant, [impc.Recording(plant, states, held)], settings)


@dataclass(frozen=True)
class Fits:
    """Gains and run times (s) by method of one recording, and what impc says of them."""

    gains: dict[str, Array]
    seconds: dict[str, float]
    free: impc.Estimate
    optimal: impc.Estimate
    doubts: list[str]

    def error(self, method: str) -> Array:
        """Relative errors of the eight gains, %."""
        return np.asarray(100 * (self.gains[method] / GAIN - 1).ravel())


def fits_of(seed: int, noisy: bool) -> Fits:
    """Fits of one recording by all methods; gains in continuous time."""
    recording = standing_recording(seed, noisy=noisy)
    problem = posed_problem(recording)
    plant = problem.plant
    A, B = linear_body()
    P = scipy.linalg.solve_continuous_are(A, B[:, :2], np.eye(4), np.eye(2))
    start = np.asarray(B[:, :2].T @ P)
    seconds, gains = {}, {}
    estimates: list[impc.Estimate] = []

    def from_impc(method: str, scale: Array) -> Array:
        scaled = impc.Problem(
            plant,
            problem.bounds,
            problem.horizon,
            problem.recordings,
            output_scale=scale,
            unknown_start=problem.unknown_start,
        )
        estimates.append(impc.fit(scaled, method))
        return continuous_gain(plant, np.asarray(estimates[-1].gain))[0]

    body = standing(recording[0])
    runs: dict[str, Callable[[], Array]] = {
        "feedback_gain": lambda: from_impc("feedback_gain", problem.output_scale),
        "equal": lambda: from_impc("feedback_gain", np.ones(4)),
        "inverse_mpc": lambda: from_impc("inverse_mpc", problem.output_scale),
        "collocation": lambda: collocation(recording, np.zeros((2, 4))),
        "shooting": lambda: shooting(recording, start),
        "linear": lambda: shooting(recording, start, linear=True),
        "one step": lambda: continuous_gain(plant, one_step(body.A, body.B, recording))[0],
    }
    for name, run in runs.items():
        began = time.perf_counter()
        gains[name] = run()
        seconds[name] = time.perf_counter() - began
    doubts = [doubt for estimate in estimates for doubt in estimate.doubts]
    return Fits(gains, seconds, estimates[0], estimates[2], doubts)
