"""Study file (TOML): which recordings belong together, and how they are fitted.

    [study]
    plant = "seated-balance"
    recordings = "data/sub-{subject}/ses-{visit}/sub-{subject}_task-{condition}_run-{trial}.csv"
    participants = "data/participants.tsv"

    [recording] ... [signals.NAME] ... [plant] ... [fit] ...     as for `impc fit`

All trials with the same subject, visit and condition form a unit, which gets one fit.

Names of subjects, visits, conditions, trials and groups become names of files and folders, table
cells and terminal output. Only names that are safe in all of them are accepted: letters, digits,
spaces and . + - _, beginning with a letter or digit.
"""

from __future__ import annotations

import glob
import os
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from impc.errors import InputError
from impc.files.configuration import Configuration, read_configuration
from impc.files.formats import FORMATS
from impc.studies.cohort.participants import Participant, read_participants
from impc.studies.cohort.sheet import checked_name, read_sheet

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

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
    """Read the study at `path` and find its recordings without opening them."""
    configuration = read_configuration(path, "study", "model", "select")
    table = _table(path, configuration)
    named = table.participants
    people = read_participants(path.parent / named) if named else None
    together: dict[tuple[str, str, str], list[tuple[str, Path]]] = {}
    found = _found(path, table)
    _require_once(path, found)
    for labels, file in found:
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
    _require_distinct(path, units)
    _require_reference(path, table.reference, units)
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
    given = [name for name in ("recordings", "table", "bids") if getattr(table, name) is not None]
    if len(given) != 1:
        raise InputError(
            f"{path}: study", f"has {', '.join(given) or 'none'} of recordings, table and bids",
            "give exactly one",
        )  # fmt: skip
    where, written = f"{path}: study.{given[0]}", str(getattr(table, given[0]))
    try:
        if given[0] == "recordings":
            found = find_by_pattern(where, path.parent, written)
        else:
            find = find_by_entities if given[0] == "bids" else find_by_table
            found = find(path.parent / written)
    except OSError as error:
        raise InputError(where, f"cannot be searched ({error.strerror})", "check it") from None
    if not found:
        raise InputError(where, "matches no file", "check the path")
    return found


def _natural(text: str) -> tuple[Any, ...]:
    """Sort key that puts 2 before 10."""
    return tuple(
        (0, int(part), "") if part.isdecimal() else (1, 0, part)
        for part in re.findall(r"\d+|\D+", text)
    )


def _require_once(path: Path, found: Iterable[Found]) -> None:
    """Raise InputError if a file, or a trial in two formats, is found twice."""
    places: dict[str, Path] = {}
    stems: dict[Path, Path] = {}
    for _, file in found:
        other = places.setdefault(os.path.realpath(file), file)
        if other is not file:
            problem = f"names the same file twice, {str(other)!a} and {str(file)!a}"
            raise InputError(f"{path}: study", problem, "name each trial once")
        other = stems.setdefault(file.with_suffix(""), file)
        if other is not file:
            problem = f"finds {str(other)!a} and {file.name!a}, the same trial in two formats"
            raise InputError(f"{path}: study", problem, "move one of them elsewhere")


def _require_distinct(path: Path, units: Iterable[Unit]) -> None:
    """Raise InputError if two units have the same folder or two subjects the same page."""
    seen: dict[str, Unit] = {}
    subjects: dict[str, str] = {}
    for unit in units:
        other = seen.setdefault(unit.name.lower(), unit)
        page = subjects.setdefault(safe_name(unit.subject).lower(), unit.subject)
        if other is not unit or page != unit.subject:
            raise InputError(
                f"{path}: {unit.name}", "is the folder of two units", "use letters, digits, - and +"
            )


def _require_reference(path: Path, reference: str | None, units: Iterable[Unit]) -> None:
    """Raise InputError if no group, visit or condition has the name `reference`."""
    names = {name for one in units for name in (one.group, one.visit, one.condition) if name}
    if reference is not None and reference not in names:
        problem = f"{reference!a} is no group, visit or condition"
        remedy = f"use one of {', '.join(sorted(names)) or 'none: there are none'}"
        raise InputError(f"{path}: study.reference", problem, remedy)


