"""Units as people write them, in SI base units."""

from __future__ import annotations

import functools
import math
import re
from dataclasses import dataclass
from typing import Any

from impc.checking import checked
from impc.errors import InputError, brief

__all__ = ["USUAL", "Unit", "as_pint_says", "is_unit", "si_unit"]

# pint would take Nm for "number metre" and a.u. for "year times atomic mass unit".
_TORQUE = re.compile(r"(?<![A-Za-z])([kmM]?)N[ ·.\-⋅]?([cm]?)m(?![A-Za-z0-9])")
_NO_UNIT = ("", "1", "-", "none", "unitless", "dimensionless", "n.d.")
_UNCLEAR = {
    "g": "write g_0 for the acceleration of gravity, gram for a mass",
    "a.u.": 'write unit = "1" for arbitrary units',
    "au": 'write unit = "1" for arbitrary units',
}
# Letters, products, quotients and one-digit exponents. Longer numbers would be computed by pint,
# and 9**9**9 takes as long as it likes.
_WRITTEN = re.compile(r"[A-Za-zµμ°Ω%_·⋅.*/^ ()0-9²³-]{1,40}")
_HOSTILE = re.compile(r"[0-9)²³] *(\*\*|\^)|[0-9²³]{2}")
#: What pint says of the units that most recordings have (`_base`). To ask it takes half a second.
USUAL = {
    "s": (1.0, 0.0, "second"),
    "rad": (1.0, 0.0, "radian"),
    "deg": (math.pi / 180, 0.0, "radian"),
    "N*m": (1.0, 0.0, "kilogram * meter ** 2 / second ** 2"),
}


@dataclass(frozen=True)
class Unit:
    """A unit and what it is in SI base units.

    Attributes
    ----------
    written : str
        As the user or the file writes it.
    factor : float
        Value in SI base units = factor times value in this unit.
    base : str
        Its SI base units as pint prints them; "radian" for an angle, "second" for a time.
    """

    written: str
    factor: float
    base: str

    @property
    def angle(self) -> bool:
        """Whether it measures an angle."""
        return self.base == "radian"


@checked
@functools.cache
def si_unit(written: str) -> Unit:
    """What a `written` unit is in SI base units: deg -> 0.01745 rad, "N*m" and "Nm" -> 1 N m.

    Raises
    ------
    InputError
        When pint does not know it, when it has an offset (degC), or when its name is ambiguous.
    """
    text = written.strip()
    if text.lower() in _NO_UNIT:
        return Unit(written, 1.0, "dimensionless")
    if text.lower() in _UNCLEAR:
        raise InputError(f"unit {written!r}", "can be read in two ways", _UNCLEAR[text.lower()])
    if not _WRITTEN.fullmatch(text) or _HOSTILE.search(text):
        raise _unknown(written)
    text = text.replace("⋅", "*").replace("²", "^2").replace("³", "^3")
    text = _TORQUE.sub(lambda found: f"{found[1]}N*{found[2]}m", text)
    text = re.sub(r"(?<=[A-Za-z0-9])\.(?=[A-Za-z])", "*", text)
    for spelling in (text, re.sub(r"(?<=[a-z])(\d)", r"^\1", text), text.lower()):
        found = _base(spelling)
        if found is not None:
            factor, zero, base = found
            if zero != 0:
                raise InputError(
                    f"unit {written!r}", "has an offset", "record in a unit with its zero at zero"
                )
            return Unit(written, factor, base)
    raise _unknown(written)


def is_unit(text: str) -> bool:
    """Whether the `text` behind a column's name is a unit."""
    try:
        si_unit(text)
    except InputError:
        return text.strip().lower() in _UNCLEAR
    return bool(text.strip())


def _base(text: str) -> tuple[float, float, str] | None:
    """Factor, value of its zero, and base units; None for what pint cannot read."""
    return USUAL[text] if text in USUAL else as_pint_says(text)


def as_pint_says(text: str) -> tuple[float, float, str] | None:
    """Ask pint for factor, value of its zero, and base units of the unit in a `text`.

    Returns
    -------
    tuple or None
        None for what it cannot read.
    """
    registry = _registry()
    try:
        unit = registry.parse_units(text)
        zero = registry.Quantity(0.0, unit).to_base_units()
        one = registry.Quantity(1.0, unit).to_base_units()
    except Exception:  # pint raises a dozen kinds, AttributeError, TokenError and TypeError among
        return None
    return float(one.magnitude - zero.magnitude), float(zero.magnitude), str(one.units)


@functools.cache
def _registry() -> Any:
    import pint  # noqa: PLC0415  # a third of a second, for who needs units only

    return pint.UnitRegistry()


def _unknown(written: str) -> InputError:
    return InputError(
        f"unit {brief(written, 40)!r}",
        "is not known",
        'write it as in "deg", "rad/s", "N*m", "mV", "1"',
    )
