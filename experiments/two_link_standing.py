"""Simulate and fit a two-link body on a moving platform (Park, Horak and Kuo 2004).

Parameters, gain and platform are those of the example of Moore and van den Bogert's direct
collocation. The simulated body is nonlinear with continuous feedback; the fitted plant is linear
and sampled.

    python -m experiments.two_link_standing
"""

from __future__ import annotations

import control
import numpy as np

import impc
from impc.arrays import Array

__all__ = ["GAIN", "standing", "standing_problem", "standing_recording"]

#: Ankle and hip torque (N m) per ankle and hip angle (rad) and rate (rad/s).
GAIN = np.array([[950.0, 175.0, 185.0, 50.0], [45.0, 290.0, 60.0, 26.0]])

_LEG, _LEG_CENTRE, _TRUNK_CENTRE = 0.878, 0.572, 0.314  # m
_LEG_MASS, _TRUNK_MASS, _LEG_INERTIA, _TRUNK_INERTIA = 32.126, 48.831, 1.799, 2.481  # kg, kg m^2
_GRAVITY, _DURATION = 9.81, 20.0
_STEPS = 4
# Cycles in 240 s of the sum of sines that the platform follows, and their amplitude, m.
_CYCLES = np.array([7, 11, 16, 25, 38, 61, 103, 131, 151, 181, 313, 523.0])
_AMPLITUDE = 0.02


def _accelerations(x: Array, torques: Array, platform: float) -> Array:
    """Accelerations of both joints (2,), rad/s^2, from angles and rates (4,)."""
    ankle, hip, ankle_rate, hip_rate = x
    coupled = _TRUNK_MASS * _LEG * _TRUNK_CENTRE
    own = _TRUNK_INERTIA + _TRUNK_MASS * _TRUNK_CENTRE**2
    shared = own + coupled * np.cos(hip)
    whole = (
        _LEG_INERTIA
        + own
        + _LEG_MASS * _LEG_CENTRE**2
        + _TRUNK_MASS * _LEG**2
        + 2 * coupled * np.cos(hip)
    )
    leg = _LEG_MASS * _LEG_CENTRE + _TRUNK_MASS * _LEG
    trunk = _TRUNK_MASS * _TRUNK_CENTRE
    tilt = np.array([ankle, ankle + hip])
    on_trunk = trunk * (_GRAVITY * np.sin(tilt[1]) + platform * np.cos(tilt[1]))
    on_leg = leg * (_GRAVITY * np.sin(tilt[0]) + platform * np.cos(tilt[0]))
    turning = coupled * np.sin(hip)
    forces = torques + np.array(
        [
            on_leg + on_trunk + turning * (2 * ankle_rate * hip_rate + hip_rate**2),
            on_trunk - turning * ankle_rate**2,
        ]
    )
    return np.linalg.solve([[whole, shared], [shared, own]], forces)


def standing(sample_time: float) -> control.StateSpace:
    """Body linearised about upright and sampled with held inputs; all states are outputs."""
    rest, step = np.zeros(4), 1e-6
    A, B = np.zeros((4, 4)), np.zeros((4, 3))
    A[:2, 2:] = np.eye(2)
    for column, along in enumerate(step * np.eye(2, 4)):
        A[2:, column] = _accelerations(rest + along, np.zeros(2), 0) / step
    for column, along in enumerate(step * np.eye(2)):
        B[2:, column] = _accelerations(rest, along, 0) / step
    B[2:, 2] = _accelerations(rest, np.zeros(2), step) / step
    joints = ["ankle", "hip", "ankle_rate", "hip_rate"]
    continuous = control.ss(
        A,
        B,
        np.eye(4),
        0,
        states=joints,
        inputs=["ankle_torque", "hip_torque", "platform"],
        outputs=joints,
    )
    return control.c2d(continuous, sample_time)


def standing_recording(
    seed: int, *, noisy: bool, samples: int = 4000
) -> tuple[float, Array, Array]:
    """Sample time (s), states (samples, 4) and platform accelerations (samples,), m/s^2.

    All are measured with noise of 0.25 degrees (m/s^2). With `noisy`, the feedback also senses the
    states with noise of 1 degree (degree/s).
    """
    rng = np.random.default_rng([2004, seed])
    times, step = np.linspace(0, _DURATION, samples, retstep=True)
    turns = 2 * np.pi * _CYCLES / 240
    phases = rng.uniform(0, 2 * np.pi, len(turns))
    platform = -(_AMPLITUDE * turns**2 * np.sin(np.outer(times, turns) + phases)).sum(axis=1)
    sensed = np.radians(1.0 if noisy else 0.0) * rng.standard_normal((samples, 4))

    def slope(x: Array, sample: int, share: float) -> Array:
        now = platform[sample] + share * (platform[sample + 1] - platform[sample])
        error = sensed[sample] + share * (sensed[sample + 1] - sensed[sample])
        return np.append(x[2:], _accelerations(x, GAIN @ (error - x), now))

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


def standing_problem(seed: int, *, noisy: bool, samples: int = 4000) -> impc.Problem:
    """Inverse problem as `impc fit` poses it, with the mean acceleration of each sample."""
    step, states, platform = standing_recording(seed, noisy=noisy, samples=samples)
    plant = impc.Plant(standing(step), ["ankle_torque", "hip_torque"])
    held = np.append((platform[:-1] + platform[1:]) / 2, platform[-1])
    settings = impc.FitSettings(horizon=5)
    return impc.fit_problem(plant, [impc.Recording(plant, states, held)], settings)


def main() -> None:
    """Print the fits of `inverse_mpc` and `feedback_gain`, without and with sensory noise."""
    for noisy in (False, True):
        problem = standing_problem(1, noisy=noisy)
        print("noisy" if noisy else "clean")
        for method in ("inverse_mpc", "feedback_gain"):
            print(impc.fit(problem, method))


if __name__ == "__main__":
    main()
