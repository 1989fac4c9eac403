"""At the door of every file: it is ordinary, small enough, and what fails inside is one line."""

from __future__ import annotations

import stat
from typing import TYPE_CHECKING

from impc.errors import DataError, ImpcError, brief

if TYPE_CHECKING:
    from pathlib import Path

#: Bytes of a file, and of its arrays in memory: an hour of 16 channels at 2 kHz.
LARGEST = 1_000_000_000


def require_ordinary(path: Path, largest: int, error: type[ImpcError] = DataError) -> int:
    """Look at the file at `path` before it is opened: a pipe would never end. Its size in bytes.

    More than `largest` bytes are refused. Links are followed; `error` is the kind that is raised.
    """
    source = str(path)
    try:
        found = path.stat()
    except FileNotFoundError:
        raise error(source, "does not exist", "check the path") from None
    except (OSError, ValueError) as fault:  # ValueError: a zero byte in the name
        reason = getattr(fault, "strerror", None) or str(fault)
        raise error(source, f"cannot be opened ({reason})", "check the path") from None
    if stat.S_ISDIR(found.st_mode):
        raise error(source, "is a folder", "name the file in it")
    if not stat.S_ISREG(found.st_mode):
        raise error(source, "is no ordinary file", "copy it to one")
    if found.st_size == 0:
        raise error(source, "is empty (0 bytes)", "copy or export it again")
    if found.st_size > largest:
        raise error(
            source,
            f"has {_size(found.st_size)}, and {_size(largest)} is the most that is read",
            "export only the signals and seconds that are needed"
            if error is DataError
            else "give a smaller one",
        )
    return found.st_size


def damaged(source: str, fault: Exception) -> DataError:
    """What a library says of a file, the `source`, that it cannot read: a `fault` of any kind."""
    reason = brief(" ".join(str(fault).split()), 120) or type(fault).__name__
    return DataError(source, f"is damaged and cannot be read ({reason})", "copy or export it again")


def _size(size: int) -> str:
    return f"{size / 1e9:.1f} GB" if size >= 50_000_000 else f"{size / 1e6:.3g} MB"
