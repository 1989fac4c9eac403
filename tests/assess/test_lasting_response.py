"""Steady opposing command against a long simulation."""

from __future__ import annotations

import control
import numpy as np

import impc
from impc.assess.printed_gain import follows_command, gain_estimate, lasting_responses
from impc.inverse.noisy_fit import fit_controller
from plants import seated_balance_for
from tests.support import differences, posed, regulator


def test_states_of_nerves_and_muscles_are_found() -> None:
    plant = impc.Plant(seated_balance_for(mass=70.0, height=1.7), ["command"])
    inner = dict(zip(plant.states, follows_command(plant), strict=True))
    assert [name for name, own in inner.items() if own] == [
        *(f"delay_{k}" for k in range(1, 6)), "muscle_torque"
    ]  # fmt: skip


def test_the_command_settles_at_it() -> None:
    """Tilt held at one while delay and muscle settle."""
    A = [[1.0, 0.1, 0.0], [0.2, 0.9, 0.1], [0.0, 0.0, 0.7]]
    system = control.ss(
        A, [[0, 0], [0, 0.1], [0.4, 0]], [[1, 0, 0]], 0, 0.1,
        states=["tilt", "rate", "muscle"], inputs=["u", "push"], outputs=["angle"],
    )  # fmt: skip
    plant = impc.Plant(system, ["u"])
    law = regulator(plant, np.diag([4.0, 1.0, 0.1]), 9, 8, terminal_set=True)
    rng = np.random.default_rng(1)
    push = 0.5 * np.repeat(rng.standard_normal(80), 5)
    y = law.simulate([0, 0, 0], disturbance=push).outputs[:-1]
    trial = impc.Recording(plant, y + 1e-3 * rng.standard_normal(y.shape), push)
    estimate = gain_estimate(fit_controller(posed(law, trial, unknown_start=True)))
    (found,) = lasting_responses(estimate)
    K, muscle, u = np.array(estimate.K)[0], 0.0, 0.0
    for _ in range(500):
        u = -K[0] - K[2] * muscle
        muscle = 0.7 * muscle + 0.4 * u
    np.testing.assert_allclose(found.value, -u, rtol=1e-9)
    # Interval of the linearised value.
    slopes = differences(
        lambda K: np.array(lasting_responses(impc.replace(estimate, K=K))[0].value), K[None]
    )
    (error,), _ = estimate.covariance.combinations(slopes)
    np.testing.assert_allclose((found.high - found.low) / 2, 1.96 * error, rtol=1e-3)
