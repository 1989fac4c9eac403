"""Units of gains and weights, against pint; units of plants and in reports."""

from __future__ import annotations

from typing import Any

import control
import numpy as np
import pint
import pytest

from impc.errors import PlantError
from impc.model.plant import Plant, gain_unit, weight_unit
from impc.reporting.shown_units import angles_in, axis_label, shown_angle, shown_unit
from plants import cursor_plant, seated_balance_plant, yalmip_example
from tests.support import named_plant

UNITS = {"angle": "rad", "rate": "rad/s", "torque": "N m", "share": "1"}


def plant(units: dict[str, str]) -> Plant:
    A, B, C = np.diag([0.5, 0.4, 0.3]), np.ones((3, 1)), np.eye(1, 3)
    return named_plant(A, B, C, 0.1, "angle rate share", "torque", "angle", units=units)


def same(one: str, other: str) -> bool:
    registry: Any = pint.UnitRegistry()
    written = one.replace("N m", "(N*m)").replace("²", "**2").replace(") (", ")*(")
    return bool(registry(written or "1") == registry(other))


def test_units_are_those_of_the_algebra() -> None:
    found = plant(UNITS)
    assert gain_unit(found, "torque", "angle") == "N m/rad"
    assert gain_unit(found, "torque", "rate") == "N m/(rad/s)"
    assert gain_unit(found, "torque", "share") == "N m"
    assert weight_unit(found, "angle", "angle") == "(N m)²/rad²"
    assert weight_unit(found, "torque", "torque") == "1"
    assert weight_unit(found, "rate", "rate") == "(N m)²/(rad/s)²"
    assert same(gain_unit(found, "torque", "rate"), "N*m*s/rad")
    assert same(weight_unit(found, "rate", "rate"), "(N*m)**2*s**2/rad**2")
    assert same(weight_unit(found, "angle", "angle"), "(N*m)**2/rad**2")


def test_what_is_not_known_is_si() -> None:
    found = plant({"angle": "rad"})
    assert found.unit("rate") == "SI"
    assert gain_unit(found, "torque", "angle") == weight_unit(found, "rate", "angle") == "SI"


@pytest.mark.parametrize(
    "wrong", [{"angel": "rad"}, {"angle": 3}, {"angle": "ra\nd"}, {3: "rad"}, "rad", ["rad"]]
)
def test_units_of_no_signal(wrong: object) -> None:
    system = control.ss([[0.5]], [[1]], [[1]], 0, 0.1, states=["angle"], outputs=["angle"])
    system.units = wrong
    with pytest.raises(PlantError, match=r"plant\.units"):
        Plant(system)


def test_plants_of_the_package_say_all_units() -> None:
    for made in (seated_balance_plant(), cursor_plant(), yalmip_example()):
        found = Plant(made)
        for name in (*found.states, *found.controls, *found.disturbances, *found.outputs):
            assert found.unit(name) != "SI", name
    seat = Plant(seated_balance_plant(), ["command"])
    assert gain_unit(seat, "command", "theta1") == "N m/rad"
    assert Plant(seat).units == seat.units


def test_units_of_the_plants() -> None:
    seat, cursor = Plant(seated_balance_plant()), Plant(cursor_plant())
    for name, unit in (("theta1", "°"), ("theta2_rate", "°/s")):
        factor, shown = shown_unit(seat, name)
        assert factor == pytest.approx(180 / np.pi)
        assert shown == unit
    assert axis_label(seat, "command") == "Commanded torque (N m)"
    assert axis_label(cursor, "target_rate") == "Target velocity (px/s)"


def test_radians_where_they_are_asked_for() -> None:
    seat = Plant(seated_balance_plant())
    with angles_in("radians"):
        assert shown_unit(seat, "theta1") == (1.0, "rad")
        assert axis_label(seat, "theta2_rate") == "Trunk velocity (rad/s)"
        assert shown_unit(seat, "command") == (1.0, "N m")
        assert shown_angle() == (1.0, "rad")
    assert shown_unit(seat, "theta1")[1] == shown_angle()[1] == "°"


def test_of_a_plant_that_says_none_angles_are_told_by_their_names() -> None:
    A, B, names = np.eye(2) / 2, np.ones((2, 1)), ("yaw_rate level", "u", "yaw share")
    plant = named_plant(A, B, np.eye(2), 0.1, *names, units={"share": "1"})
    assert shown_unit(plant, "yaw_rate")[1] == "°/s"
    assert axis_label(plant, "level") == "Level (SI)"
    assert axis_label(plant, "share") == "Share (-)"
