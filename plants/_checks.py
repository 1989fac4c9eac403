"""Argument checks with one-line messages."""

from __future__ import annotations

import math
from numbers import Integral, Real

import numpy as np

#: An array of float64.
Array = np.ndarray[tuple[int, ...], np.dtype[np.float64]]


def finite_number(
    name: str,
    value: object,
    remedy: str,
    *,
    least: float = -math.inf,
    above: float = -math.inf,
    most: float = math.inf,
) -> float:
    """Return `value` as a float if it is finite, above `above`, and in [least, most].

    Booleans are rejected. The ValueError begins with `name` and ends with `remedy`.
    """
    number = float(value) if isinstance(value, Real) and not isinstance(value, bool) else math.nan
    if math.isfinite(number) and least <= number <= most and number > above:
        return number
    limits = [
        f"{word} {bound:g}"
        for word, bound in (("above", above), ("at least", least), ("at most", most))
        if math.isfinite(bound)
    ]
    wanted = " ".join(["a finite number", " and ".join(limits)]).rstrip()
    raise ValueError(f"{name}: expected {wanted}, got {value!r:.60}; {remedy}")


def whole_number(name: str, value: object, remedy: str, *, least: int, most: int) -> int:
    """Return `value` as an int if it is a whole number in [least, most]; else ValueError."""
    if isinstance(value, Integral) and not isinstance(value, bool) and least <= int(value) <= most:
        return int(value)
    raise ValueError(
        f"{name}: expected a whole number from {least} to {most}, got {value!r:.60}; {remedy}"
    )
