"""Results of a cohort in a folder: one file a unit of work, written whole and renamed into place.

    OUT/manifest.json                  the units, their digests, the version
    OUT/units/NAME/fit.json            a fit, or
    OUT/units/NAME/failed.json         why there is none
    OUT/units/NAME/replicate-0007.json
    OUT/cohort.log                     what happened when

A file that is there is finished work: it is never computed again, and never overwritten. A unit
whose recordings or settings have changed since is refused. One run at a time holds OUT/.lock.
"""

from __future__ import annotations

import json
import os
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import locket

from impc.errors import InputError, OutputError

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

__all__ = ["Store", "open_store"]


@dataclass(frozen=True)
class Store:
    """A folder of results.

    Attributes
    ----------
    folder : Path
        Where the files are.
    """

    folder: Path

    def fit(self, unit: str) -> dict[str, Any] | None:
        """The fit of a unit, or None.

        Raises
        ------
        InputError
            When the file is not what this program wrote.
        """
        return _read(self._path(unit, "fit"))

    def failure(self, unit: str) -> str | None:
        """Why a unit has no fit, or None.

        Raises
        ------
        InputError
            When the file is not what this program wrote.
        """
        found = _read(self._path(unit, "failed"))
        return None if found is None else str(found["reason"])

    def replicate(self, unit: str, index: int) -> dict[str, Any] | None:
        """The replicate `index` of a `unit`, or None.

        Raises
        ------
        InputError
            When the file is not what this program wrote.
        """
        return _read(self._path(unit, f"replicate-{index:04d}"))

    def has_replicate(self, unit: str, index: int) -> bool:
        """Whether the replicate `index` of a `unit` is done."""
        return self._path(unit, f"replicate-{index:04d}").exists()

    def keep_fit(self, unit: str, content: Mapping[str, Any]) -> None:
        """Write the fit of a `unit` down, or the reason for none: `content`.

        Raises
        ------
        OutputError
            When that cannot be done.
        """
        if "reason" in content:
            self._write(self._path(unit, "failed"), content)
            return
        self._path(unit, "failed").unlink(missing_ok=True)
        self._write(self._path(unit, "fit"), content)

    def keep_replicate(self, unit: str, index: int, content: Mapping[str, Any]) -> None:
        """Write the replicate `index` of a `unit` down: `content`.

        Raises
        ------
        OutputError
            When that cannot be done.
        """
        self._write(self._path(unit, f"replicate-{index:04d}"), content)

    def keep_manifest(self, content: Mapping[str, Any]) -> None:
        """Write the manifest down: `content`.

        Raises
        ------
        OutputError
            When that cannot be done.
        """
        self._write(self.folder / "manifest.json", content)

    def write(self, name: str, content: bytes) -> None:
        """Write any file of the folder: its `name` and `content`.

        Raises
        ------
        OutputError
            When that cannot be done.
        """
        _replace(self.folder / name, content)

    def require_same(self, unit: str, digest: str) -> None:
        """Refuse a unit whose fit is of other recordings or other settings than `digest` says.

        Raises
        ------
        InputError
            When its fit has another digest, or cannot be read.
        """
        found = self.fit(unit)
        if found is not None and found["digest"] != digest:
            raise InputError(
                f"folder {self.folder}: {unit}",
                "was fitted to other recordings or with other settings",
                "give another folder, or remove units/" + unit,
            )

    def _path(self, unit: str, name: str) -> Path:
        return self.folder / "units" / unit / f"{name}.json"

    def _write(self, path: Path, content: Mapping[str, Any]) -> None:
        text = json.dumps(content, allow_nan=False)
        _replace(path, (text + "\n").encode())


@contextmanager
def open_store(folder: Path) -> Iterator[Store]:
    """Hold a folder for one run.

    Raises
    ------
    OutputError
        When it cannot be made, or another run holds it.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = locket.lock_file(str(folder / ".lock"), timeout=0)
        lock.acquire()
    except locket.LockError:
        raise OutputError(
            f"folder {folder}", "another run is writing to it", "wait, or give another folder"
        ) from None
    except OSError as error:
        raise OutputError(
            f"folder {folder}", f"cannot be written to ({error.strerror})", "give another folder"
        ) from None
    try:
        yield Store(folder)
    finally:
        lock.release()


def _read(path: Path) -> dict[str, Any] | None:
    try:
        found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    except (OSError, ValueError):
        raise InputError(f"{path}", "is not what this program wrote", "remove it") from None
    return found


def _replace(path: Path, content: bytes) -> None:
    """Write beside, flush to the disk, rename: there is the whole file or none."""
    staging = path.with_name(f".{path.name}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with staging.open("wb") as stream:
            stream.write(content)
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(staging, path)
    except OSError as error:
        raise OutputError(
            f"file {path}", f"cannot be written ({error.strerror})", "make room and start again"
        ) from None
