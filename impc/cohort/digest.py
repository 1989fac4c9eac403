"""Which study a result belongs to: the digest of all that a unit's fit depends on."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from impc.digest import content_digest, digest, source_digest, versions

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from impc.files.configuration import Configuration

__all__ = ["unit_digest"]

# They say how many replicates there are, not what any of them is.
_COUNTS = ("replicates",)


def unit_digest(
    files: Sequence[str], plant: str, arguments: Mapping[str, Any], configuration: Configuration
) -> str:
    """Of the whole content of recordings, of plant, settings and versions.

    Parameters
    ----------
    files : sequence of str
        Recordings, one a trial. Their names count too: a name may tell a label, and its ending the
        format.
    plant : str
        Import path, imported already, or file.
    arguments : mapping
        Of the plant.
    configuration : Configuration
        Signals and settings.

    Raises
    ------
    DataError
        When a recording cannot be read.
    """
    return digest(
        [(Path(name).name, content_digest(Path(name))) for name in files],
        source_digest(plant, arguments),
        dict(arguments),
        configuration.recording,
        configuration.signals,
        {key: value for key, value in configuration.fit.items() if key not in _COUNTS},
        versions(),
    )
