"""How a signal is shown: its name in words, and angles in degrees or radians.

Every page and figure asks here; a command says once, with `angles_in`, what [report] angles asks
for (docs/units.md).
"""

from __future__ import annotations

import math
import re
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TYPE_CHECKING

from impc.model.plant import UNKNOWN

if TYPE_CHECKING:
    from collections.abc import Iterator

    from impc.model.plant import Plant

_DEGREES = {"rad": "°", "rad/s": "°/s", "rad/s^2": "°/s²"}
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
    return (math.degrees(1.0), "°") if _CHOSEN.get() == "degrees" else (1.0, "rad")


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


def signal_name(plant: Plant, name: str) -> str:
    """What a signal is called for readers: its words, or its name without underscores."""
    return plant.word(name) or name.replace("_", " ")


def words_of(plant: Plant, feature: str) -> str:
    """A feature with its signals in words: "trunk tilt - 0.5 seat tilt"."""
    signals = (*plant.states, *plant.controls)

    def word(found: re.Match[str]) -> str:
        return signal_name(plant, found[0]) if found[0] in signals else found[0]

    return re.sub(r"[^\W\d]\w*(\[\d+\])?", word, feature)


def axis_label(plant: Plant, name: str) -> str:
    """A signal with the unit in which it is shown: "Seat tilt (°)"."""
    words = signal_name(plant, name)
    return f"{words[:1].upper()}{words[1:]} ({shown_unit(plant, name)[1]})"


def body_sentence(plant: Plant) -> str:
    """Which body every simulation of a page moved, that of a `plant` or its matrices."""
    if plant.body is None:
        return "What moves is the linear plant, by which the controller predicts too."
    return (
        "What moves are the plant's own equations, which are not linear; the controller predicts "
        "by their linearisation at rest."
    )
