"""Which study a result belongs to."""

from __future__ import annotations

import hashlib
import importlib.metadata
from typing import TYPE_CHECKING

from impc.cohort.work import FitTask
from impc.errors import DataError

if TYPE_CHECKING:
    from pathlib import Path

    from impc.cohort.study import Study, Unit

__all__ = ["fit_task"]

_EDGE = 1 << 16
# They say how many replicates there are, not what any of them is.
_COUNTS = ("replicates",)


def fit_task(study: Study, unit: Unit) -> FitTask:
    """The task of a unit, with the digest of all that its result depends on.

    Of a recording count its size and its first and last 64 kB: a study may have terabytes.

    Raises
    ------
    DataError
        When a recording cannot be opened.
    """
    configuration = study.configuration
    settings = {key: value for key, value in configuration.fit.items() if key not in _COUNTS}
    text = hashlib.sha256(importlib.metadata.version("impc").encode())
    for part in (study.plant, sorted(unit.arguments.items()), sorted(settings.items())):
        text.update(repr(part).encode())
    text.update(repr((configuration.recording, sorted(configuration.signals.items()))).encode())
    for file in unit.files:
        text.update(_edges(file))
    return FitTask(
        tuple(str(file.resolve()) for file in unit.files),
        study.plant,
        unit.arguments,
        configuration,
        text.hexdigest(),
    )


def _edges(path: Path) -> bytes:
    try:
        size = path.stat().st_size
        with path.open("rb") as stream:
            first = stream.read(_EDGE)
            stream.seek(max(size - _EDGE, 0))
            return f"{size}".encode() + first + stream.read(_EDGE)
    except OSError as error:
        raise DataError(
            f"recording {path.name}", f"cannot be opened ({error.strerror})", "check the path"
        ) from None
