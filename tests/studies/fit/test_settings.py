"""The [fit] table: settings, error messages, and bounds from the data."""

from __future__ import annotations

import json
import re
from contextlib import nullcontext
from typing import Any

import numpy as np
import pytest

import impc
import plants
from impc.studies.fit.asked import fit_bounds
from impc.studies.fit.settings import fit_settings, plain_settings, require_used


@pytest.fixture(scope="module")
def seat() -> impc.Plant:
    return impc.Plant(plants.seated_balance_plant(), ["command"])


def test_defaults_and_values() -> None:
    assert fit_settings({}) == impc.FitSettings()
    given = fit_settings({"horizon": 30, "u_max": 6, "free": ["J1"], "methods": ["clipped_lqr"]})
    assert (given.horizon, given.u_max, given.free) == (30, 6.0, ["J1"])
    assert given.methods == ["clipped_lqr"]


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
        ({"horizon": 2**63}, "horizon: got 9223372036854775808"),
        ({"horizon": 16**5000}, "horizon: got an integer of about 6021 digits"),
        ({"horizons": [10, 2**63]}, "horizons"),
        ({"horizons": [0]}, "horizons"),
        ({"bootstrap": "block"}, "bootstrap: is not a setting"),
        ({"horizons": [10, 10]}, "horizons: contains 10 twice"),
        ({"margin": 1e308}, "margin"),
        ({"margin": float("nan")}, "margin"),
        ({"settle": 1e308}, "settle"),
        ({"replicates": 2**63}, "replicates"),
        ({"replicates": 19}, "at least 20"),
        ({"replicates": -1}, "at least 0"),
        ({"seed": -1}, "seed"),
        ({"seed": 16**5000}, "seed"),
        ({"u_max": 1e308}, "u_max"),
        ({"u_max": 10**400}, "u_max"),
        ({"u_max": [1.0, -1.0]}, "u_max: got -1.0"),
        ({"u_max": 5e-324}, "u_max"),
        ({"bounded_states": {"x": 1e308}}, "bounded_states x"),
        ({"free": ["mass", "mass"]}, "free: contains mass twice"),
        ({"methods": ["inverse_mpc_direct"]}, "method: got 'inverse_mpc_direct'; choose one of"),
        ({"methods": ["inverse_kkt"]}, "method: inverse_kkt is not part of impc; remove it"),
        ({"observer": {"senses": ["x"]}}, r"\[fit.observer\] senses: is not a setting"),
        ({"structure": {"Q": 3}}, r"^\[fit.structure\] Q: Expected"),
        ({"structures": [{"features": ["x"]}]}, r"^\[fit.structures\[0\]\] features: is not a set"),
    ],
)
def test_what_is_wrong_is_named(table: dict[str, Any], says: str) -> None:
    with pytest.raises(impc.ImpcError, match=says) as caught:
        fit_settings(table)
    assert "\n" not in str(caught.value)


def test_settings_with_a_structure_are_written_as_plain_values() -> None:
    found = plain_settings(fit_settings({"u_max": [2], "structure": {"Q": ["x"]}, "observer": {}}))
    assert json.loads(json.dumps(found)) == found
    assert found["structure"] == {"Q": ["x"], "R": "diagonal", "over": None, "name": None}
    assert found["observer"]["motor"] is True


def test_bounds_from_the_data(seat: impc.Plant) -> None:
    """A sinusoid of 0.1 rad at 1 Hz."""
    angle = 0.1 * np.sin(2 * np.pi * np.arange(3000) / 100)
    trial = impc.Recording(seat, np.column_stack([angle, -angle / 2]), np.zeros(3000))
    bounded: dict[str, float | str] = {"theta1": "data", "theta2": 0.2}
    settings = impc.FitSettings(u_max=5.0, margin=1.5, bounded_states=bounded)
    bounds = fit_bounds(seat, settings, [trial])
    np.testing.assert_allclose(bounds.x_max[0], 0.15, rtol=1e-3)
    assert bounds.x_max[1] == 0.2
    assert np.all(np.isinf(bounds.x_max[2:]))
    np.testing.assert_array_equal(bounds.x_min, -bounds.x_max)
    assert (bounds.u_min[0], bounds.u_max[0]) == (-5.0, 5.0)
    assert np.isinf(fit_bounds(seat, impc.FitSettings(), [trial]).u_max[0])


@pytest.mark.parametrize(
    ("states", "says"),
    [
        ({"theta3": 1.0}, "is not a state"),
        ({"theta1": "twice"}, "twice"),
        ({"theta1_rate": "data"}, "is not an output; give a number"),
        ({"theta1": -1.0}, "x_min, x_max"),
    ],
)
def test_bounds_that_cannot_be_set(seat: impc.Plant, states: dict[str, Any], says: str) -> None:
    trial = impc.Recording(seat, np.ones((100, 2)), np.zeros(100))
    with pytest.raises(impc.ImpcError, match=says):
        fit_bounds(seat, impc.FitSettings(bounded_states=states), [trial])


def test_as_many_limits_as_inputs(seat: impc.Plant) -> None:
    trial = impc.Recording(seat, np.ones((300, 2)), np.zeros(300))
    for given in ([], [1.0, 2.0]):
        with pytest.raises(impc.ImpcError, match=r"^\[fit\] u_max: has . numbers"):
            fit_bounds(seat, impc.FitSettings(u_max=given), [trial])
    assert fit_bounds(seat, impc.FitSettings(u_max=[2.0]), [trial]).u_max[0] == 2.0


@pytest.mark.parametrize(
    ("table", "used", "says"),
    [
        ({"profiles": ["K.u.x"]}, (), "[fit] profiles: is not used by impc compare"),
        ({"unknown_limit": True}, (), "[fit] unknown_limit: is not used by impc compare"),
        ({"replicates": 40}, ("replicates",), ""),
        ({"horizon": 10, "settle": 2.0}, (), ""),
    ],
)
def test_what_a_command_does_not_use_is_refused_by_name(
    table: dict[str, object], used: tuple[str, ...], says: str
) -> None:
    """`impc compare` and `impc cohort` reject settings that they do not use."""
    refused = pytest.raises(impc.InputError, match=re.escape(says)) if says else nullcontext()
    with refused:
        require_used(fit_settings(table), used, "compare")
