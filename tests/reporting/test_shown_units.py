"""Angles are shown in degrees, everything else in the unit of the plant."""

from __future__ import annotations

import control
import numpy as np
import pytest

from impc.model.plant import Plant
from impc.reporting.shown_units import angles_in, axis_label, shown_angle, shown_unit
from plants import cursor_plant, seated_balance_plant


def test_units_of_the_plants() -> None:
    seat, cursor = Plant(seated_balance_plant()), Plant(cursor_plant())
    for name, unit in (("theta1", "deg"), ("theta2_rate", "deg/s")):
        factor, shown = shown_unit(seat, name)
        assert factor == pytest.approx(180 / np.pi)
        assert shown == unit
    assert axis_label(seat, "command") == "command (N m)"
    assert axis_label(cursor, "target_rate") == "target_rate (px/s)"


def test_radians_where_they_are_asked_for() -> None:
    seat = Plant(seated_balance_plant())
    with angles_in("radians"):
        assert shown_unit(seat, "theta1") == (1.0, "rad")
        assert axis_label(seat, "theta2_rate") == "theta2_rate (rad/s)"
        assert shown_unit(seat, "command") == (1.0, "N m")
        assert shown_angle() == (1.0, "rad")
    assert shown_unit(seat, "theta1")[1] == shown_angle()[1] == "deg"


def test_of_a_plant_that_says_none_angles_are_told_by_their_names() -> None:
    system = control.ss(
        np.eye(2) / 2, np.ones((2, 1)), np.eye(2), 0, 0.1,
        states=["yaw_rate", "level"], inputs=["u"], outputs=["yaw", "share"],
    )  # fmt: skip
    plant = Plant(system, units={"share": "1"})
    assert shown_unit(plant, "yaw_rate")[1] == "deg/s"
    assert axis_label(plant, "level") == "level (SI)"
    assert axis_label(plant, "share") == "share (-)"
