"""A study: which recordings belong together, and how they are fitted. One TOML file.

    [study]
    plant = "seated-balance"
    recordings = "data/sub-{subject}/ses-{visit}/sub-{subject}_task-{condition}_run-{trial}.csv"
    participants = "data/participants.tsv"

    [recording] ... [signals.NAME] ... [plant] ... [fit] ...     as for `impc fit`

`recordings` is a pattern relative to the file; instead of it, `table` names a table with the
columns file, subject, visit, condition, trial, and `bids` a folder whose file names say sub-,
ses-, task- and run- as BIDS has them. `participants` is a table with a column subject (or
participant_id, as in BIDS); a column group tells the groups; other columns that are arguments of
the plant (mass, height) replace those of [plant] for that subject. All trials with the same
subject, visit and condition make a unit: one fit.
"""

from __future__ import annotations

import os
import re
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import msgspec

from impc.errors import InputError
from impc.files.configuration import Configuration, read_configuration
from impc.studies.cohort.finding import find_by_entities, find_by_pattern, find_by_table
from impc.studies.cohort.names import checked_name
from impc.studies.cohort.sheet import column_values, read_sheet

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from pathlib import Path

    from impc.studies.cohort.finding import Found

__all__ = ["Study", "StudyTable", "Unit", "read_study", "safe_name"]

_UNSAFE = re.compile(r"[^A-Za-z0-9.+-]")


class StudyTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The [study] table."""

    plant: str | None = None  # As the option of `impc fit`; a model for `impc select`
    model: str | None = None
    recordings: str | None = None  # Where the recordings are: one of the three
    table: str | None = None
    bids: str | None = None
    participants: str | None = None  # Table of the subjects


@dataclass(frozen=True)
class Unit:
    """All trials of one subject, visit and condition."""

    subject: str  # Empty where the study has none
    visit: str
    condition: str
    files: tuple[Path, ...]  # By trial
    group: str = ""  # Empty where participants have none
    # Other columns of the participants, for this subject
    person: Mapping[str, float | str] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Name of its folder: sub-01_ses-1_task-EO."""
        parts = (("sub", self.subject), ("ses", self.visit), ("task", self.condition))
        return "_".join(f"{key}-{safe_name(value)}" for key, value in parts if value)


def safe_name(name: str) -> str:
    """A checked `name` as a part of a file's name."""
    return _UNSAFE.sub("-", name)


@dataclass(frozen=True)
class Study:
    """A study that has been read."""

    # Name, import path or file of the plant; import path of the model. Empty when not given.
    plant: str
    configuration: Configuration  # Signals and settings of every fit
    units: tuple[Unit, ...]  # In the order of subject, visit and condition
    model: str = ""


def read_study(path: Path) -> Study:
    """Read the study at `path` and find its recordings; none of them is opened."""
    configuration = read_configuration(path, "study", "model", "select")
    table = _table(path, configuration)
    people = _people(path.parent / table.participants) if table.participants else None
    together: dict[tuple[str, str, str], list[tuple[str, Path]]] = {}
    found = _found(path, table)
    _require_once(path, found)
    for labels, file in found:
        key = (labels["subject"], labels["visit"], labels["condition"])
        together.setdefault(key, []).append((labels["trial"], file))
    units = []
    for key in sorted(together, key=lambda item: tuple(map(_natural, item))):
        trials = sorted(together[key], key=lambda item: (_natural(item[0]), str(item[1])))
        files = tuple(file for _, file in trials)
        if people is None:
            units.append(Unit(*key, files))
        elif key[0] in people:
            units.append(Unit(*key, files, *people[key[0]]))
        else:
            raise InputError(
                f"{path}: subject {key[0]}", f"is not in {table.participants}", "add a row"
            )
    _require_distinct(path, units)
    return Study(table.plant or "", configuration, tuple(units), table.model or "")


def _table(path: Path, configuration: Configuration) -> StudyTable:
    try:
        table = msgspec.convert(configuration.study, StudyTable)
    except msgspec.ValidationError as error:
        raise InputError(f"{path}: study", str(error), "see docs/cohorts.md") from None
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
    where = f"{path}: study.{given[0]}"
    try:
        if table.recordings is not None:
            found = find_by_pattern(where, path.parent, table.recordings)
        elif table.bids is not None:
            found = find_by_entities(path.parent / table.bids)
        else:
            found = find_by_table(path.parent / str(table.table))
    except OSError as error:
        raise InputError(where, f"cannot be looked for ({error.strerror})", "check it") from None
    if not found:
        raise InputError(where, "matches no file", "check the path")
    return found


def _people(path: Path) -> dict[str, tuple[str, dict[str, float | str]]]:
    """Subject -> group and the other columns."""
    sheet = read_sheet(path)
    named = [name for name in ("subject", "participant_id") if name in sheet.heads]
    if not named:
        raise InputError(sheet.where, "lacks a subject", "name the column subject, fill every row")
    others = [name for name in sheet.heads if name not in (*named, "group")]
    values = {name: column_values(sheet, name) for name in others}
    found: dict[str, tuple[str, dict[str, float | str]]] = {}
    for number, row in enumerate(sheet.rows):
        text = next((row[name] for name in named if row[name]), "")
        subject = checked_name(sheet.where, "subject", text.removeprefix("sub-"))
        if not subject:
            raise InputError(
                sheet.where, "lacks a subject", "name the column subject, fill every row"
            )
        if subject in found:
            raise InputError(sheet.where, f"has two rows of subject {subject}", "keep one")
        person = {name: value for name in others if (value := values[name][number]) is not None}
        found[subject] = checked_name(sheet.where, "group", row.get("group", "")), person
    return found


def _natural(text: str) -> tuple[Any, ...]:
    """2 before 10."""
    return tuple(
        (0, int(part), "") if part.isdecimal() else (1, 0, part)
        for part in re.findall(r"\d+|\D+", text)
    )


def _require_once(path: Path, found: Iterable[Found]) -> None:
    """No file twice, by whatever name, and no trial in two formats."""
    places: dict[str, Path] = {}
    stems: dict[Path, Path] = {}
    for _, file in found:
        other = places.setdefault(os.path.realpath(file), file)
        if other is not file:
            problem = f"names the same file twice, {str(other)!a} and {str(file)!a}"
            raise InputError(f"{path}: study", problem, "a trial counts once")
        other = stems.setdefault(file.with_suffix(""), file)
        if other is not file:
            problem = f"finds {str(other)!a} and {file.name!a}, the same trial in two formats"
            raise InputError(f"{path}: study", problem, "move one of them elsewhere")


def _require_distinct(path: Path, units: Iterable[Unit]) -> None:
    """No two units in one folder, no two subjects on one page; capitals make no difference."""
    seen: dict[str, Unit] = {}
    subjects: dict[str, str] = {}
    for unit in units:
        other = seen.setdefault(unit.name.lower(), unit)
        page = subjects.setdefault(safe_name(unit.subject).lower(), unit.subject)
        if other is not unit or page != unit.subject:
            raise InputError(
                f"{path}: {unit.name}", "is the name of two units", "use letters, digits, - and +"
            )
