"""Tables of recordings or participants of a study: .csv, .tsv, .xlsx or .ods."""

from __future__ import annotations

import csv
import math
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

from impc.errors import InputError
from impc.files.apart import cells_apart

if TYPE_CHECKING:
    from pathlib import Path

# Largest file in bytes; 100 000 participants of 100 characters are 10 MB.
_LARGEST = 100_000_000
_POINT = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
_COMMA = re.compile(r"[+-]?\d+,\d+([eE][+-]?\d+)?")
_THOUSANDS = re.compile(r"[+-]?\d{1,3}(,\d{3})+|[+-]?\d{1,3}(\.\d{3})+")


@dataclass(frozen=True)
class Sheet:
    """The rows of a table."""

    name: str  # Name of its file
    heads: tuple[str, ...]  # Names of the columns
    rows: tuple[dict[str, str], ...]  # Column name -> stripped text

    @property
    def where(self) -> str:
        """Name of the table in messages."""
        return f"table {self.name}"


def read_sheet(path: Path) -> Sheet:
    """Read the table at `path`."""
    where = f"table {path.name}"
    lines = _cells(where, path)
    if len(lines) < 2:
        raise InputError(where, "has no rows", "write a row of column names, then the data")
    heads = tuple(cell.strip() for cell in lines[0])
    for name in heads:
        if not name or heads.count(name) > 1:
            problem = (
                f"has {heads.count(name)} columns {name!a}" if name else "has an unnamed column"
            )
            raise InputError(where, problem, "give each column a unique name")
    for number, line in enumerate(lines[1:], start=2):
        if len(line) != len(heads):
            raise InputError(
                where, f"row {number} has {len(line)} cells, but there are {len(heads)} columns",
                "quote cells with decimal commas, or separate cells by semicolons",
            )  # fmt: skip
    rows = (dict(zip(heads, map(str.strip, line), strict=True)) for line in lines[1:])
    return Sheet(path.name, heads, tuple(rows))


def _cells(where: str, path: Path) -> list[list[str]]:
    """All lines that are not empty."""
    try:
        if path.exists() and not path.is_file():
            raise InputError(where, "is not a regular file", "check the path")
        if path.stat().st_size > _LARGEST:
            raise InputError(where, f"has more than {_LARGEST // 1_000_000} MB", "check the path")
        if path.suffix.lower() in (".xlsx", ".ods"):
            return [row for row in cells_apart(path, _LARGEST) if any(row)]
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is not UTF-8 text"
        raise InputError(where, f"cannot be read ({reason})", "check path and encoding") from None
    if "\0" in text:
        raise InputError(where, "contains a NUL character", "save it again as UTF-8 text")
    first = text.partition("\n")[0]
    delimiter = "\t" if "\t" in first else ";" if ";" in first else ","
    try:
        return [line for line in csv.reader(text.splitlines(), delimiter=delimiter) if any(line)]
    except csv.Error as error:
        raise InputError(where, f"cannot be read ({error})", "save it again as CSV") from None


def column_values(sheet: Sheet, name: str) -> list[float | str | None]:
    """Cells of the column `name`: numbers if all are numbers, else text; None if empty."""
    cells = [row[name] for row in sheet.rows]
    given = [cell for cell in cells if cell not in ("", "n/a")]
    where = f"{sheet.where}: column {name}"
    commas = [cell for cell in given if _COMMA.fullmatch(cell)]
    if not all(_POINT.fullmatch(cell) or _COMMA.fullmatch(cell) for cell in given):
        for cell in given:
            if cell.lower().lstrip("+-") in ("nan", "na", "inf", "infinity"):
                raise InputError(where, f"has {cell!a}", "leave the cell empty, or write n/a")
        return [cell if cell in given else None for cell in cells]
    points = [cell for cell in given if "." in cell]
    if commas and points:
        raise InputError(
            where, f"has {points[0]} and {commas[0]}", "use only decimal points or only commas"
        )
    if commas and all(_THOUSANDS.fullmatch(cell) for cell in commas):
        raise InputError(
            where, f"{commas[0]} may have a thousands separator", "write it with a decimal point"
        )
    numbers = {cell: float(cell.replace(",", ".")) for cell in given}
    for cell, value in numbers.items():
        if not math.isfinite(value):
            raise InputError(where, f"has {cell}", "give a finite number, or n/a")
    return [numbers.get(cell) for cell in cells]
