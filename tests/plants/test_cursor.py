"""The cursor plant against closed forms."""

from __future__ import annotations

import control
import numpy as np
import pytest

import plants


def test_names_and_size() -> None:
    system = plants.cursor_plant()
    assert system.state_labels == [
        "error", "velocity", "delay_1", "delay_2", "delay_3", "delay_4", "acceleration",
    ]  # fmt: skip
    assert system.input_labels == ["command", "target_rate"]
    assert system.dt == pytest.approx(1 / 60)


@pytest.mark.parametrize("system", [plants.cursor_plant(), plants.pursuit_plant()])
def test_the_error_is_positive_in_front_of_the_target(system: control.StateSpace) -> None:
    """A cursor that is driven to the positive side gets in front, a target that goes there away."""
    assert system.directions["error"] == "if the cursor is on the positive side of the target"
    time = system.dt * np.arange(60)
    for row, sign in ((0, 1), (1, -1)):
        pushed = control.forced_response(system, time, np.eye(2)[:, [row]] * np.ones(60))
        assert sign * pushed.outputs[0, -1] > 0
        assert "to the positive side" in system.directions[system.input_labels[row]]


def test_a_step_command_gives_the_position_of_a_delayed_lag() -> None:
    """c(t) of a'' = (1 - exp(-s/lag)), s = t - delay, by the integral; Padé's error is 1e-3."""
    delay, lag, dt = 0.1, 0.08, 0.005
    system = plants.cursor_plant(delay, lag, dt, 8)
    time = np.arange(400) * dt
    response = control.forced_response(
        system, time, np.vstack([np.ones_like(time), np.zeros_like(time)])
    )
    s = np.maximum(time - delay, 0.0)
    exact = s**2 / 2 - lag * s + lag**2 * (1 - np.exp(-s / lag))
    np.testing.assert_allclose(response.outputs[0], exact, atol=2e-3 * exact[-1])


def test_the_pursued_hand_answers_whole_samples_late() -> None:
    """c(t) of lag v' + v = 1 from the sample at which the command arrives, by its closed form."""
    delay, lag, dt = 7, 0.04, 1 / 60
    system = plants.pursuit_plant(delay, lag, dt)
    time = np.arange(60) * dt
    inputs = np.vstack([np.ones_like(time), np.zeros_like(time)])
    response = control.forced_response(system, time, inputs)
    since = np.maximum(time - delay * dt, 0.0)
    exact = since - lag * (1 - np.exp(-since / lag))
    np.testing.assert_allclose(response.outputs[0], exact, atol=1e-14)
    np.testing.assert_array_equal(system.B[:, 1], [-dt, *np.zeros(delay + 1)])
