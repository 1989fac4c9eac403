"""Units of gains and weights, from those of the signals: text for tables and axes.

A gain takes a state to an input, u = -K x. A weight prices a product of two states (or inputs)
against R[0, 0] = 1, which is the square of the first input (docs/theory.md, section 1).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from impc.model.plant import Plant

#: What is written where a plant does not say in which unit a signal is.
UNKNOWN = "SI"


def gain_unit(plant: Plant, control: str, state: str) -> str:
    """Unit of the gain from a `state` to a `control`, both by name: "N m/rad"."""
    return _ratio(plant.unit(control), plant.unit(state))


def price_unit(plant: Plant, one: str, other: str) -> str:
    """Unit of the weight on the product of two signals, `one` and `other`: "(N m)²/rad²"."""
    first = _power(plant.unit(plant.controls[0]))
    pair = plant.unit(one), plant.unit(other)
    if UNKNOWN in pair:
        return UNKNOWN
    bottom = _power(pair[0]) if pair[0] == pair[1] else " ".join(map(_grouped, sorted(pair)))
    return "1" if bottom == first else _ratio(first, bottom)


def _ratio(top: str, bottom: str) -> str:
    if UNKNOWN in (top, bottom):
        return UNKNOWN
    return top if bottom == "1" else f"{top}/{_factor(bottom)}"


def _factor(unit: str) -> str:
    """In brackets where a division before it would be read in two ways."""
    return unit if unit.endswith("²") and unit.count("²") == 1 else _grouped(unit)


def _power(unit: str) -> str:
    if unit in ("1", UNKNOWN):
        return unit
    return f"{_grouped(unit)}²"


def _grouped(unit: str) -> str:
    return f"({unit})" if set(unit) & set(" /") else unit
