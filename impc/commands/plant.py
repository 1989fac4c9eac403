"""A plant by name: the one place where the library meets plants."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Mapping

    from impc.plant import Plant
    from impc.plant_source import PlantSource

__all__ = ["KNOWN", "find_plant", "load_plant"]

#: Short names of plants, by their import paths: the library itself knows no plant.
KNOWN = {
    "seated-balance": "plants:seated_balance_for",
    "cursor": "plants:cursor_plant",
}


def find_plant(name: str, arguments: Mapping[str, Any]) -> PlantSource:
    """The plant of a short name, an import path ``module:function`` or a file.

    `arguments` are those of its function.

    Raises
    ------
    InputError
        As `plant_source`; when an argument is a date or an integer beyond 64 bits.
    """
    from impc.errors import InputError  # noqa: PLC0415
    from impc.plant_source import plant_source  # noqa: PLC0415

    for key, value in arguments.items():
        if not _kept(value):
            kind = type(value).__name__
            raise InputError(f"[plant] {key}", f"is a {kind} that no result can keep", "see docs")
    return plant_source(KNOWN.get(name, name), arguments)


def _kept(value: object) -> bool:
    """Whether result.json can hold it: no date, no integer beyond 64 bits, at no depth."""
    if isinstance(value, dict):
        return all(map(_kept, value.values()))
    if isinstance(value, list):
        return all(map(_kept, value))
    if isinstance(value, int):
        return value.bit_length() < 64
    return isinstance(value, (float, str))


def load_plant(path: str) -> Plant:
    """Make the plant of an import path ``module:function`` without arguments.

    Raises
    ------
    InputError
        When there is no such module or function.
    """
    from impc.plant_source import make_plant, plant_source  # noqa: PLC0415

    return make_plant(plant_source(path, {}), ())
