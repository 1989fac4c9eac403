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
import tempfile
from contextlib import ExitStack, contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from impc.errors import OutputError
from impc.files.writing import remove_empty, require_ordinary, unwritable, write_whole
from impc.reporting.lock import locked

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

_REMEDY = "give another folder"
_LIST, _NOTICE = ".impc", "INCOMPLETE.txt"
_STAGING = ".impc-"  # how the name of the folder begins from which files are moved
_SAID = b"A run was stopped while it wrote these files: they may be of two runs. Run it again.\n"
# Files by which results are known that have no list: of an older version, or not of this program.
_TELLING = ("report.html", "result.json", "study.toml", "truth.json")


@dataclass
class _Run:
    """What a run that owns its folder has written so far, and what was there of the last one."""

    folder: Path
    command: str
    before: Mapping[str, str]
    written: dict[str, str] = field(default_factory=dict)

    def begin(self, new: dict[str, bytes]) -> None:
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
        found = {name: hashlib.sha256(content).hexdigest() for name, content in new.items()}
        self.note(found)
        self.written |= found

    def note(self, seals: Mapping[str, str]) -> None:
        """Add files to the list, by name and SHA-256."""
        with (self.folder / _LIST).open("a", encoding="utf-8") as stream:
            stream.writelines(json.dumps([name, seal]) + "\n" for name, seal in seals.items())

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
            if not _has(self.folder / name, self.before[name]):
                continue
            (self.folder / name).unlink()
            for parent in Path(name).parents[:-1]:
                _remove_if_empty(self.folder / parent)
        lines = [self.command, *(json.dumps(item) for item in self.written.items())]
        write_whole(self.folder / _LIST, ("\n".join(lines) + "\n").encode())
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
            for path in reversed((folder, *folder.parents)):  # undone from the inside out
                if not path.exists():
                    undo.callback(_remove_if_empty, path)
            folder.mkdir(parents=True, exist_ok=True)
            undo.enter_context(locked(folder))
            run = _begun(folder, command, undo)
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


def _begun(folder: Path, command: str, undo: ExitStack) -> _Run:
    listed = _listed(folder, command)
    staged = [name for name in listed if name.startswith(_STAGING)]
    here = Path(os.path.realpath(folder))
    for name in staged:  # of `write_files` in a run that was killed; never through a link
        if Path(os.path.realpath((here / name).parent)) == (here / name).parent:
            (here / name).unlink(missing_ok=True)
    for name in {Path(name).parts[0] for name in staged}:
        remove_empty(folder / name)
    before = {name: seal for name, seal in listed.items() if name not in staged}
    run = _Run(folder, command, before)
    if not (folder / _LIST).exists():
        there = set(os.listdir(folder))
        write_whole(folder / _LIST, f"{command}\n".encode())
        undo.callback(_unlist, folder, there)
    return run


def _unlist(folder: Path, before: set[str]) -> None:
    """Take the list away again when nothing was written, and no work is kept."""
    if set(os.listdir(folder)) == before | {_LIST}:
        (folder / _LIST).unlink()


def _listed(folder: Path, command: str) -> dict[str, str]:
    """What a run of the `command` wrote to the folder before: SHA-256 by name."""
    try:
        require_ordinary(folder / _LIST)
        owner, *lines = (folder / _LIST).read_text(encoding="utf-8").split("\n")
    except FileNotFoundError:
        telling = [name for name in _TELLING if (folder / name).exists()]
        if telling:
            raise OutputError(
                f"folder {folder}", f"holds {telling[0]} of another version or of your own", _REMEDY
            ) from None
        return {}
    except (OSError, ValueError):
        raise OutputError(f"folder {folder}", f"its list {_LIST} is damaged", _REMEDY) from None
    if owner != command:
        raise OutputError(f"folder {folder}", f"holds results of impc {owner}", _REMEDY)
    return dict(item for line in lines if (item := _item(line)) is not None)


def _has(path: Path, seal: str) -> bool:
    """Whether the content of a file has that SHA-256."""
    if not path.is_file():
        return False
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest() == seal


def _item(line: str) -> tuple[str, str] | None:
    """A line of the list; None for one that a killed run left half, and for no safe name."""
    try:
        name, seal = json.loads(line)
    except (ValueError, TypeError, RecursionError):
        return None
    inside = isinstance(name, str) and not Path(name).is_absolute() and ".." not in Path(name).parts
    return (name, str(seal)) if inside else None


def _remove_if_empty(folder: Path) -> None:
    if folder.is_dir() and not os.listdir(folder):
        folder.rmdir()


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

    They are written into a temporary folder first and moved from there one by one. When anything
    fails, files that were there before are put back and what was made is removed.
    """
    require_writable(folder)
    run = _RUN.get()
    if run is not None and not folder.is_relative_to(run.folder):
        run = None
    # In the folder that is owned: the next run finds there what a killed one left.
    beside = folder if run is None else run.folder
    try:
        with _made(folder), tempfile.TemporaryDirectory(prefix=_STAGING, dir=beside) as staging:
            new, old = Path(staging, "new"), Path(staging, "old")
            if run is not None:
                parts = (
                    f"{new.parent.name}/{part}/{name}" for part in ("new", "old") for name in files
                )
                run.note(dict.fromkeys(parts, ""))
            for name, content in files.items():
                (new / name).parent.mkdir(parents=True, exist_ok=True)
                (old / name).parent.mkdir(parents=True, exist_ok=True)
                _write_flushed(new / name, content)
            with ExitStack() as undo:
                if run is not None:
                    place = folder.relative_to(run.folder)
                    listed = {(place / name).as_posix(): files[name] for name in files}
                    undo.callback(run.undo, listed)
                    run.begin(listed)
                for name in files:
                    (folder / name).parent.mkdir(parents=True, exist_ok=True)
                    _move(new / name, folder / name, old / name, undo)
                undo.pop_all()
    except OSError as error:
        raise _unwritable(folder, error) from None
    return tuple(folder / name for name in files)


def _write_flushed(path: Path, content: bytes) -> None:
    with path.open("wb") as stream:
        stream.write(content)
        stream.flush()
        os.fsync(stream.fileno())


def _move(source: Path, target: Path, backup: Path, undo: ExitStack) -> None:
    """Put source in the place of target in one step, and note how to undo it."""
    if target.exists():
        shutil.copy2(target, backup)  # a copy, so that the target exists at every moment
        undo.callback(os.replace, backup, target)
    else:
        undo.callback(target.unlink, missing_ok=True)
    os.replace(source, target)


@contextmanager
def _made(folder: Path) -> Iterator[None]:
    """Make a folder and its parents; remove those that were missing when the block fails."""
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        yield
    except BaseException:  # also when interrupted from the keyboard
        for path in missing:
            if path.is_dir():
                path.rmdir()
        raise


def _unwritable(folder: Path, error: OSError | ValueError) -> OutputError:
    return unwritable(f"folder {folder}", error, _REMEDY)
