"""Table of participants: its columns in the words of laboratories, in SI units.

All faults of the table are found before any fit, and one message lists them with row and column.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from impc.errors import InputError
from impc.files.layout import split_heading
from impc.files.units import si_unit
from impc.studies.cohort.sheet import checked_name, read_sheet

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

# Name of a column -> other names, as `_bare` writes them.
_COLUMNS = {
    "subject": "participant_id participant proband probandin vp id",
    "group": "gruppe",
    "mass": "masse gewicht weight body_mass koerpermasse koerpergewicht",
    "height": "groesse koerpergroesse body_height stature",
    "sex": "geschlecht gender",
    "age": "alter",
}
_NAMES = {other: name for name, others in _COLUMNS.items() for other in (name, *others.split())}
# Columns that must be numbers of this SI unit, and units that the reader of units finds ambiguous.
_UNITS = {"mass": "kilogram", "height": "meter"}
_GIVE = {"mass": "kg", "height": "m"}
_PLAIN_UNITS = {"g": "gram"}
_SEXES = {
    **dict.fromkeys(("m", "male", "man", "mann", "maennlich"), "male"),
    **dict.fromkeys(("w", "f", "female", "woman", "frau", "weiblich"), "female"),
}
_POINT = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
_COMMA = re.compile(r"[+-]?\d+,\d+([eE][+-]?\d+)?")
_THOUSANDS = re.compile(r"[+-]?\d{1,3}(,\d{3})+|[+-]?\d{1,3}(\.\d{3})+")
_NO_NUMBERS = ("nan", "na", "inf", "infinity")
_EMPTY = ("", "n/a")
_LISTED = 8  # Largest number of faults in a message


@dataclass(frozen=True)
class Participant:
    """A row of the table."""

    row: int = 0  # The column names are row 1
    group: str = ""
    values: Mapping[str, float | str] = field(default_factory=dict)  # Other columns, if not empty


def read_participants(path: Path) -> dict[str, Participant]:
    """Rows of the table at `path` by subject."""
    sheet, faults = read_sheet(path), list[str]()
    columns: dict[str, tuple[str, float]] = {}  # Name -> heading and factor to SI units
    for head in sheet.heads:
        name, factor = _column(head, sheet.heads, faults)
        if name in columns:
            faults.append(f"columns {columns[name][0]!a} and {head!a} are both {name}: remove one")
        columns[name] = head, factor
    cells = {name: [row[head] for row in sheet.rows] for name, (head, _) in columns.items()}
    none = [""] * len(sheet.rows)
    subjects = [
        _name(row, "subject", text.removeprefix("sub-"), faults)
        for row, text in enumerate(cells.pop("subject", none), start=2)
    ]
    groups = [
        _name(row, "group", text, faults)
        for row, text in enumerate(cells.pop("group", none), start=2)
    ]
    values = {
        name: _values(name, columns[name][1], column, faults) for name, column in cells.items()
    }
    found: dict[str, Participant] = {}
    for index, (subject, group) in enumerate(zip(subjects, groups, strict=True)):
        if subject in found:
            faults.append(f"row {index + 2}: two rows of subject {subject}, remove one")
        own = {name: one for name, column in values.items() if (one := column[index]) is not None}
        found[subject] = Participant(index + 2, group, own)
    require_faultless(sheet.where, faults)
    return found


def require_faultless(where: str, faults: Sequence[str]) -> None:
    """Raise one InputError that lists all `faults`; none pass."""
    if faults:
        more = f"; and {len(faults) - _LISTED} more" if len(faults) > _LISTED else ""
        problem = f"{'; '.join(faults[:_LISTED])}{more}"
        raise InputError(where, problem, "correct the table; nothing was fitted")


def _bare(text: str) -> str:
    """Lower-case `text` without umlauts and signs: "Größe" is groesse."""
    plain = text.casefold()
    for umlaut, letters in (("ä", "ae"), ("ö", "oe"), ("ü", "ue")):
        plain = plain.replace(umlaut, letters)
    return re.sub(r"\W+", "_", plain).strip("_")


def _column(head: str, heads: Sequence[str], faults: list[str]) -> tuple[str, float]:
    """Name of a column, and the factor of its cells to SI units: "Masse (g)" is mass, 0.001."""
    text = re.sub(r"\W*[(\[][^()\[\]]*[)\]]$", "", head)
    unit = head[len(text) :].strip(" ([])")
    joined = re.fullmatch(r"(.+)_(kg|g|cm|mm|m)", _bare(head))
    if joined and joined[1] in _NAMES:
        text, unit = joined[1], joined[2]
    name = _NAMES.get(_bare(text), head)
    if name != head and name in heads:
        return head, 1.0
    if name not in _UNITS:
        plain, unit = split_heading(head)
        return (name, 1.0) if name != head or not unit else (plain, _factor(unit, "") or 1.0)
    factor = _factor(_PLAIN_UNITS.get(unit, unit), _UNITS[name]) if unit else 1.0
    if factor is None:
        faults.append(f"column {head!a}: {unit} is no unit of {name}, use {_GIVE[name]}")
    return name, factor or 1.0


def _factor(unit: str, base: str) -> float | None:
    """Factor to SI units; None for another unit than `base`, or one that is not known."""
    try:
        found = si_unit(unit)
    except InputError:
        return None
    return found.factor if base in ("", found.base) else None


def _name(row: int, what: str, text: str, faults: list[str]) -> str:
    """A name of a subject or group, checked."""
    try:
        name = checked_name("", what, text)
    except InputError as error:
        faults.append(f"row {row}, {what}: {error.problem}, {error.remedy}")
        return text
    if what == "subject" and not name:
        faults.append(
            f"row {row}: has a row without subject, name the column subject, fill every row"
        )
    return name


def _values(
    name: str, factor: float, column: Sequence[str], faults: list[str]
) -> list[float | str | None]:
    """Cells of a column in SI units: numbers, or texts if one is no number; None if empty."""
    given = {row: cell for row, cell in enumerate(column, start=2) if cell not in _EMPTY}
    wrong = {row: "leave the cell empty, or write n/a" for row, cell in given.items()
             if cell.lower().lstrip("+-") in _NO_NUMBERS}  # fmt: skip
    rest = {row: cell for row, cell in given.items() if row not in wrong}
    commas = {row: cell for row, cell in rest.items() if _COMMA.fullmatch(cell)}
    texts = [row for row in rest if row not in commas and not _POINT.fullmatch(rest[row])]
    numeric = name in _UNITS or not texts
    numbers = {row: float(cell.replace(",", ".")) for row, cell in rest.items() if row not in texts}
    if numeric:
        wrong |= dict.fromkeys(texts, f"write a number in {_GIVE.get(name)}")
        wrong |= {row: "give a finite number, or n/a"
                  for row, value in numbers.items() if not math.isfinite(value)}  # fmt: skip
        if commas and all(map(_THOUSANDS.fullmatch, commas.values())):
            why = "may have a thousands separator, write it with a decimal point"
            wrong |= dict.fromkeys(commas, why)
        elif any("." in cell for cell in rest.values()):
            wrong |= dict.fromkeys(commas, "use only decimal points or only commas")
    faults += [f"row {row}, {name}: {given[row]!a}, {why}" for row, why in wrong.items()]
    known = _SEXES if name == "sex" else {}

    def value(row: int) -> float | str | None:
        if row in wrong or row not in given:
            return None
        return factor * numbers[row] if numeric else known.get(_bare(given[row]), given[row])

    return [value(row) for row in range(2, len(column) + 2)]
