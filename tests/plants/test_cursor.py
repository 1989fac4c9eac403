"""The cursor plant against closed forms, and the named example against the reference."""

from __future__ import annotations

import control
import numpy as np
import pytest
import scipy.linalg

import plants


@pytest.mark.parametrize("system", [plants.cursor_plant(), plants.pursuit_plant()])
def test_the_error_is_positive_in_front_of_the_target(system: control.StateSpace) -> None:
    """A cursor that is driven to the positive side gets in front, a target that goes there away."""
    assert system.state_labels[:2] == ["error", "velocity"]
    assert system.input_labels == ["command", "target_rate"]
    assert system.dt == 1 / 60
    assert system.directions["error"] == "if the cursor is on the positive side of the target"
    time = system.dt * np.arange(60)
    for row, sign in ((0, 1), (1, -1)):
        pushed = control.forced_response(system, time, np.eye(2)[:, [row]] * np.ones(60))
        assert sign * pushed.outputs[0, -1] > 0
        assert "to the positive side" in system.directions[system.input_labels[row]]


def answer(system: control.StateSpace, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Time in s and place of the cursor after a step of the command."""
    time = np.arange(samples) * system.dt
    pushed = control.forced_response(system, time, np.eye(2)[:, :1] * np.ones(samples))
    return time, pushed.outputs[0]


def test_a_step_command_gives_the_position_of_a_delayed_lag() -> None:
    """c(t) of a'' = (1 - exp(-s/lag)), s = t - delay, by the integral; Padé's error is 1e-3."""
    lag, system = 0.08, plants.cursor_plant(0.1, 0.08, 0.005, 8)
    time, found = answer(system, 400)
    s = np.maximum(time - 0.1, 0.0)
    exact = s**2 / 2 - lag * s + lag**2 * (1 - np.exp(-s / lag))
    np.testing.assert_allclose(found, exact, atol=2e-3 * exact[-1])


def test_the_pursued_hand_answers_whole_samples_late() -> None:
    """c(t) of lag v' + v = 1 from the sample at which the command arrives, by its closed form."""
    lag, dt, system = 0.04, 1 / 60, plants.pursuit_plant(7, 0.04, 1 / 60)
    time, found = answer(system, 60)
    since = np.maximum(time - 7 * dt, 0.0)
    np.testing.assert_allclose(found, since - lag * (1 - np.exp(-since / lag)), atol=1e-14)
    np.testing.assert_array_equal(system.B[:, 1], [-dt, *np.zeros(8)])


def test_poles_gain_and_riccati_solution_are_those_of_the_reference() -> None:
    plant = plants.yalmip_example()
    np.testing.assert_allclose(
        sorted(np.linalg.eigvals(plant.A), key=np.imag), [1.1 - 0.43589j, 1.1 + 0.43589j], atol=1e-5
    )
    P = scipy.linalg.solve_discrete_are(plant.A, plant.B, np.eye(2), np.eye(1))
    K = np.linalg.solve(1 + plant.B.T @ P @ plant.B, plant.B.T @ P @ plant.A)
    np.testing.assert_allclose(K, [[1.49383, -0.88111]], atol=5e-6)
    np.testing.assert_allclose(P, [[5.36016, -1.21933], [-1.21933, 1.98969]], atol=5e-6)
