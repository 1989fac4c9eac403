"""Write a set of files whole or not at all, into a folder that one command owns.

A command holds its folder with `owned`: no second run enters it meanwhile, and no other command
afterwards. What it writes with `write_files` is listed in `.impc`, and replaces what the same
command wrote there before, so that a folder never shows files of two runs. If a run is killed while
it replaces them, the folder says so in `INCOMPLETE.txt`, and the next run replaces all.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from contextlib import ExitStack, contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, TYPE_CHECKING

import msgspec

from impc.errors import OutputError
from impc.files.disk import remove_empty, require_ordinary, unwritable, write_whole

try:
    import fcntl
except ImportError:  # Windows
    import msvcrt

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

_REMEDY = "give another folder"
# List, lock, and where files are written before they are moved to their places.
_LIST, _LOCK, _STAGING = ".impc", ".impc-lock", ".impc-new"
_NOTICE = "INCOMPLETE.txt"
_SAID = b"A run was stopped while it wrote these files: they may be of two runs. Run it again.\n"
# Files by which results are known that have no list: of an older version, or not of this program.
_TELLING = ("report.html", "result.json", "study.toml", "truth.json")


@dataclass
class _Run:
    """What a run that owns its folder has written so far, and what was there of the last one."""

    folder: Path
    command: str
    before: Mapping[str, str]  # SHA-256 by name
    written: dict[str, str] = field(default_factory=dict)

    def begin(self, new: Mapping[str, bytes]) -> None:
        """List files before they are written, so that a killed run leaves none unlisted."""
        for name in new:
            known = name in self.before or name in self.written
            if not known and os.path.lexists(self.folder / name):
                raise OutputError(
                    f"file {self.folder / name}", "is not of an earlier run of this command",
                    "move it, or give another folder",
                )  # fmt: skip
        if not self.written and self.before:
            write_whole(self.folder / _NOTICE, _SAID)
        self.written |= {name: hashlib.sha256(one).hexdigest() for name, one in new.items()}
        self.list({**self.before, **self.written})

    def list(self, files: Mapping[str, str]) -> None:
        """Write the list: the command, and a line for each file."""
        lines = [self.command, *(json.dumps(item) for item in files.items())]
        write_whole(self.folder / _LIST, ("\n".join(lines) + "\n").encode())

    def undo(self, names: Iterable[str]) -> None:
        """These files were put back as they were."""
        for name in names:
            self.written.pop(name, None)
        if not self.written:
            (self.folder / _NOTICE).unlink(missing_ok=True)

    def finish(self) -> None:
        """Remove what the last run wrote and this one did not."""
        for name in self.before.keys() - self.written.keys():
            # What somebody has changed since, or a damaged list names by mistake, is not ours.
            if _has(self.folder / name, self.before[name]):
                (self.folder / name).unlink()
                for parent in Path(name).parents[:-1]:
                    if not os.listdir(self.folder / parent):
                        (self.folder / parent).rmdir()
        self.list(self.written)
        (self.folder / _NOTICE).unlink(missing_ok=True)


_RUN: ContextVar[_Run | None] = ContextVar("run", default=None)


@contextmanager
def owned(folder: Path, command: str) -> Iterator[None]:
    """Hold a `folder` for one run of a `command`; what `write_files` writes meanwhile replaces.

    Nothing is left of a folder that is made here and in which nothing was written.
    """
    require_writable(folder)
    with ExitStack() as undo:
        try:
            missing = _missing(folder)
            if missing:
                undo.callback(remove_empty, missing[-1])
            folder.mkdir(parents=True, exist_ok=True)
            undo.enter_context(_locked(folder))
            run = _Run(folder, command, _listed(folder, command))
            shutil.rmtree(folder / _STAGING, ignore_errors=True)  # of a run that was killed
            if not (folder / _LIST).exists():
                there = set(os.listdir(folder))
                run.list({})
                undo.callback(_unlist, folder, there)
        except OSError as error:
            raise _unwritable(folder, error) from None
        token = _RUN.set(run)
        try:
            yield
        finally:
            _RUN.reset(token)
        try:
            if run.written:
                run.finish()
        except OSError as error:
            raise _unwritable(folder, error) from None


def _unlist(folder: Path, before: set[str]) -> None:
    """Take the list away again when nothing was written, and no work is kept."""
    if set(os.listdir(folder)) == before | {_LIST}:
        (folder / _LIST).unlink()


def _missing(folder: Path) -> list[Path]:
    """The folder and those above it that are not there yet."""
    return [path for path in (folder, *folder.parents) if not path.exists()]


def _listed(folder: Path, command: str) -> dict[str, str]:
    """What a run of the `command` wrote to the folder before: SHA-256 by name."""
    try:
        require_ordinary(folder / _LIST)
        owner, *lines = (folder / _LIST).read_text(encoding="utf-8").splitlines()
        found = dict(msgspec.json.decode(line, type=tuple[str, str]) for line in lines)
    except FileNotFoundError:
        telling = [name for name in _TELLING if (folder / name).exists()]
        if telling:
            raise OutputError(
                f"folder {folder}", f"holds {telling[0]} of another version or of your own", _REMEDY
            ) from None
        return {}
    except (OSError, ValueError, RecursionError):
        raise OutputError(f"folder {folder}", f"its list {_LIST} is damaged", _REMEDY) from None
    if owner != command:
        raise OutputError(f"folder {folder}", f"holds results of impc {owner}", _REMEDY)
    return {name: seal for name, seal in found.items() if _is_inside(Path(name))}


def _is_inside(name: Path) -> bool:
    return not name.is_absolute() and ".." not in name.parts


def _has(path: Path, seal: str) -> bool:
    """Whether the content of a file has that SHA-256."""
    return path.is_file() and hashlib.sha256(path.read_bytes()).hexdigest() == seal


def require_writable(folder: Path) -> None:
    """Check, before a long computation, that files can be written to a folder or it can be made.

    Nothing is created. What happens later (a full disk) is left to `write_files`.
    """
    try:
        existing = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    except (OSError, ValueError) as error:
        raise _unwritable(folder, error) from None
    if not existing.is_dir():
        raise OutputError(f"folder {folder}", f"{existing} is a file", _REMEDY)
    if not os.access(existing, os.W_OK | os.X_OK):
        raise OutputError(f"folder {folder}", f"{existing} may not be written to", _REMEDY)


def write_files(folder: Path, files: Mapping[str, bytes]) -> tuple[Path, ...]:
    """Write files by name into a folder, which is made when it is missing.

    They are written into a folder of their own first and moved from there one by one. When anything
    fails, files that were there before are put back and what was made is removed.
    """
    require_writable(folder)
    run = _RUN.get()
    if run is not None and not folder.is_relative_to(run.folder):
        run = None
    # In the folder that is owned: the next run finds there what a killed one left.
    staging = (folder if run is None else run.folder) / _STAGING
    try:
        with ExitStack() as undo, ExitStack() as always:
            missing = _missing(folder)
            if missing:
                undo.callback(remove_empty, missing[-1])
            staging.mkdir(parents=True, exist_ok=True)
            always.callback(shutil.rmtree, staging, ignore_errors=True)
            for index, content in enumerate(files.values()):
                with (staging / str(index)).open("wb") as stream:
                    stream.write(content)
                    stream.flush()
                    os.fsync(stream.fileno())
            if run is not None:
                place = folder.relative_to(run.folder)
                listed = {(place / name).as_posix(): files[name] for name in files}
                undo.callback(run.undo, listed)
                run.begin(listed)
            for index, name in enumerate(files):
                _move(staging / str(index), folder / name, undo)
            undo.pop_all()
    except OSError as error:
        raise _unwritable(folder, error) from None
    return tuple(folder / name for name in files)


def _move(source: Path, target: Path, undo: ExitStack) -> None:
    """Put source in the place of target in one step, and note how to undo it."""
    target.parent.mkdir(parents=True, exist_ok=True)
    require_ordinary(target)
    if target.exists():
        undo.callback(write_whole, target, target.read_bytes())
    else:
        undo.callback(target.unlink, missing_ok=True)
    os.replace(source, target)


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Hold an existing `folder` while the block lasts; the system lets go when the process dies."""
    path = folder / _LOCK
    stream = _lock_of(path)
    try:
        yield
    finally:
        # Taken away while it is still held: whoever opened it before finds that it is gone.
        if os.name == "posix":
            path.unlink(missing_ok=True)
        stream.close()


def _lock_of(path: Path) -> IO[bytes]:
    while True:
        try:
            require_ordinary(path)
            stream = path.open("ab")
        except OSError as error:
            raise _unwritable(path.parent, error) from None
        try:
            _take(stream)
        except OSError:
            stream.close()
            raise OutputError(
                f"folder {path.parent}",
                "another run is writing to it",
                "wait, or give another folder",
            ) from None
        if _is_there(path, stream):
            return stream
        stream.close()  # its holder took it away in between: once more


def _take(stream: IO[bytes]) -> None:
    if os.name == "posix":
        fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
    else:
        msvcrt.locking(stream.fileno(), msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined]


def _is_there(path: Path, stream: IO[bytes]) -> bool:
    try:
        return os.path.samestat(path.stat(), os.fstat(stream.fileno()))
    except FileNotFoundError:
        return False


def _unwritable(folder: Path, error: OSError | ValueError) -> OutputError:
    return unwritable(f"folder {folder}", error, _REMEDY)
