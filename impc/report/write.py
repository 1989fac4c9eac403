"""Write a set of files whole or not at all."""

from __future__ import annotations

import os
import shutil
import tempfile
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from impc.errors import OutputError

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

__all__ = ["require_writable", "write_files"]

_REMEDY = "give another folder"


def require_writable(folder: Path) -> None:
    """Check, before a long computation, that files can be written to a folder or it can be made.

    Nothing is created. What happens later (a full disk) is left to `write_files`.

    Raises
    ------
    OutputError
        When the folder or what it would be made in is a file, or may not be written to.
    """
    try:
        existing = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    except OSError as error:
        raise _unwritable(folder, error) from None
    if not existing.is_dir():
        raise OutputError(f"folder {folder}", f"{existing} is a file", _REMEDY)
    if not os.access(existing, os.W_OK | os.X_OK):
        raise OutputError(f"folder {folder}", f"{existing} may not be written to", _REMEDY)


def write_files(folder: Path, files: Mapping[str, bytes]) -> tuple[Path, ...]:
    """Write files by name into a folder, which is made when it is missing.

    They are written into a temporary folder first and moved from there one by one. When anything
    fails, files that were there before are put back and what was made is removed.

    Returns
    -------
    tuple of Path
        What was written, in the order given.

    Raises
    ------
    OutputError
        When the folder cannot be made or a file cannot be written.
    """
    require_writable(folder)
    try:
        with _made(folder), tempfile.TemporaryDirectory(prefix=".impc-", dir=folder) as staging:
            new, old = Path(staging, "new"), Path(staging, "old")
            new.mkdir()
            old.mkdir()
            for name, content in files.items():
                (new / name).write_bytes(content)
            with ExitStack() as undo:
                for name in files:
                    _move(new / name, folder / name, old / name, undo)
                undo.pop_all()
    except OSError as error:
        raise _unwritable(folder, error) from None
    return tuple(folder / name for name in files)


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


def _unwritable(folder: Path, error: OSError) -> OutputError:
    reason = error.strerror or type(error).__name__
    return OutputError(f"folder {folder}", f"cannot be written to ({reason})", _REMEDY)
