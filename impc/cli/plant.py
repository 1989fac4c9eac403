"""A plant by name: the one place where the library meets plants."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from impc.files.plant_sources import PlantSource
    from impc.model.plant import Plant
    from impc.studies.cohort.study import Study

#: Short names of plants, by their import paths: the library itself knows no plant.
KNOWN = {"seated-balance": "plants:seated_balance_for", "cursor": "plants:cursor_plant"}


def find_plant(name: str, arguments: Mapping[str, Any]) -> PlantSource:
    """The plant of a short name, an import path ``module:function`` or a file.

    `arguments` are those of its function.
    """
    from impc.errors import InputError  # noqa: PLC0415
    from impc.files.plant_sources import plant_source  # noqa: PLC0415

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
    """Make the plant of an import path ``module:function`` without arguments."""
    from impc.files.plant_sources import make_plant, plant_source  # noqa: PLC0415

    return make_plant(plant_source(path, {}), ())


def named_plant(study_file: Path, study: Study, given: str | None, allowed: bool) -> PlantSource:
    """The plant of a study, when the command line consents to it."""
    from impc.files.user_code import consented_name  # noqa: PLC0415

    where = f"{study_file}: study.plant"
    name = consented_name(where, study.plant, given, allowed, "plant", tuple(KNOWN))
    return find_plant(name, study.configuration.plant)
