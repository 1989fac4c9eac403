"""In which unit a signal is shown: angles in degrees or radians, all else as the plant has it.

Every page and figure asks here; a command says once, with `angles_in`, what [report] angles asks
for (docs/units.md).

What a plant and its signals are, in words: for the end of every page (docs/units.md).
"""

from __future__ import annotations

import math
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TYPE_CHECKING

from impc.model.plant import UNKNOWN

if TYPE_CHECKING:
    from collections.abc import Iterator

    from impc.model.plant import Plant

_DEGREES = {"rad": "deg", "rad/s": "deg/s", "rad/s^2": "deg/s^2"}
# Of plants that say no units, angles are identified by their names.
_ANGLES = ("theta", "angle", "yaw", "pitch", "roll")
_CHOSEN: ContextVar[str] = ContextVar("angles", default="degrees")


@contextmanager
def angles_in(choice: str) -> Iterator[None]:
    """Inside the block angles are shown in the unit of this `choice`, "degrees" or "radians"."""
    token = _CHOSEN.set(choice)
    try:
        yield
    finally:
        _CHOSEN.reset(token)


def shown_angle() -> tuple[float, str]:
    """Factor from radians, and the unit in which angles are shown."""
    return (math.degrees(1.0), "deg") if _CHOSEN.get() == "degrees" else (1.0, "rad")


def shown_unit(plant: Plant, name: str) -> tuple[float, str]:
    """Factor from the plant's unit of a signal, and the unit that is shown."""
    unit = plant.unit(name)
    if unit == UNKNOWN and name.lower().startswith(_ANGLES):
        unit = "rad/s" if name.endswith("_rate") else "rad"
    return shown_as(unit)


def shown_as(unit: str) -> tuple[float, str]:
    """Factor from a `unit` to the one that is shown, and that one."""
    if unit in _DEGREES and _CHOSEN.get() == "degrees":
        return math.degrees(1.0), _DEGREES[unit]
    return 1.0, "-" if unit == "1" else unit


def axis_label(plant: Plant, name: str) -> str:
    """The `name` of a signal of a `plant` with the unit in which it is shown."""
    return f"{name} ({shown_unit(plant, name)[1]})"


def signal_words(plant: Plant) -> tuple[tuple[str, str], ...]:
    """Each signal of a `plant` that has words, with them and its unit."""
    names = dict.fromkeys((*plant.outputs, *plant.states, *plant.controls, *plant.disturbances))
    return tuple(
        (name, f"{words[0].upper()}{words[1:]}, in {plant.unit(name)}.")
        for name in names
        if (words := plant.word(name))
    )


def body_sentence(plant: Plant) -> str:
    """Which body every simulation of a page moved, that of a `plant` or its matrices."""
    if plant.body is None:
        return "What moves is the linear plant, by which the controller predicts too."
    return (
        "What moves are the plant's own equations, which are not linear; the controller predicts "
        "by their linearisation at rest."
    )
