"""Names and units of signals on pages and figures; angles in degrees or radians.

Commands set the unit of angles once with `angles_in`, from [report] angles.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

from impc.model.plant import UNKNOWN, Plant
from impc.model.signal_errors import KINDS
from impc.reporting.rendering import sentence_case

_DEGREES = {"rad": "°", "rad/s": "°/s", "rad/s^2": "°/s²"}
# If the plant states no unit, angles are recognised by these prefixes of their names.
_ANGLES = ("theta", "angle", "yaw", "pitch", "roll")
_CHOSEN: ContextVar[str] = ContextVar("angles", default="degrees")


@contextmanager
def angles_in(choice: str) -> Iterator[None]:
    """Show angles in the unit `choice`, "degrees" or "radians", inside the block."""
    token = _CHOSEN.set(choice)
    try:
        yield
    finally:
        _CHOSEN.reset(token)


def shown_angle() -> tuple[float, str]:
    """Factor from radians to the shown unit of angles, and that unit."""
    return (math.degrees(1.0), "°") if _CHOSEN.get() == "degrees" else (1.0, "rad")


def shown_unit(plant: Plant, name: str) -> tuple[float, str]:
    """Factor from the plant's unit of a signal to the shown unit, and that unit."""
    unit = plant.unit(name)
    if unit == UNKNOWN and name.lower().startswith(_ANGLES):
        unit = "rad/s" if name.endswith("_rate") else "rad"
    return shown_as(unit)


def error_unit(plant: Plant, kind: str, name: str) -> tuple[float, str]:
    """Factor from an error of a signal (`Problem.fitted_errors`) to what is shown, and its unit."""
    _, unit, size, _ = KINDS[kind]
    if unit.strip() == unit != "":
        return size, unit
    factor, own = shown_unit(plant, name)
    return factor * size, f"{own}{unit.strip()}"


def shown_as(unit: str) -> tuple[float, str]:
    """Factor from `unit` to the shown unit, and that unit."""
    if unit in _DEGREES and _CHOSEN.get() == "degrees":
        return math.degrees(1.0), _DEGREES[unit]
    return 1.0, "-" if unit == "1" else unit


def signal_name(plant: Plant, name: str) -> str:
    """Name of a signal on pages: the plant's words for it, or its name without underscores."""
    return plant.word(name) or name.replace("_", " ")


def words_of(plant: Plant, feature: str) -> str:
    """A feature with its signals in words, for example "trunk tilt - 0.5 seat tilt"."""
    signals = (*plant.states, *plant.controls)

    def word(found: re.Match[str]) -> str:
        return signal_name(plant, found[0]) if found[0] in signals else found[0]

    return re.sub(r"[^\W\d]\w*(\[\d+\])?", word, feature)


def axis_label(plant: Plant, name: str) -> str:
    """Label of a signal with its shown unit, for example "Seat tilt (°)"."""
    return f"{sentence_case(signal_name(plant, name))} ({shown_unit(plant, name)[1]})"


def body_sentence(plant: Plant) -> str:
    """State which equations of motion the simulations of a page use."""
    if plant.body is None:
        return "All simulations use the linear plant, with which the controller predicts too."
    return (
        "All simulations use the plant's nonlinear equations of motion; the controller predicts "
        "with their linearisation at rest."
    )
