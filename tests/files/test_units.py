"""Units in common spellings, against their definitions."""

from __future__ import annotations

import numpy as np
import pytest

from impc.errors import InputError
from impc.files.units import USUAL, as_pint_says, is_unit, si_unit

TORQUE = "kilogram * meter ** 2 / second ** 2"
SAME = [
    (np.pi / 180, "radian", ["deg", "°", "degrees", "˚"]),
    (np.pi / 200, "radian", ["gon"]),
    (1e-3, "radian", ["mrad"]),
    (np.pi / 180, "radian / second", ["°/s", "º/s"]),
    (1.0, "radian / second", ["rad.s-1"]),
    (np.pi / 180, "radian / second ** 2", ["deg/s2"]),
    (1.0, TORQUE, ["Nm", "N*m", "N m", "N·m", "N.m"]),
    (1e-3, TORQUE, ["mNm", "N mm"]),
    (4.4482216152605 * 0.3048, TORQUE, ["lbf*ft"]),
    (1.0, "kilogram * meter ** 2 / radian / second ** 2", ["Nm/rad"]),
    (1e-3, "meter", ["mm"]),
    (1e-3, "second", ["ms"]),
    (1e-6, "second", ["µs"]),
    (1.0, "meter / second ** 2", ["m/s²"]),
    (9.80665, "meter / second ** 2", ["g_0"]),
    (1e6, "kilogram / meter / second ** 2", ["MPa"]),
    (1.0, "dimensionless", ["1", ""]),
    (0.01, "dimensionless", ["%"]),
]
REFUSED = [
    ("is not known; write it as in", ["wibble", "Sekunden", "m**999999999", "(2)**9", "m" * 41,
                                      "9**9**9", "__import__('os')"]),
    ("has an offset", ["degC"]),
    ("is ambiguous", ["g", "a.u.", "px"]),
    ("write deg for degrees", ["Grad", "grad", "GRAD/s", "grad/s^2", "Grade"]),
    ("write rad", ["rads"]),
    ("write rpm", ["U/min"]),
    (r"write N\*m for a torque", ["NM"]),
    ("a capital M is mega", ["Mm", "Mrad", "Ms", "MV"]),
]  # fmt: skip


@pytest.mark.parametrize(
    ("written", "factor", "base"), [(one, *given) for *given, texts in SAME for one in texts]
)
def test_si_base_units(written: str, factor: float, base: str) -> None:
    unit = si_unit(written)
    assert unit.factor == pytest.approx(factor, rel=1e-12)
    assert unit.base == base
    assert unit.angle == (base == "radian")


@pytest.mark.parametrize(
    ("written", "phrase"), [(one, phrase) for phrase, texts in REFUSED for one in texts]
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
