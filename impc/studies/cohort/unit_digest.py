"""Which study a result belongs to: the digest of all that a unit's fit depends on."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from impc.errors import DataError
from impc.files.digests import content_digest, digest, source_digest, versions

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from impc.files.configuration import Configuration

# They say how many replicates there are, not what any of them is.
_COUNTS = ("replicates",)


def unit_digest(
    files: Sequence[str], plant: str, arguments: Mapping[str, Any], configuration: Configuration
) -> str:
    """Of the whole content of recordings, of plant, settings and versions."""
    return digest(
        [(Path(name).name, content_digest(Path(name))) for name in files],
        source_digest(plant, arguments),
        dict(arguments),
        configuration.recording,
        configuration.signals,
        {key: value for key, value in configuration.fit.items() if key not in _COUNTS},
        versions(),
    )


def require_same_inputs(here: str, wanted: str) -> None:
    """Refuse to work where the files, the plant or the versions are not those of the client."""
    if here != wanted:
        raise DataError(
            "worker",
            "has other recordings, another plant or other versions than this command",
            "give all machines the same, and start the workers again",
        )
