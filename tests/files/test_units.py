"""Units as people write them, against their definitions."""

from __future__ import annotations

import numpy as np
import pytest

from impc.errors import InputError
from impc.files.units import USUAL, as_pint_says, is_unit, si_unit


@pytest.mark.parametrize(
    ("written", "factor", "base"),
    [
        ("deg", np.pi / 180, "radian"),
        ("°", np.pi / 180, "radian"),
        ("degrees", np.pi / 180, "radian"),
        ("mrad", 1e-3, "radian"),
        ("°/s", np.pi / 180, "radian / second"),
        ("deg/s2", np.pi / 180, "radian / second ** 2"),
        ("Nm", 1.0, "kilogram * meter ** 2 / second ** 2"),
        ("N*m", 1.0, "kilogram * meter ** 2 / second ** 2"),
        ("N m", 1.0, "kilogram * meter ** 2 / second ** 2"),
        ("N·m", 1.0, "kilogram * meter ** 2 / second ** 2"),
        ("N.m", 1.0, "kilogram * meter ** 2 / second ** 2"),
        ("mNm", 1e-3, "kilogram * meter ** 2 / second ** 2"),
        ("N mm", 1e-3, "kilogram * meter ** 2 / second ** 2"),
        ("Nm/rad", 1.0, "kilogram * meter ** 2 / radian / second ** 2"),
        ("mm", 1e-3, "meter"),
        ("ms", 1e-3, "second"),
        ("µs", 1e-6, "second"),
        ("m/s²", 1.0, "meter / second ** 2"),
        ("g_0", 9.80665, "meter / second ** 2"),
        ("lbf*ft", 4.4482216152605 * 0.3048, "kilogram * meter ** 2 / second ** 2"),
        ("1", 1.0, "dimensionless"),
        ("", 1.0, "dimensionless"),
        ("%", 0.01, "dimensionless"),
        ("º/s", np.pi / 180, "radian / second"),
        ("˚", np.pi / 180, "radian"),
        ("rad.s-1", 1.0, "radian / second"),
        ("MPa", 1e6, "kilogram / meter / second ** 2"),
        ("gon", np.pi / 200, "radian"),
    ],
)
def test_si_base_units(written: str, factor: float, base: str) -> None:
    unit = si_unit(written)
    assert unit.factor == pytest.approx(factor, rel=1e-12)
    assert unit.base == base
    assert unit.angle == (base == "radian")


@pytest.mark.parametrize(
    ("written", "phrase"),
    [
        ("wibble", "is not known"),
        ("degC", "has an offset"),
        ("g", "can be read in two ways"),
        ("a.u.", "can be read in two ways"),
        ("Grad", "write deg for degrees"),
        ("grad", "write deg for degrees"),
        ("GRAD/s", "write deg for degrees"),
        ("grad/s^2", "write deg for degrees"),
        ("Grade", "write deg for degrees"),
        ("rads", "write rad"),
        ("U/min", "write rpm"),
        ("NM", r"write N\*m for a torque"),
        ("px", "can be read in two ways"),
        ("Mm", "a capital M is mega"),
        ("Mrad", "a capital M is mega"),
        ("Ms", "a capital M is mega"),
        ("MV", "a capital M is mega"),
        ("Sekunden", "is not known; write it as in"),
        ("9**9**9", "is not known"),
        ("m**999999999", "is not known"),
        ("(2)**9", "is not known"),
        ("m" * 41, "is not known"),
        ("__import__('os')", "is not known"),
    ],
)
def test_units_that_cannot_be_used(written: str, phrase: str) -> None:
    with pytest.raises(InputError, match=phrase):
        si_unit(written)


def test_what_in_brackets_is_a_unit() -> None:
    assert all(is_unit(text) for text in ("deg", "N*m", "g", "ms", "Grad", "grad/s"))
    assert not any(is_unit(text) for text in ("", "left", "channel 3", "raw"))


@pytest.mark.parametrize("written", USUAL)
def test_the_usual_units_are_as_pint_has_them(written: str) -> None:
    assert as_pint_says(written) == USUAL[written]
