"""Study file (docs/howto/cohort.md): which recordings belong together, and how they are fitted.

All trials with the same subject, visit and condition form a unit, which gets one fit. Names become
names of files, cells and lines on a terminal: only names that are safe in all are accepted.
"""

from __future__ import annotations

import glob
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec

from impc.errors import InputError
from impc.files.configuration import Configuration, read_configuration
from impc.files.formats import FORMATS
from impc.files.reading import require_distinct
from impc.studies.cohort.participants import (
    Participant,
    checked_name,
    read_participants,
    read_sheet,
)

_UNSAFE = re.compile(r"[^A-Za-z0-9.+-]")


class StudyTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The [study] table. Paths are relative to the study file.

    Attributes
    ----------
    plant : str, optional
        Plant of `impc cohort` and `impc reliability`: a short name, ``module:function`` or a file,
        as for `impc fit --plant`.
    model : str, optional
        Import path ``module:function`` of the model of `impc select` and `impc key-parameters`.
    recordings : str, optional
        Path pattern of the recordings with {subject}, {visit}, {condition} and {trial}; a final .*
        finds all formats. Exactly one of `recordings`, `table` and `bids` is required.
    table : str, optional
        Table with the columns file and subject, and optionally visit, condition and trial.
    bids : str, optional
        Folder whose file names contain sub-, ses-, task- and run- as in BIDS.
    participants : str, optional
        Table with a column subject (or participant_id), optionally a column group; other columns
        that are arguments of the plant, such as mass, replace those of [plant] for that subject.
    reference : str, optional
        Group, visit or condition with which the others are compared. By default EO, open, baseline,
        pre or control if a name contains this word, else the first in the order of names.
    """

    plant: str | None = None
    model: str | None = None
    recordings: str | None = None
    table: str | None = None
    bids: str | None = None
    participants: str | None = None
    reference: str | None = None


#: Labels of a unit.
LABELS = ("subject", "visit", "condition", "group")


@dataclass(frozen=True)
class Unit:
    """All trials of one subject, visit and condition."""

    subject: str
    visit: str  # Empty if the study has none
    condition: str  # Empty if the study has none
    files: tuple[Path, ...]  # In the order of the trials
    group: str = ""  # Empty if there is no column group
    # Other columns of the participants for this subject, and the row of the table
    person: Mapping[str, float | str] = field(default_factory=dict)
    row: int = 0

    @property
    def name(self) -> str:
        """Name of its folder, for example sub-01_ses-1_task-EO."""
        parts = (("sub", self.subject), ("ses", self.visit), ("task", self.condition))
        return "_".join(f"{key}-{safe_name(value)}" for key, value in parts if value)


def safe_name(name: str) -> str:
    """Convert a checked `name` to a part of a file name."""
    return _UNSAFE.sub("-", name)


@dataclass(frozen=True)
class Study:
    """Contents of a study file."""

    plant: str  # Name, import path or file of the plant; empty if not given
    configuration: Configuration  # Signals and settings of all fits
    units: tuple[Unit, ...]  # In the order of subject, visit and condition
    model: str = ""  # Import path of the model; empty if not given
    reference: str = ""  # Group, visit or condition of comparison; empty for the usual one

    @property
    def replicates(self) -> int:
        """Number of bootstrap replicates of each unit."""
        return int(self.configuration.fit.get("replicates", 0))


def read_study(path: Path) -> Study:
    """Read the study at `path` and find its recordings, each of which may be given once."""
    configuration = read_configuration(path, "study", "model", "select")
    table = _table(path, configuration)
    named = table.participants
    people = read_participants(path.parent / named) if named else None
    together: dict[tuple[str, str, str], list[tuple[str, Path]]] = {}
    for labels, file in _found(path, table):
        key = (labels["subject"], labels["visit"], labels["condition"])
        together.setdefault(key, []).append((labels["trial"], file))
    units, missing = [], dict[str, None]()
    for key in sorted(together, key=lambda item: tuple(map(_natural, item))):
        trials = sorted(together[key], key=lambda item: (_natural(item[0]), str(item[1])))
        files = tuple(file for _, file in trials)
        own = (people or {}).get(key[0], Participant())
        if people is not None and not own.row:
            missing[key[0]] = None
        units.append(Unit(*key, files, own.group, own.values, own.row))
    if missing:
        raise InputError(f"{path}: subject {', '.join(missing)}", f"is not in {named}", "add a row")
    require_distinct([file for unit in units for file in unit.files])
    _require_folders(path, units)
    names = {name for one in units for name in (one.group, one.visit, one.condition) if name}
    if table.reference is not None and table.reference not in names:
        problem = f"{table.reference!a} is no group, visit or condition"
        remedy = f"use one of {', '.join(sorted(names)) or 'none: there are none'}"
        raise InputError(f"{path}: study.reference", problem, remedy)
    return Study(
        table.plant or "", configuration, tuple(units), table.model or "", table.reference or ""
    )


def _table(path: Path, configuration: Configuration) -> StudyTable:
    try:
        table = msgspec.convert(configuration.study, StudyTable)
    except msgspec.ValidationError as error:
        raise InputError(f"{path}: study", str(error), "see docs/ref/settings.md") from None
    for name in table.__struct_fields__:
        value = getattr(table, name)
        if value is not None and (not value.strip() or "\0" in value):
            raise InputError(f"{path}: study.{name}", "is empty", "fill it in, or remove the line")
    return table


def _found(path: Path, table: StudyTable) -> list[Found]:
    """Recordings of the study at `path` with their labels."""
    finders = {"recordings": find_by_pattern, "table": find_by_table, "bids": find_by_entities}
    given = [name for name in finders if getattr(table, name) is not None]
    if len(given) != 1:
        raise InputError(
            f"{path}: study", f"has {', '.join(given) or 'none'} of recordings, table and bids",
            "give exactly one",
        )  # fmt: skip
    where = f"{path}: study.{given[0]}"
    try:
        found = finders[given[0]](where, path.parent / getattr(table, given[0]))
    except OSError as error:
        raise InputError(where, f"cannot be searched ({error.strerror})", "check it") from None
    if not found:
        raise InputError(where, "matches no file", "check the path")
    stems: dict[Path, Path] = {}
    for _, file in found:
        other = stems.setdefault(file.with_suffix(""), file)
        if other != file:
            problem = f"finds {str(other)!a} and {file.name!a}, the same trial in two formats"
            raise InputError(where, problem, "move one of them elsewhere")
    return found


def _natural(text: str) -> tuple[Any, ...]:
    """Sort key that puts 2 before 10."""
    return tuple(
        (0, int(part), "") if part.isdecimal() else (1, 0, part)
        for part in re.findall(r"\d+|\D+", text)
    )


def _require_folders(path: Path, units: Sequence[Unit]) -> None:
    """Raise InputError if two units have the same folder or two subjects the same page."""
    folders = Counter(unit.name.lower() for unit in units)
    pages = Counter(safe_name(name).lower() for name in {unit.subject for unit in units})
    for unit in units:
        if folders[unit.name.lower()] > 1 or pages[safe_name(unit.subject).lower()] > 1:
            raise InputError(
                f"{path}: {unit.name}", "is the folder of two units", "use letters, digits, - and +"
            )


#: Labels of a trial, and their short names in BIDS.
KEYS = {"subject": "sub", "visit": "ses", "condition": "task", "trial": "run"}

#: A recording with its labels, by `KEYS`.
Found = tuple[dict[str, str], Path]


def find_by_pattern(where: str, pattern: Path) -> list[Found]:
    """Files whose paths match a pattern with {subject}, {visit}, {condition} and {trial}."""
    text = pattern.as_posix()
    fixed, names = re.split(r"\{\w+\}", text.removesuffix(".*")), re.findall(r"\{(\w+)\}", text)
    unknown = [name for name in names if name not in KEYS]
    if unknown or "subject" not in names:
        raise InputError(
            where, f"names {', '.join(unknown) or 'no subject'}",
            f"use {', '.join(f'{{{name}}}' for name in KEYS)}",
        )  # fmt: skip
    if re.search(r"[{}\x00-\x1f]|\*\*", "".join(fixed)) or "" in fixed[1:-1]:
        raise InputError(
            where, f"invalid pattern {text[-80:]!a}",
            "write a path with names in {braces} and a separator between two of them",
        )  # fmt: skip
    expression, wild = re.escape(fixed[0]), "*".join(map(glob.escape, fixed))
    for index, name in enumerate(names):
        group = f"(?P={name})" if name in names[:index] else rf"(?P<{name}>[^/\\_]+?)"
        expression += group + re.escape(fixed[index + 1])
    if text.endswith(".*"):
        expression, wild = f"{expression}(?i:{'|'.join(map(re.escape, FORMATS))})", f"{wild}.*"
    files = [Path(name) for name in sorted(glob.glob(wild))]
    matches = ((file, re.fullmatch(expression, file.as_posix())) for file in files)
    return [(_labels(file, match.groupdict()), file) for file, match in matches if match]


def find_by_entities(_where: str, folder: Path) -> list[Found]:
    """Files in a `folder` and below with sub- (and ses-, task-, run-) in their names."""
    found = []
    for file in sorted(folder.rglob("sub-*")):
        hidden = any(part.startswith(".") for part in file.relative_to(folder).parts)
        entities = dict(re.findall(r"(?:^|_)([a-z]+)-([^_.]+)", file.name))
        if not hidden and file.suffix.lower() in FORMATS and file.is_file() and "sub" in entities:
            labels = {key: entities.get(short, "") for key, short in KEYS.items()}
            found.append((_labels(file, labels), file))
    return found


def find_by_table(where: str, path: Path) -> list[Found]:
    """Files and labels from the table at `path` with the columns file, subject and others."""
    rows = read_sheet(path)
    if not all(row.get("file") and row.get("subject") for row in rows):
        raise InputError(where, "has a row without file or subject", "fill both columns")
    return [(_labels(path, row), path.parent / row["file"]) for row in rows]


def _labels(file: Path, given: dict[str, str]) -> dict[str, str]:
    return {key: checked_name(ascii(str(file)), key, given.get(key) or "") for key in KEYS}
