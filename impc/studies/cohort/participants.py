"""Tables of a study: participants in the words of laboratories, in SI units, and recordings.

They are .csv, .tsv, .xlsx or .ods. All faults of the participants are found before any fit, and one
message lists them with row and column.
"""

from __future__ import annotations

import csv
import math
import re
import unicodedata
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from impc.errors import InputError
from impc.files.apart import cells_apart
from impc.files.disk import require_readable
from impc.files.layout import split_heading
from impc.files.units import si_unit

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
# Columns that must be numbers, and their units.
_UNITS = {"mass": "kg", "height": "m"}
_SEXES = {
    **dict.fromkeys(("m", "male", "man", "mann", "maennlich"), "male"),
    **dict.fromkeys(("w", "f", "female", "woman", "frau", "weiblich"), "female"),
}
_UMLAUTS = str.maketrans({"ä": "ae", "ö": "oe", "ü": "ue"})
_NUMBER = re.compile(r"[+-]?(\d+[.,]?\d*|[.,]\d+)([eE][+-]?\d+)?")
_THOUSANDS = re.compile(r"[+-]?\d{1,3}(,\d{3})+")
_LISTED = 8  # Largest number of faults in a message


@dataclass(frozen=True)
class Participant:
    """A row of the table."""

    row: int = 0  # The column names are row 1
    group: str = ""
    values: Mapping[str, float | str] = field(default_factory=dict)  # Other columns, if not empty


def read_participants(path: Path) -> dict[str, Participant]:
    """Rows of the table at `path` by subject."""
    rows, faults = read_sheet(path), list[str]()
    columns: dict[str, list[float | str | None]] = {}
    for head in rows[0]:
        name, factor = _column(head, faults)
        if name in columns:
            faults.append(f"two columns are {name}, one of them {head!a}: remove one")
        cells = [row[head] for row in rows]
        if name in ("subject", "group"):
            columns[name] = [*(_name(row, name, cell, faults) for row, cell in enumerate(cells, 2))]
        else:
            columns[name] = _values(name, factor, cells, faults)
    subjects = columns.pop("subject", [""] * len(rows))
    groups = columns.pop("group", [""] * len(rows))
    found: dict[str, Participant] = {}
    for index, (subject, group) in enumerate(zip(subjects, groups, strict=True)):
        if not subject:
            faults.append(f"row {index + 2}: has no subject, fill the column subject")
        elif subject in found:
            faults.append(f"row {index + 2}: two rows of subject {subject}, remove one")
        own = {name: one for name, column in columns.items() if (one := column[index]) is not None}
        found[str(subject)] = Participant(index + 2, str(group), own)
    require_faultless(f"table {path.name}", faults)
    return found


def require_faultless(where: str, faults: Sequence[str]) -> None:
    """Raise one InputError that lists all `faults`; none pass."""
    if faults:
        more = f"; and {len(faults) - _LISTED} more" if len(faults) > _LISTED else ""
        problem = f"{'; '.join(faults[:_LISTED])}{more}"
        raise InputError(where, problem, "correct the table; nothing was fitted")


def _bare(text: str) -> str:
    """Lower-case `text` without umlauts and signs: "Größe" is groesse."""
    return re.sub(r"\W+", "_", text.casefold().translate(_UMLAUTS)).strip("_")


def _column(head: str, faults: list[str]) -> tuple[str, float]:
    """Name of a column, and the factor of its cells to SI units: "Masse (g)" is mass, 0.001."""
    split = re.fullmatch(r"(.+?)\W*[(\[](.*)[)\]]|(.+?)[\W_]+(kg|g|cm|mm|m)", head)
    text, unit = [part for part in split.groups() if part is not None] if split else (head, "")
    name = _NAMES.get(_bare(text))
    if name is None:
        name, unit = split_heading(head)
        return name, _si_factor(unit)[0]
    if name not in _UNITS or not unit:
        return name, 1.0
    factor, base = _si_factor("gram" if unit == "g" else unit)
    if base != _si_factor(_UNITS[name])[1]:
        faults.append(f"column {head!a}: {unit} is no unit of {name}, use {_UNITS[name]}")
    return name, factor


def _si_factor(unit: str) -> tuple[float, str]:
    """Factor to SI units and the base unit, which is empty for a unit that is not known."""
    try:
        found = si_unit(unit)
    except InputError:
        return 1.0, ""
    return found.factor, found.base


