"""The folder of a subject: recordings, subject.toml and results. Nothing else is kept."""

from __future__ import annotations

import contextlib
import functools
import os
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from impc.cli.plant import KNOWN, find_plant, subject_plant
from impc.errors import ImpcError, InputError
from impc.files.checks import Notice, fault
from impc.files.configuration import (
    FILL_IN,
    Configuration,
    SubjectTable,
    configuration,
    converted,
    toml_content,
)
from impc.files.disk import write_whole
from impc.files.draft import drafted
from impc.files.edited import edited
from impc.files.formats import FORMATS, read_table
from impc.files.plant_sources import PlantSource, make_plant
from impc.files.reading import examine
from impc.files.table import Table
from impc.model.plant import Plant

CONFIG, RESULTS, _FIT = "subject.toml", "results", "fit-"
_FINISHED = "result.json"
_one_writer = threading.Lock()


@dataclass(frozen=True)
class Subject:
    """The folder of one subject, made anew for each request: files may change elsewhere."""

    folder: Path
    plants: tuple[str, ...]  # Plants to choose from, the first one at first

    @property
    def config(self) -> Path:
        """File with the answers."""
        return self.folder / CONFIG

    @property
    def recordings(self) -> list[Path]:
        """Files of the folder with the ending of a recording."""
        found = (path for path in self.folder.iterdir() if may_be_recording(path.name))
        return sorted(path for path in found if path.is_file())

    @functools.cached_property
    def text(self) -> str:
        """subject.toml, or the draft for the first readable recording; empty without one."""
        if self.config.exists():
            return self.config.read_text(encoding="utf-8-sig")
        names, tables = [], []
        for path in self.recordings:
            with contextlib.suppress(ImpcError, OSError):
                tables.append(table(path))
                names.append(path.name)
        if not tables:
            return ""
        text = drafted(tables[0], find_plant(self.plants[0], {})).toml()
        return edited(text, {("subject", "plant"): self.plants[0], ("subject", "files"): names})

    @functools.cached_property
    def content(self) -> dict[str, Any]:
        """The tables of `text`."""
        return _valid(self.text)

    @property
    def asked(self) -> SubjectTable:
        """Plant and files that are named."""
        given = self.content.get("subject", {})
        return converted(lambda place: f"{CONFIG}: subject.{place}", given, SubjectTable)

    @property
    def sheet(self) -> str:
        """Sheet of workbooks; empty for the first with numbers."""
        return str(self.content.get("recording", {}).get("sheet", ""))

    @property
    def trials(self) -> list[Path]:
        """Recordings that are fitted."""
        named = self.asked.files
        return [path for path in self.recordings if path.name in named]

    @property
    def plant_name(self) -> str:
        """Name of the plant; code that is not impc's must be one of `plants`."""
        named = self.asked.plant or self.plants[0]
        if named in self.plants:
            return named
        return subject_plant(self.config, named, None, allowed=False)

    @property
    def given(self) -> str | None:
        """Plant that the command names: code that the user allowed when impc app was started."""
        return self.plant_name if self.plant_name in set(self.plants) - set(KNOWN) else None

    @property
    def source(self) -> PlantSource:
        """The plant's function with the answers that are given."""
        given = self.content.get("plant", {})
        known = {name: value for name, value in given.items() if value != FILL_IN}
        return find_plant(self.plant_name, known)

    @property
    def configuration(self) -> Configuration:
        """The validated answers."""
        return configuration(self.content, CONFIG)

    def plant(self) -> Plant:
        """The plant with the signals that are recorded."""
        return make_plant(self.source, ())

    def change(self, changes: Mapping[tuple[str, ...], Any]) -> None:
        """Write answers into subject.toml if they are valid; all other lines stay."""
        with _one_writer:
            before = Subject(self.folder, self.plants).text  # as it is now
            after = edited(before, changes)
            _valid(after)
            if after != before or not self.config.exists():
                write_whole(self.config, after.encode())

    def notices(self) -> tuple[Notice, ...]:
        """All that the checks of the recordings find."""
        try:
            asked = self.configuration
            plant = make_plant(self.source, asked.recorded)
            tables = [table(path, self.sheet) for path in self.trials]
            return examine(tables, asked, plant)
        except ImpcError as error:
            return (fault(error),)

    @property
    def outs(self) -> list[Path]:
        """Folders of results of this page, the newest first."""
        found = [path for path in self.folder.glob(f"{RESULTS}/{_FIT}*") if _number(path)]
        return sorted(found, key=_number, reverse=True)

    @property
    def out(self) -> Path:
        """Folder of the next fit: a new one, or that of an unfinished fit, which goes on."""
        last = next(iter(self.outs), None)
        if last is not None and not (last / _FINISHED).exists():
            return last
        return self.folder / RESULTS / f"{_FIT}{1 + (_number(last) if last else 0)}"

    def command(self, out: Path) -> list[str]:
        """The command of a fit, with paths from the folder in which impc runs."""
        words = ["impc", "fit", "--config", near(self.config), "--out", near(out)]
        return words if self.given is None else [*words, "--plant", self.given]


def _valid(text: str) -> dict[str, Any]:
    """The tables of a TOML text, validated as soon as signals are named."""
    found = toml_content(text, CONFIG)
    if found.get("signals"):
        configuration(found, CONFIG)
    return found


def _number(path: Path) -> int:
    digits = path.name.removeprefix(_FIT)
    return int(digits) if digits.isascii() and digits.isdigit() else 0


def near(path: Path) -> str:
    """A path as it is typed in the working folder."""
    here = Path.cwd()
    return str(path.relative_to(here)) if path.is_relative_to(here) else str(path)


def may_be_recording(name: str) -> bool:
    """Whether a file name is one of a recording."""
    return name[:1] not in (".", "~", "") and Path(name).suffix.lower() in FORMATS


def table(path: Path, sheet: str = "") -> Table:
    """The columns of a recording; kept until the file changes."""
    changed = path.stat().st_mtime_ns if path.exists() else 0  # reading says what is wrong
    return _table(path, sheet, changed)


@functools.lru_cache(maxsize=16)
def _table(path: Path, sheet: str, _changed: int) -> Table:
    return read_table(path, sheet=sheet)


def folder_below(root: Path, name: str) -> Path:
    """The folder `name` below the root; links do not lead out of it."""
    found = Path(os.path.realpath(root / name))
    inside = found.relative_to(root).parts if found.is_relative_to(root) else ("..",)
    if not found.is_dir() or any(part.startswith((".", "..")) for part in inside):
        raise InputError("folder", f"{name!r} is not below {root}", "open another one")
    return found
