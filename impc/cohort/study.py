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

import csv
import re
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import msgspec

from impc.errors import InputError
from impc.files.configuration import Configuration, read_configuration

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

__all__ = ["Study", "StudyTable", "Unit", "read_study"]

_KEYS = ("subject", "visit", "condition", "trial")
_ENTITIES = {"subject": "sub", "visit": "ses", "condition": "task", "trial": "run"}
_NAME = r"[^/\\_]+?"
_UNSAFE = re.compile(r"[^A-Za-z0-9.+-]")


class StudyTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The [study] table.

    Attributes
    ----------
    plant, model : str
        As the option of `impc fit`; a model for `impc select`.
    recordings, table, bids : str or None
        Where the recordings are: one of the three.
    participants : str or None
        Table of the subjects.
    """

    plant: str = ""
    model: str = ""
    recordings: str | None = None
    table: str | None = None
    bids: str | None = None
    participants: str | None = None


@dataclass(frozen=True)
class Unit:
    """All trials of one subject, visit and condition.

    Attributes
    ----------
    subject, visit, condition : str
        Empty where the study has none.
    files : tuple of Path
        By trial.
    group : str
        Empty where participants have none.
    arguments : dict
        Of the plant, for this subject.
    """

    subject: str
    visit: str
    condition: str
    files: tuple[Path, ...]
    group: str = ""
    arguments: dict[str, Any] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Name of its folder: sub-01_ses-1_task-EO."""
        parts = (("sub", self.subject), ("ses", self.visit), ("task", self.condition))
        return "_".join(f"{key}-{_UNSAFE.sub('-', value)}" for key, value in parts if value)


@dataclass(frozen=True)
class Study:
    """A study that has been read.

    Attributes
    ----------
    plant, model : str
        Name, import path or file of the plant; import path of the model. Empty when not given.
    configuration : Configuration
        Signals and settings of every fit.
    units : tuple of Unit
        In the order of subject, visit and condition.
    """

    plant: str
    configuration: Configuration
    units: tuple[Unit, ...]
    model: str = ""


def read_study(path: Path) -> Study:
    """Read the study at `path` and find its recordings; none of them is opened.

    Raises
    ------
    InputError
        When the file or a table cannot be used, no recording is found, a recording has no
        participant, or two units would have the same name.
    """
    configuration = read_configuration(path, "study", "model", "select")
    try:
        table = msgspec.convert(configuration.study, StudyTable)
    except msgspec.ValidationError as error:
        raise InputError(f"{path}: study", str(error), "see docs/cohorts.md") from None
    found = _found(path, table)
    participants = _participants(path.parent / table.participants) if table.participants else {}
    together: dict[tuple[str, str, str], list[tuple[str, Path]]] = {}
    for labels, file in found:
        key = (labels["subject"], labels["visit"], labels["condition"])
        together.setdefault(key, []).append((labels["trial"], file))
    units = []
    for key in sorted(together, key=lambda item: tuple(map(_natural, item))):
        trials = sorted(together[key], key=lambda item: (_natural(item[0]), str(item[1])))
        group, arguments = _of_subject(path, table, participants, key[0])
        files = tuple(file for _, file in trials)
        units.append(Unit(*key, files, group, dict(configuration.plant) | arguments))
    _require_distinct(path, units)
    return Study(table.plant, configuration, tuple(units), table.model)


def _found(path: Path, table: StudyTable) -> list[tuple[dict[str, str], Path]]:
    given = [name for name in ("recordings", "table", "bids") if getattr(table, name) is not None]
    if len(given) != 1:
        raise InputError(
            f"{path}: study", f"has {', '.join(given) or 'none'} of recordings, table and bids",
            "give exactly one",
        )  # fmt: skip
    if table.recordings is not None:
        found = _by_pattern(path, table.recordings)
    elif table.bids is not None:
        found = _by_entities(path.parent / table.bids)
    else:
        found = _by_table(path.parent / str(table.table))
    if not found:
        raise InputError(f"{path}: study.{given[0]}", "matches no file", "check the path")
    return found


