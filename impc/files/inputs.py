"""Which files a result was made of: the digests that stand in result.json."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from impc.files.digests import content_digest, digest, source_digest, versions

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from impc.files.plant_sources import PlantSource

__all__ = ["Inputs", "gather_inputs"]


@dataclass(frozen=True)
class Inputs:
    """SHA-256 of what went into a result.

    Attributes
    ----------
    recordings : tuple of str
        Of each file, in the order given.
    configuration : str
        Of the configuration file.
    plant : str
        Of the plant's code or file, and its arguments.
    versions : str
        Of Python, of the packages that compute, and of this package's source.
    """

    recordings: tuple[str, ...]
    configuration: str
    plant: str
    versions: str

    @property
    def digest(self) -> str:
        """All of them as one."""
        return digest(self)

    def plain(self) -> Mapping[str, Any]:
        """As result.json has them."""
        return {
            "recordings": list(self.recordings),
            "configuration": self.configuration,
            "plant": self.plant,
            "versions": self.versions,
            "all": self.digest,
        }


def gather_inputs(files: Sequence[Path], configuration: Path, source: PlantSource) -> Inputs:
    """Digests of recordings, configuration and plant as they are now.

    Parameters
    ----------
    files : sequence of Path
        The recordings.
    configuration : Path
        Its file.
    source : PlantSource
        Of the plant.

    Raises
    ------
    DataError
        When a file cannot be read.
    """
    return Inputs(
        tuple(content_digest(path) for path in files),
        content_digest(configuration),
        digest(source_digest(source.name, source.arguments), dict(source.arguments)),
        digest(versions()),
    )
