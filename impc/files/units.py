"""Convert units, in the spellings that people use, to SI base units."""

from __future__ import annotations

import functools
import math
import re
from dataclasses import dataclass
from typing import Any

from impc.checking import checked
from impc.errors import InputError, brief

# pint reads Nm as "number metre" and a.u. as "year times atomic mass unit".
_TORQUE = re.compile(r"(?<![A-Za-z])([kmM]?)N[ ·.\-⋅]?([cm]?)m(?![A-Za-z0-9])")
_DEGREES = str.maketrans("º˚", "°°")  # ordinal mark and ring, typed instead of the degree sign
_PRESSURE = "kilogram / meter / second ** 2"  # a million of it is usual (MPa)
_NO_UNIT = ("", "1", "-", "none", "unitless", "dimensionless", "n.d.")
# Units that pint knows, but that often mean something else in recordings.
_UNCLEAR = {
    "g": "write g_0 for the acceleration of gravity, gram for a mass",
    "a.u.": 'write unit = "1" for arbitrary units',
    "a.u": 'write unit = "1" for arbitrary units',
    "au": 'write unit = "1" for arbitrary units',
    "nm": "write N*m for a torque, nanometer for a length",
    "px": 'write unit = "1" for pixels',
}
# The same within products and quotients, such as Grad/s.
_UNCLEAR_WORDS = {
    **dict.fromkeys(("grad", "grads", "grade", "grades"), "write deg for degrees, gon otherwise"),
    "rads": "write rad",
    "pct": "write %",
    "u": "write rpm for revolutions a minute",
}
_WORD = re.compile(r"[^\W\d_]+")
# Letters, products, quotients and one-digit exponents. pint would compute longer numbers, and
# 9**9**9 takes practically for ever.
_WRITTEN = re.compile(r"[A-Za-zµμ°Ω%_·⋅.*/^ ()0-9²³-]{1,40}")
_HOSTILE = re.compile(r"[0-9)²³] *(\*\*|\^)|[0-9²³]{2}")
#: Results of pint for the most frequent units (see `_base`); the first use of pint takes 0.5 s.
USUAL = {
    "s": (1.0, 0.0, "second"),
    "rad": (1.0, 0.0, "radian"),
    "deg": (math.pi / 180, 0.0, "radian"),
    "N*m": (1.0, 0.0, "kilogram * meter ** 2 / second ** 2"),
}


@dataclass(frozen=True)
class Unit:
    """A unit and its conversion to SI base units."""

    written: str  # as the user or the file writes it
    factor: float  # value in SI base units = factor * value in this unit
    base: str  # SI base units as pint prints them; "radian" for an angle, "second" for a time

    @property
    def angle(self) -> bool:
        """Whether it is a unit of angle."""
        return self.base == "radian"


@checked
@functools.cache
def si_unit(written: str) -> Unit:
    """Convert a unit to SI base units: deg -> 0.01745 rad, "N*m" and "Nm" -> 1 N m."""
    text = written.strip().translate(_DEGREES)
    if text.lower() in _NO_UNIT:
        return Unit(written, 1.0, "dimensionless")
    unclear = _unclear(text)
    if unclear:
        raise InputError(f"unit {written!r}", "is ambiguous", unclear)
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
                    f"unit {written!r}", "has an offset", "use a unit that is zero at zero"
                )
            if factor >= (1e4 if base.startswith("radian") else 1e6) and base != _PRESSURE:
                problem = f"is {factor:g} {base}: a capital M is mega, G giga"
                raise InputError(f"unit {written!r}", problem, "write m for milli")
            return Unit(written, factor, base)
    raise _unknown(written)


def is_unit(text: str) -> bool:
    """Whether the `text` behind a column's name is a unit, possibly an ambiguous one."""
    try:
        si_unit(text)
    except InputError:
        return bool(_unclear(text.strip()))
    return bool(text.strip())


def _unclear(text: str) -> str:
    """Remedy for an ambiguous unit; empty for the others."""
    whole = "" if text == "Nm" else _UNCLEAR.get(text.lower(), "")
    parts = (_UNCLEAR_WORDS.get(word, "") for word in _WORD.findall(text.lower()))
    return whole or next(filter(None, parts), "")


def _base(text: str) -> tuple[float, float, str] | None:
    """Factor, offset and base units; None if pint cannot read it."""
    return USUAL[text] if text in USUAL else as_pint_says(text)


def as_pint_says(text: str) -> tuple[float, float, str] | None:
    """Factor, offset and base units according to pint."""
    registry = _registry()
    try:
        unit = registry.parse_units(text)
        zero = registry.Quantity(0.0, unit).to_base_units()
        one = registry.Quantity(1.0, unit).to_base_units()
    except Exception:  # pint raises many kinds, among them AttributeError, TokenError, TypeError
        return None
    return float(one.magnitude - zero.magnitude), float(zero.magnitude), str(one.units)


@functools.cache
def _registry() -> Any:
    import pint  # noqa: PLC0415  # takes a third of a second

    return pint.UnitRegistry()


def _unknown(written: str) -> InputError:
    remedy = 'write it as in "deg", "rad/s", "N*m", "mV", "1"'
    return InputError(f"unit {brief(written, 40)!r}", "is not known", remedy)
