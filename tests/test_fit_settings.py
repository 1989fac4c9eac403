"""The [fit] table: what it sets, what it refuses, and bounds from the data."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import plants
from impc.errors import ImpcError
from impc.fit_settings import FitSettings, fit_bounds, fit_settings
from impc.plant import Plant, as_plant
from impc.recording import recording


@pytest.fixture(scope="module")
def seat() -> Plant:
    return as_plant(plants.seated_balance_plant(), ["command"])


def test_defaults_and_values() -> None:
    assert fit_settings({}) == FitSettings()
    given = fit_settings({"horizon": 30, "u_max": 6, "free": ["J1"], "settle": 2})
    assert (given.horizon, given.u_max, given.free, given.settle) == (30, 6.0, ["J1"], 2.0)


@pytest.mark.parametrize(
    ("table", "says"),
    [
        ({"horizn": 3}, "horizn"),
        ({"horizon": 0}, "horizon"),
        ({"horizon": 2.5}, "horizon"),
        ({"margin": 0.5}, "margin"),
        ({"settle": -1}, "settle"),
        ({"u_max": "six"}, "u_max"),
        ({"free": "J1"}, "free"),
        ({"terminal_set": 1}, "terminal_set"),
    ],
)
def test_what_is_wrong_is_named(table: dict[str, Any], says: str) -> None:
    with pytest.raises(ImpcError, match=says) as caught:
        fit_settings(table)
    assert "\n" not in str(caught.value)


def test_bounds_from_the_data(seat: Plant) -> None:
    """A sinusoid of 0.1 rad at 1 Hz: its largest rate is 0.2 pi rad/s."""
    time = np.arange(3000) / 100
    angle = 0.1 * np.sin(2 * np.pi * time)
    trial = recording(seat, np.column_stack([angle, -angle / 2]), np.zeros(3000))
    settings = FitSettings(
        u_max=5.0,
        margin=1.5,
        bounded_states={"theta1": "data", "theta1_rate": "data", "theta2": 0.2},
    )
    bounds = fit_bounds(seat, settings, [trial])
    np.testing.assert_allclose(bounds.x_max[0], 0.15, rtol=1e-3)
    np.testing.assert_allclose(bounds.x_max[2], 1.5 * 0.2 * np.pi, rtol=0.03)
    assert bounds.x_max[1] == 0.2
    assert np.all(np.isinf(bounds.x_max[3:]))
    np.testing.assert_array_equal(bounds.x_min, -bounds.x_max)
    assert (bounds.u_min[0], bounds.u_max[0]) == (-5.0, 5.0)
    assert np.isinf(fit_bounds(seat, FitSettings(), [trial]).u_max[0])


@pytest.mark.parametrize(
    ("states", "says"),
    [
        ({"theta3": 1.0}, "is not a state"),
        ({"theta1": "twice"}, "twice"),
        ({"muscle_torque": "data"}, "neither an output nor the rate of one"),
        ({"theta1": -1.0}, "x_min, x_max"),
    ],
)
def test_bounds_that_cannot_be_set(seat: Plant, states: dict[str, Any], says: str) -> None:
    trial = recording(seat, np.ones((100, 2)), np.zeros(100))
    with pytest.raises(ImpcError, match=says):
        fit_bounds(seat, FitSettings(bounded_states=states), [trial])
