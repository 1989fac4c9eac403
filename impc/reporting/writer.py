"""Atomic writing of a set of files into a folder that belongs to one command.

`owned` locks the folder during a run and reserves it for the same command afterwards. The files of
`write_files` are listed in `.impc` and replace those of the previous run, so that a folder never
contains files of two runs. If a run is killed while it replaces files, `INCOMPLETE.txt` says so and
the next run replaces all files.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

import msgspec

from impc.errors import OutputError
from impc.files.disk import remove_empty, require_ordinary, unwritable, write_whole

try:
    import fcntl
except ImportError:  # Windows
    import msvcrt


_REMEDY = "choose another folder"
# List of files, lock, and folder in which files are written before they are moved.
_LIST, _LOCK, _STAGING = ".impc", ".impc-lock", ".impc-new"
_NOTICE = "INCOMPLETE.txt"
_SAID = (
    b"A run was stopped while it wrote these files; they may come from two runs. Run it again.\n"
)
# Files that mark a folder of results without a list, from an older version or another program.
_TELLING = ("report.html", "result.json", "study.toml", "truth.json")


@dataclass
class _Run:
    """Files that the run has written so far, and files of the previous run."""

    folder: Path
    command: str
    before: Mapping[str, str]  # SHA-256 by name, files of the previous run
    written: dict[str, str] = field(default_factory=dict)

    def begin(self, new: Mapping[str, bytes]) -> None:
        """List files before they are written: a killed run leaves no unlisted files."""
        for name in new:
            known = name in self.before or name in self.written
            if not known and os.path.lexists(self.folder / name):
                raise OutputError(
                    f"file {self.folder / name}", "was not written by this command",
                    "move it, or choose another folder",
                )  # fmt: skip
        if not self.written and self.before:
            write_whole(self.folder / _NOTICE, _SAID)
        self.written |= {name: hashlib.sha256(one).hexdigest() for name, one in new.items()}
        self.list({**self.before, **self.written})

    def list(self, files: Mapping[str, str]) -> None:
        """Write the list: the command, and one line per file."""
        lines = [self.command, *(json.dumps(item) for item in files.items())]
        write_whole(self.folder / _LIST, ("\n".join(lines) + "\n").encode())

    def undo(self, names: Iterable[str]) -> None:
        """Remove restored files from the list."""
        for name in names:
            self.written.pop(name, None)
        if not self.written:
            (self.folder / _NOTICE).unlink(missing_ok=True)

    def finish(self) -> None:
        """Remove files of the previous run that this run did not write."""
        for name in self.before.keys() - self.written.keys():
            # Keep files that have changed since: the user's, or listed by mistake.
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
    """Lock a `folder` for one run of a `command`; a new folder without files is removed."""
    require_writable(folder)
    with ExitStack() as undo:
        try:
            missing = _missing(folder)
            if missing:
                undo.callback(remove_empty, missing[-1])
            folder.mkdir(parents=True, exist_ok=True)
            undo.enter_context(_locked(folder))
            run = _Run(folder, command, _listed(folder, command))
            shutil.rmtree(folder / _STAGING, ignore_errors=True)  # left by a killed run
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
    """Remove the list if nothing was written and no intermediate results are kept."""
    if set(os.listdir(folder)) == before | {_LIST}:
        (folder / _LIST).unlink()


def _missing(folder: Path) -> list[Path]:
    """The folder and its parents that do not exist yet."""
    return [path for path in (folder, *folder.parents) if not path.exists()]


def written(folder: Path) -> Mapping[str, str]:
    """Files that a run wrote to the folder, by its list: SHA-256 by name; empty without a list."""
    return _listed(folder, None)


def _listed(folder: Path, command: str | None) -> dict[str, str]:
    """Files that an earlier run of the `command` (None: any) wrote: SHA-256 by name."""
    try:
        require_ordinary(folder / _LIST)
        owner, *lines = (folder / _LIST).read_text(encoding="utf-8").splitlines()
        found = dict(msgspec.json.decode(line, type=tuple[str, str]) for line in lines)
    except FileNotFoundError:
        telling = [name for name in _TELLING if (folder / name).exists()]
        if telling and command is not None:
            raise OutputError(
                f"folder {folder}", f"contains {telling[0]}, not written by this version", _REMEDY
            ) from None
        return {}
    except (OSError, ValueError, RecursionError):
        raise OutputError(f"folder {folder}", f"its list {_LIST} is damaged", _REMEDY) from None
    if command not in (None, owner):
        raise OutputError(f"folder {folder}", f"contains results of impc {owner}", _REMEDY)
    return {name: seal for name, seal in found.items() if _is_inside(Path(name))}


def _is_inside(name: Path) -> bool:
    return not name.is_absolute() and ".." not in name.parts


def _has(path: Path, seal: str) -> bool:
    """Whether the file has the SHA-256 `seal`."""
    return path.is_file() and hashlib.sha256(path.read_bytes()).hexdigest() == seal


def require_writable(folder: Path) -> None:
    """Raise OutputError if files cannot be written to the folder; creates nothing."""
    try:
        existing = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    except (OSError, ValueError) as error:
        raise _unwritable(folder, error) from None
    if not existing.is_dir():
        raise OutputError(f"folder {folder}", f"{existing} is a file", _REMEDY)
    if not os.access(existing, os.W_OK | os.X_OK):
        raise OutputError(f"folder {folder}", f"{existing} is not writable", _REMEDY)


def write_files(folder: Path, files: Mapping[str, bytes]) -> tuple[Path, ...]:
    """Write files by way of a staging folder; if anything fails, restore what was there."""
    require_writable(folder)
    run = _RUN.get()
    if run is not None and not folder.is_relative_to(run.folder):
        run = None
    # Inside the owned folder, so that the next run can remove what a killed one left.
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
    """Replace target by source in one step, and register the undo."""
    target.parent.mkdir(parents=True, exist_ok=True)
    require_ordinary(target)
    if target.exists():
        undo.callback(write_whole, target, target.read_bytes())
    else:
        undo.callback(target.unlink, missing_ok=True)
    os.replace(source, target)


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Lock an existing `folder` during the block; the system unlocks it if the process dies."""
    path = folder / _LOCK
    stream = _lock_of(path)
    try:
        yield
    finally:
        # Removed while still locked: a process that has opened it finds that it is gone.
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
                "wait for it, or choose another folder",
            ) from None
        if _is_there(path, stream):
            return stream
        stream.close()  # its holder removed it in between: try again


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