def _name(row: int, what: str, text: str, faults: list[str]) -> str:
    """A name of a subject or group, checked."""
    try:
        return checked_name("", what, text.removeprefix("sub-") if what == "subject" else text)
    except InputError as error:
        faults.append(f"row {row}, {what}: {error.problem}, {error.remedy}")
        return text


def _values(
    name: str, factor: float, column: Sequence[str], faults: list[str]
) -> list[float | str | None]:
    """Cells of a column in SI units: numbers, or texts if one is no number; None if empty."""
    given = {row: cell for row, cell in enumerate(column, 2) if cell not in ("", "n/a")}
    numbers = {row: _number(cell) for row, cell in given.items()}
    commas = [row for row, cell in given.items() if "," in cell]
    known = _SEXES if name == "sex" else {}
    wrong: dict[int, str] = {}
    found: dict[int, float | str]
    if name not in _UNITS and None in numbers.values():
        found = {row: known.get(_bare(cell), cell) for row, cell in given.items()}
    else:
        found = {row: factor * one for row, one in numbers.items() if one is not None}
        if any("." in cell for cell in given.values()) or all(
            _THOUSANDS.fullmatch(given[row]) for row in commas
        ):
            wrong = dict.fromkeys(commas, "write it with a decimal point, as all of the column")
        wrong |= {
            row: f"write a number in {_UNITS[name]}, or n/a" for row in given if row not in found
        }
    faults += [f"row {row}, {name}: {given[row]!a}, {why}" for row, why in wrong.items()]
    return [found.get(row) for row in range(2, len(column) + 2)]


def _number(cell: str) -> float | None:
    """A finite number with a decimal point or comma; None for another text."""
    value = float(cell.replace(",", ".")) if _NUMBER.fullmatch(cell) else math.inf
    return value if math.isfinite(value) else None


# Largest file in bytes; 100 000 participants of 100 characters are 10 MB.
_LARGEST = 100_000_000
_NAME = re.compile(r"([^\W_][\w .+-]{0,63})?")


def read_sheet(path: Path) -> list[dict[str, str]]:
    """Rows of the table at `path`: name of a column -> stripped text."""
    where = f"table {path.name}"
    lines = [[cell.strip() for cell in line] for line in _cells(path) if any(line)]
    if len(lines) < 2:
        raise InputError(where, "has no rows", "write a row of column names, then the data")
    heads = lines[0]
    if "" in heads or len({*heads}) < len(heads):
        twice = next((name for name in heads if heads.count(name) > 1), "")
        problem = f"has two columns {twice!a}" if twice else "has an unnamed column"
        raise InputError(where, problem, "give each column a unique name")
    for number, line in enumerate(lines[1:], start=2):
        if len(line) != len(heads):
            raise InputError(
                where, f"row {number} has {len(line)} cells, but there are {len(heads)} columns",
                "quote cells with decimal commas, or separate cells by semicolons",
            )  # fmt: skip
    return [dict(zip(heads, line, strict=True)) for line in lines[1:]]


def _cells(path: Path) -> list[list[str]]:
    require_readable(path, _LARGEST, InputError)
    if path.suffix.lower() in (".xlsx", ".ods"):
        return cells_apart(path, _LARGEST)
    try:
        content = path.read_bytes()
        try:
            text = content.decode("utf-8-sig")
        except UnicodeDecodeError:  # as a German Excel writes it
            text = content.decode("cp1252", "replace")
        first = text.partition("\n")[0]
        delimiter = "\t" if "\t" in first else ";" if ";" in first else ","
        return [*csv.reader(text.splitlines(), delimiter=delimiter)]
    except (OSError, csv.Error) as error:
        raise InputError(str(path), f"cannot be read ({error})", "save it again as CSV") from None


def checked_name(where: str, what: str, text: str) -> str:
    """Strip and normalise (NFC) a name; InputError if it is not safe."""
    name = unicodedata.normalize("NFC", text.strip())
    if not _NAME.fullmatch(name):
        raise InputError(
            f"{where}: {what}", f"{name[:70]!a} is no name",
            "use at most 64 letters, digits, spaces and . + - _, beginning with a letter or digit",
        )  # fmt: skip
    return name
