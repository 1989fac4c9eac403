"""In which unit a signal is shown: angles in degrees or radians, all else as the plant has it.

Every page and figure asks here (docs/fitting.md).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from impc.model.signal_units import UNKNOWN

if TYPE_CHECKING:
    from impc.model.plant import Plant

__all__ = ["axis_label", "shown_as", "shown_unit"]

_DEGREES = {"rad": "deg", "rad/s": "deg/s", "rad/s^2": "deg/s^2"}
# Of plants that say no units, angles are told by their names.
_ANGLES = ("theta", "angle", "yaw", "pitch", "roll")


def shown_unit(plant: Plant, name: str, angles: str = "degrees") -> tuple[float, str]:
    """Factor from the plant's unit of a signal, and the unit that is shown.

    Parameters
    ----------
    plant : Plant
    name : str
        Of the signal.
    angles : str
        "degrees" or "radians", as [report] says.
    """
    unit = plant.unit(name)
    if unit == UNKNOWN and name.lower().startswith(_ANGLES):
        unit = "rad/s" if name.endswith("_rate") else "rad"
    return shown_as(unit, angles)


def shown_as(unit: str, angles: str = "degrees") -> tuple[float, str]:
    """Factor from a `unit` to the one that is shown, and that one.

    Parameters
    ----------
    unit : str
        SI.
    angles : str
        "degrees" or "radians".
    """
    if unit in _DEGREES and angles == "degrees":
        return math.degrees(1.0), _DEGREES[unit]
    return 1.0, "-" if unit == "1" else unit


def axis_label(plant: Plant, name: str, angles: str = "degrees") -> str:
    """The name of a signal with the unit in which it is shown.

    Parameters
    ----------
    plant : Plant
    name : str
        Of the signal.
    angles : str
        "degrees" or "radians".
    """
    return f"{name} ({shown_unit(plant, name, angles)[1]})"
