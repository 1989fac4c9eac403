"""Where a result comes from: plant, settings, versions and date."""

from __future__ import annotations

import importlib.metadata
import platform
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from impc.files.inputs import Inputs
    from impc.files.plant_sources import PlantSource
    from impc.model.plant import Plant

__all__ = ["FitProvenance", "Provenance", "example_provenance", "fit_provenance"]

_PACKAGES = ("impc", "casadi", "clarabel", "control", "cvxpy", "numba", "numpy", "scipy")


@dataclass(frozen=True)
class Provenance:
    """What a reader needs to make the result again.

    Attributes
    ----------
    plant_name : str
        Import path of the plant.
    plant : Plant
    settings : mapping of str to number
        Horizon, steps, input bound (in the input's unit) and weights of the condition number.
    versions : mapping of str to str
        Of Python and of the packages that compute.
    made : str
        Date and time, UTC, ISO 8601.
    """

    plant_name: str
    plant: Plant
    settings: Mapping[str, float]
    versions: Mapping[str, str]
    made: str


@dataclass(frozen=True)
class FitProvenance:
    """What a reader needs to make a fit again.

    Attributes
    ----------
    plant_name : str
        Import path or file.
    plant_arguments : mapping
        What its function was called with.
    files : tuple of str
        Names of the recordings, without their folders.
    command : str
        Command line that made the result.
    versions : mapping of str to str
        Of Python and of the packages that compute.
    made : str
        Date and time, UTC, ISO 8601.
    inputs : Inputs
        Digests of all files that went in.
    """

    plant_name: str
    plant_arguments: Mapping[str, object]
    files: tuple[str, ...]
    command: str
    versions: Mapping[str, str]
    made: str
    inputs: Inputs


def example_provenance(plant_name: str, plant: Plant, settings: Mapping[str, float]) -> Provenance:
    """Gather the provenance of a run of the example, now and with what is installed here.

    `plant_name` is the import path of the plant, `settings` are the numbers of the example.
    """
    return Provenance(plant_name, plant, dict(settings), _versions(), _now())


def fit_provenance(
    source: PlantSource, inputs: Inputs, files: Sequence[Path], command: str
) -> FitProvenance:
    """Gather the provenance of a fit to `files` by a `command`, now and as installed here.

    `inputs` are their digests, and that of the plant of `source`.
    """
    return FitProvenance(
        source.name,
        dict(source.arguments),
        tuple(path.name for path in files),
        command,
        _versions(),
        _now(),
        inputs,
    )


def _versions() -> dict[str, str]:
    return {"python": platform.python_version()} | {name: _version(name) for name in _PACKAGES}


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"  # impc itself, run from a checkout by its path
