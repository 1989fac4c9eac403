"""One process at a time holds a folder."""

from __future__ import annotations

import os
from contextlib import contextmanager
from typing import IO, TYPE_CHECKING

try:
    import fcntl
except ImportError:  # Windows
    import msvcrt

from impc.errors import OutputError
from impc.files.writing import require_ordinary, unwritable

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

#: Name of the lock in a folder.
LOCK = ".impc-lock"


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold an existing `folder` while the block lasts; the system lets go when the process dies."""
    path = folder / LOCK
    stream = _opened(path)
    try:
        yield
    finally:
        # Taken away while it is still held: whoever opened it before finds that it is gone.
        if os.name == "posix":
            path.unlink(missing_ok=True)
        stream.close()


def _opened(path: Path) -> IO[bytes]:
    while True:
        try:
            require_ordinary(path)
            stream = path.open("ab")
        except OSError as error:
            raise unwritable(f"folder {path.parent}", error, "give another folder") from None
        try:
            _take(stream)
        except OSError:
            stream.close()
            raise OutputError(
                f"folder {path.parent}",
                "another run is writing to it",
                "wait, or give another folder",
            ) from None
        if _still_there(path, stream):
            return stream
        stream.close()  # its holder took it away in between: once more


def _take(stream: IO[bytes]) -> None:
    if os.name == "posix":
        fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
    else:
        msvcrt.locking(stream.fileno(), msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined]


def _still_there(path: Path, stream: IO[bytes]) -> bool:
    try:
        return os.path.samestat(path.stat(), os.fstat(stream.fileno()))
    except FileNotFoundError:
        return False
