"""Units as people write them, in SI base units."""

from __future__ import annotations

import functools
import math
import re
from dataclasses import dataclass
from typing import Any

from impc.checking import checked
from impc.errors import InputError, brief

# pint would take Nm for "number metre" and a.u. for "year times atomic mass unit".
_TORQUE = re.compile(r"(?<![A-Za-z])([kmM]?)N[ ·.\-⋅]?([cm]?)m(?![A-Za-z0-9])")
_DEGREES = str.maketrans("º˚", "°°")  # the marks of ordinals and of rings, typed for degrees
_PRESSURE = "kilogram / meter / second ** 2"  # of which a million is usual
_NO_UNIT = ("", "1", "-", "none", "unitless", "dimensionless", "n.d.")
# Words that pint knows and that mean something else in half of the files that have them.
_UNCLEAR = {
    "g": "write g_0 for the acceleration of gravity, gram for a mass",
    "a.u.": 'write unit = "1" for arbitrary units',
    "a.u": 'write unit = "1" for arbitrary units',
    "au": 'write unit = "1" for arbitrary units',
    "nm": "write N*m for a torque, nanometer for a length",
    "px": 'write unit = "1" for pixels',
}
# The same within products and quotients: Grad/s.
_UNCLEAR_WORDS = {
    **dict.fromkeys(("grad", "grads", "grade", "grades"), "write deg for degrees, gon otherwise"),
    "rads": "write rad",
    "pct": "write %",
    "u": "write rpm for revolutions a minute",
}
_WORD = re.compile(r"[^\W\d_]+")
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
    """A unit and what it is in SI base units."""

    written: str  # As the user or the file writes it
    factor: float  # Value in SI base units = factor times value in this unit
    base: str  # Its SI base units as pint prints them; "radian" for an angle, "second" for a time

    @property
    def angle(self) -> bool:
        """Whether it measures an angle."""
        return self.base == "radian"


@checked
@functools.cache
def si_unit(written: str) -> Unit:
    """What a `written` unit is in SI base units: deg -> 0.01745 rad, "N*m" and "Nm" -> 1 N m."""
    text = written.strip().translate(_DEGREES)
    if text.lower() in _NO_UNIT:
        return Unit(written, 1.0, "dimensionless")
    unclear = _unclear(text)
    if unclear:
        raise InputError(f"unit {written!r}", "can be read in two ways", unclear)
    if not _WRITTEN.fullmatch(text) or _HOSTILE.search(text):
        raise _unknown(written)
    text = text.replace("⋅", "*").replace("²", "^2").replace("³", "^3")
    text = _TORQUE.sub(lambda found: f"{found[1]}N*{found[2]}m", text)
    text = re.sub(r"(?<=[A-Za-z0-9°])\.(?=[A-Za-z])", "*", text)
    text = re.sub(r"(?<=[a-z])(-?\d)", r"^\1", text)  # m/s2, rad.s-1
    for spelling in (text, text.lower()):
        found = _base(spelling)
        if found is not None:
            factor, zero, base = found
            if zero != 0:
                raise InputError(
                    f"unit {written!r}", "has an offset", "record in a unit with its zero at zero"
                )
            if factor >= (1e4 if base.startswith("radian") else 1e6) and base != _PRESSURE:
                problem = f"is {factor:g} {base}: a capital M is mega, G giga"
                raise InputError(f"unit {written!r}", problem, "write m for milli")
            return Unit(written, factor, base)
    raise _unknown(written)


def is_unit(text: str) -> bool:
    """Whether the `text` behind a column's name is a unit, or may be one of two."""
    try:
        si_unit(text)
    except InputError:
        return bool(_unclear(text.strip()))
    return bool(text.strip())


def _unclear(text: str) -> str:
    """What to do about a unit that can be read in two ways; empty for the others."""
    whole = "" if text == "Nm" else _UNCLEAR.get(text.lower(), "")
    parts = (_UNCLEAR_WORDS.get(word, "") for word in _WORD.findall(text.lower()))
    return whole or next(filter(None, parts), "")


def _base(text: str) -> tuple[float, float, str] | None:
    """Factor, value of its zero, and base units; None for what pint cannot read."""
    return USUAL[text] if text in USUAL else as_pint_says(text)


def as_pint_says(text: str) -> tuple[float, float, str] | None:
    """Ask pint for factor, value of its zero, and base units of the unit in a `text`."""
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
    remedy = 'write it as in "deg", "rad/s", "N*m", "mV", "1"'
    return InputError(f"unit {brief(written, 40)!r}", "is not known", remedy)
