"""Files on disk: checked before reading, written atomically."""

from __future__ import annotations

import errno
import json
import os
import stat
from pathlib import Path
from typing import Any

from impc.errors import DataError, ImpcError, OutputError, brief

#: Largest file in bytes, and largest arrays in memory: an hour of 16 channels at 2 kHz.
LARGEST = 1_000_000_000


def require_readable(path: Path, largest: int, error: type[ImpcError] = DataError) -> int:
    """Size in bytes of the file at `path`, after checks: regular, not empty, not too large."""
    source = str(path)
    try:
        found = path.stat()
    except FileNotFoundError:
        raise error(source, "does not exist", "check the path") from None
    except (OSError, ValueError) as fault:  # ValueError: NUL in the name
        reason = getattr(fault, "strerror", None) or str(fault)
        raise error(source, f"cannot be opened ({reason})", "check the path") from None
    if stat.S_ISDIR(found.st_mode):
        raise error(source, "is a folder", "name the file in it")
    if not stat.S_ISREG(found.st_mode):
        raise error(source, "is not a regular file", "copy its content to a regular file")
    if found.st_size == 0:
        raise error(source, "is empty (0 bytes)", "copy or export it again")
    if found.st_size > largest:
        raise error(
            source,
            f"has {_size(found.st_size)}; at most {_size(largest)} are read",
            "export only the signals and seconds that are needed"
            if error is DataError
            else "use a smaller file",
        )
    return found.st_size


def damaged(source: str, fault: Exception) -> DataError:
    """Error for a file that a library cannot read, with the library's message."""
    reason = brief(" ".join(str(fault).split()), 120) or type(fault).__name__
    return DataError(source, f"is damaged and cannot be read ({reason})", "copy or export it again")


def _size(size: int) -> str:
    return f"{size / 1e9:.1f} GB" if size >= 50_000_000 else f"{size / 1e6:.3g} MB"


#: Remedy for a file that cannot be written for a reason other than disk space.
IN_ITS_PLACE = "move the existing file or folder of that name, or choose another folder"
#: Numbers of errors caused by a lack of disk space, by a quota or by a size limit.
NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def unwritable(subject: str, error: OSError | ValueError, remedy: str) -> OutputError:
    """Error for a file that cannot be written; advises to free space if that is the cause."""
    number = getattr(error, "errno", None)
    reason = getattr(error, "strerror", None) or str(error) or type(error).__name__
    stated = "free disk space and start again" if number in NO_ROOM else remedy
    return OutputError(subject, f"cannot be written ({reason})", stated)


def require_ordinary(path: Path) -> None:
    """Reject a pipe or device at `path`: opening it could block forever."""
    if not path.is_file() and path.exists():
        raise OSError(errno.EINVAL, "not a regular file")


def write_whole(path: Path, content: bytes, *, flush: bool = True) -> None:
    """Write `content` atomically: temporary file in the same folder, flush, rename.

    Creates a missing folder. Content that carries its own checksum needs no `flush`.
    """
    staging = path.with_name(f".{path.name}.part")
    try:
        if not path.parent.is_dir():
            path.parent.mkdir(parents=True, exist_ok=True)
        staging.unlink(missing_ok=True)  # left by a killed run
        try:
            # "x": never write through an existing link.
            with staging.open("xb") as stream:
                stream.write(content)
                if flush:
                    stream.flush()
                    os.fsync(stream.fileno())
            os.replace(staging, path)
        except BaseException:  # also when interrupted from the keyboard
            staging.unlink(missing_ok=True)
            raise
        if flush and os.name == "posix":  # the folder's entries too
            number = os.open(path.parent, os.O_RDONLY)
            try:
                os.fsync(number)
            finally:
                os.close(number)
    except (OSError, ValueError) as error:
        raise unwritable(f"file {path}", error, IN_ITS_PLACE) from None


def remove_empty(folder: Path) -> None:
    """Remove a `folder` and its subfolders that contain no files."""
    for path in (*sorted(folder.rglob("*"), reverse=True), folder):
        if path.is_dir() and not path.is_symlink() and not os.listdir(path):
            path.rmdir()


def truth_beside(folder: Path) -> Any:
    """Content of `truth.json` in a `folder` of simulated recordings; {} if unreadable."""
    path = folder / "truth.json"
    try:
        return json.loads(path.read_text("utf-8")) if path.stat().st_size <= LARGEST else {}
    except (OSError, ValueError):
        return {}
