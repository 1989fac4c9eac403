"""Files on the disk: ordinary and small enough to read, written whole or not at all."""

from __future__ import annotations

import errno
import json
import os
import stat
from typing import TYPE_CHECKING, Any

from impc.errors import DataError, ImpcError, OutputError, brief

if TYPE_CHECKING:
    from pathlib import Path

#: Bytes of a file, and of its arrays in memory: an hour of 16 channels at 2 kHz.
LARGEST = 1_000_000_000


def require_readable(path: Path, largest: int, error: type[ImpcError] = DataError) -> int:
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
    stated = "make room and start again" if number in NO_ROOM else remedy
    return OutputError(subject, f"cannot be written ({reason})", stated)


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


def truth_beside(folder: Path) -> Any:
    """The truth.json of a `folder`, that of simulated recordings; {} where none can be read."""
    path = folder / "truth.json"
    try:
        return json.loads(path.read_text("utf-8")) if path.stat().st_size <= LARGEST else {}
    except (OSError, ValueError):
        return {}