#: Labels of a trial.
KEYS = ("subject", "visit", "condition", "trial")
_ENTITIES = {"subject": "sub", "visit": "ses", "condition": "task", "trial": "run"}
_NAME = r"[^/\\_]+?"

#: A recording with its labels, by `KEYS`.
Found = tuple[dict[str, str], Path]


def find_by_pattern(where: str, folder: Path, pattern: str) -> list[Found]:
    """Files whose paths match a pattern with {subject}, {visit}, {condition} and {trial}."""
    if Path(pattern).is_absolute():
        folder = Path(Path(pattern).anchor)
        pattern = pattern[len(folder.as_posix()) :]
    matching = re.compile(_expression(where, pattern))
    parts = re.split(r"(\{\w+\}|(?<=\.)\*$)", pattern)
    wild = "".join("*" if part[:1] in ("{", "*") else glob.escape(part) for part in parts)
    found = []
    for file in sorted(folder.glob(wild)):
        match = matching.fullmatch(file.relative_to(folder).as_posix())
        if match:
            found.append((_labels(_printable(file), match.groupdict()), file))
    return found


def _expression(where: str, pattern: str) -> str:
    """Regular expression of a pattern."""
    names = re.findall(r"\{(\w+)\}", pattern)
    unknown = [name for name in names if name not in KEYS]
    if unknown or "subject" not in names:
        raise InputError(
            where, f"names {', '.join(unknown) or 'no subject'}",
            f"use {', '.join(f'{{{name}}}' for name in KEYS)}",
        )  # fmt: skip
    rest = re.sub(r"\{\w+\}", "", pattern)
    if re.search(r"[{}\x00-\x1f]", rest) or "**" in pattern:
        raise InputError(
            where, f"invalid pattern {pattern[:80]!a}", "write a path with names in {braces}"
        )
    together = re.search(r"\{\w+\}\{\w+\}", pattern)
    if together:
        raise InputError(
            where, f"has nothing between {together[0]}", "add a separator, or use `table`"
        )
    expression = ""
    for part in re.split(r"(\{\w+\}|\.\*$)", Path(pattern).as_posix()):
        group = f"(?P<{part[1:-1]}>"
        if part == ".*":  # any format
            expression += f"(?i:{'|'.join(map(re.escape, FORMATS))})"
        elif not part.startswith("{"):
            expression += re.escape(part)
        else:
            expression += f"(?P={part[1:-1]})" if group in expression else f"{group}{_NAME})"
    return expression


def find_by_entities(folder: Path) -> list[Found]:
    """Files in a `folder` and below with sub- (and ses-, task-, run-) in their names."""
    found = []
    for file in sorted(folder.rglob("sub-*")):
        hidden = any(part.startswith(".") for part in file.relative_to(folder).parts)
        if hidden or file.suffix.lower() not in FORMATS or not file.is_file():
            continue
        entities = dict(re.findall(r"(?:^|_)([a-z]+)-([^_.]+)", file.name))
        labels = {key: entities.get(short, "") for key, short in _ENTITIES.items()}
        if labels["subject"]:
            found.append((_labels(_printable(file), labels), file))
    return found


def find_by_table(path: Path) -> list[Found]:
    """Files and labels from the table at `path` with the columns file, subject and others."""
    sheet = read_sheet(path)
    if not {"file", "subject"} <= set(sheet.heads):
        raise InputError(sheet.where, "lacks a column", "add the columns file and subject")
    if not all(row["file"] and row["subject"] for row in sheet.rows):
        raise InputError(sheet.where, "has a row without file or subject", "fill every row")
    return [(_labels(sheet.where, row), path.parent / row["file"]) for row in sheet.rows]


def _labels(where: str, given: dict[str, str]) -> dict[str, str]:
    return {key: checked_name(where, key, given.get(key) or "") for key in KEYS}


def _printable(file: Path) -> str:
    """Printable form of a path, whose name may contain control characters or invalid bytes."""
    text = str(file).encode("utf-8", "backslashreplace").decode()
    return text if text.isprintable() else ascii(text)[1:-1]