def _by_pattern(path: Path, pattern: str) -> list[tuple[dict[str, str], Path]]:
    names = re.findall(r"\{(\w+)\}", pattern)
    unknown = [name for name in names if name not in _KEYS]
    if unknown or "subject" not in names:
        raise InputError(
            f"{path}: study.recordings",
            f"names {', '.join(unknown) or 'no subject'}",
            f"use {', '.join(f'{{{name}}}' for name in _KEYS)}",
        )
    folder = path.parent
    expression, seen = "", set()
    for part in re.split(r"(\{\w+\})", pattern):
        name = part[1:-1]
        if part.startswith("{") and name in seen:
            expression += f"(?P={name})"
        elif part.startswith("{"):
            expression += f"(?P<{name}>{_NAME})"
            seen.add(name)
        else:
            expression += re.escape(part)
    matching = re.compile(expression)
    found = []
    for file in sorted(folder.glob(re.sub(r"\{\w+\}", "*", pattern))):
        match = matching.fullmatch(file.relative_to(folder).as_posix())
        if match:
            found.append((dict.fromkeys(_KEYS, "") | match.groupdict(), file))
    return found


def _by_entities(folder: Path) -> list[tuple[dict[str, str], Path]]:
    endings = {".csv", ".tsv", ".txt", ".mat", ".tdms", ".c3d"}
    found = []
    for file in sorted(folder.rglob("sub-*")):
        if file.suffix.lower() not in endings or not file.is_file():
            continue
        entities = dict(re.findall(r"(?:^|_)([a-z]+)-([^_.]+)", file.name))
        labels = {key: entities.get(short, "") for key, short in _ENTITIES.items()}
        if labels["subject"]:
            found.append((labels, file))
    return found


def _by_table(path: Path) -> list[tuple[dict[str, str], Path]]:
    rows = _rows(path)
    if rows and not {"file", "subject"} <= set(rows[0]):
        raise InputError(f"table {path.name}", "lacks a column", "name the columns file, subject")
    return [
        ({key: (row.get(key) or "").strip() for key in _KEYS}, path.parent / row["file"].strip())
        for row in rows
    ]


def _participants(path: Path) -> dict[str, dict[str, str]]:
    found: dict[str, dict[str, str]] = {}
    for row in _rows(path):
        name = (row.get("subject") or row.get("participant_id") or "").strip()
        if not name:
            raise InputError(
                f"table {path.name}", "lacks a subject", "name the column subject, fill every row"
            )
        found[name.removeprefix("sub-")] = {
            key: (value or "").strip()
            for key, value in row.items()
            if key not in ("subject", "participant_id") and key is not None
        }
    return found


def _of_subject(
    path: Path, table: StudyTable, participants: dict[str, dict[str, str]], subject: str
) -> tuple[str, dict[str, Any]]:
    """Group and plant arguments of a subject."""
    if not table.participants:
        return "", {}
    if subject not in participants:
        raise InputError(
            f"{path}: subject {subject}", f"is not in {table.participants}", "add a row"
        )
    row = participants[subject]
    arguments = {
        key: _value(value)
        for key, value in row.items()
        if key != "group" and value not in ("", "n/a")
    }
    return row.get("group", ""), arguments


def _value(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text


def _rows(path: Path) -> list[dict[str, str]]:
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is not UTF-8 text"
        raise InputError(f"table {path.name}", f"cannot be read ({reason})", "check it") from None
    first = text.partition("\n")[0]
    delimiter = "\t" if "\t" in first else ";" if ";" in first and "," not in first else ","
    return list(csv.DictReader(text.splitlines(), delimiter=delimiter))


def _natural(text: str) -> tuple[Any, ...]:
    """2 before 10."""
    return tuple(
        (0, int(part), "") if part.isdigit() else (1, 0, part)
        for part in re.findall(r"\d+|\D+", text)
    )


def _require_distinct(path: Path, units: Iterable[Unit]) -> None:
    seen: dict[str, Unit] = {}
    for unit in units:
        other = seen.setdefault(unit.name.lower(), unit)
        if other is not unit:
            raise InputError(
                f"{path}: {unit.name}", "is the name of two units", "use letters, digits, - and +"
            )
