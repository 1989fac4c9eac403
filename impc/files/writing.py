"""A file written whole or not at all: the one way in which this package writes one."""

from __future__ import annotations

import errno
import os
from typing import TYPE_CHECKING

from impc.errors import OutputError

if TYPE_CHECKING:
    from pathlib import Path

#: What to do about a file that cannot be written, where room would not help.
IN_ITS_PLACE = "move what is in its place, or give another folder"
#: Numbers of errors that room on the disk, or a larger quota or limit, would mend.
NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def unwritable(subject: str, error: OSError | ValueError, remedy: str) -> OutputError:
    """What to say of the `error` of a `subject` that cannot be written.

    The `remedy`, or to make room if there is none.
    """
    number = getattr(error, "errno", None)
    reason = getattr(error, "strerror", None) or str(error) or type(error).__name__
    told = "make room and start again" if number in NO_ROOM else remedy
    return OutputError(subject, f"cannot be written ({reason})", told)


def require_ordinary(path: Path) -> None:
    """Refuse a pipe or a device at `path`, in the place of a file: to open it may wait for ever."""
    if not path.is_file() and path.exists():
        raise OSError(errno.EINVAL, "no ordinary file")


def write_whole(path: Path, content: bytes, *, flush: bool = True) -> None:
    """Write `content` beside `path`, flush to the disk, rename: the whole file, or the one before.

    Its folder is made when it is missing. What says itself whether it is whole needs no `flush`.
    """
    staging = path.with_name(f".{path.name}.part")
    try:
        if not path.parent.is_dir():
            path.parent.mkdir(parents=True, exist_ok=True)
        staging.unlink(missing_ok=True)  # of a run that was killed
        try:
            # "x": never through a link that somebody put there.
            with staging.open("xb") as stream:
                stream.write(content)
                if flush:
                    stream.flush()
                    os.fsync(stream.fileno())
            os.replace(staging, path)
        except BaseException:  # also when interrupted from the keyboard
            staging.unlink(missing_ok=True)
            raise
        if flush:
            flush_folder(path.parent)
    except (OSError, ValueError) as error:
        raise unwritable(f"file {path}", error, IN_ITS_PLACE) from None


def remove_empty(folder: Path) -> None:
    """Remove a `folder` and those in it, as far as there are no files in them."""
    for path in (*sorted(folder.rglob("*"), reverse=True), folder):
        if path.is_dir() and not path.is_symlink() and not os.listdir(path):
            path.rmdir()


def flush_folder(folder: Path) -> None:
    """Flush the names in a `folder` to the disk, where the system lets folders be opened."""
    if os.name != "posix":
        return
    number = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(number)
    finally:
        os.close(number)
