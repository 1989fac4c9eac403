"""Which files a result was made of: the digests that stand in result.json."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

from impc.files.digests import content_digest, digest, source_digest, versions

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path


@dataclass(frozen=True)
class Inputs:
    """SHA-256 of what went into a result."""

    # Of each file, in the order given; of a study, by the name of the unit
    recordings: tuple[str, ...] | Mapping[str, tuple[str, ...]]
    configuration: str  # Of the configuration or the study file
    code: str  # Of the plant's or model's code or file, and its arguments
    versions: str  # Of Python, of the packages that compute, and of this package's source
    kind: str = "plant"  # What the code is: "plant" or "model"

    @property
    def digest(self) -> str:
        """All of them as one."""
        return digest(self)

    def plain(self) -> Mapping[str, Any]:
        """As result.json has them."""
        return {
            "recordings": self.recordings,
            "configuration": self.configuration,
            self.kind: self.code,
            "versions": self.versions,
            "all": self.digest,
        }


def gather_inputs(
    files: Sequence[Path], configuration: Path, name: str, arguments: Mapping[str, Any]
) -> Inputs:
    """Digests of the recordings `files`, of the `configuration` and of a plant as they are now.

    The plant is a file or an import path, the `name`, imported already, with its `arguments`.
    """
    recordings = tuple(content_digest(path) for path in files)
    return Inputs(
        recordings, content_digest(configuration), _code(name, arguments), digest(versions())
    )


class Recorded(Protocol):
    """What is read here of a unit of a study."""

    @property
    def name(self) -> str:
        """Of the unit."""

    @property
    def files(self) -> Sequence[Path]:
        """Its recordings."""


def study_inputs(
    units: Sequence[Recorded], study: Path, kind: str, name: str, arguments: Mapping[str, Any]
) -> Inputs:
    """Digests of the recordings of `units`, of the `study` file and of its plant or model.

    `kind` is "plant" or "model"; `name` and `arguments` are as in `gather_inputs`.
    """
    recordings = {unit.name: tuple(content_digest(path) for path in unit.files) for unit in units}
    return Inputs(
        recordings, content_digest(study), _code(name, arguments), digest(versions()), kind
    )


def _code(name: str, arguments: Mapping[str, Any]) -> str:
    return digest(source_digest(name, arguments), dict(arguments))
