"""Workbooks of Excel (.xlsx) and LibreOffice (.ods), by python-calamine (the extra `excel`).

The first sheet with rows of numbers that is not hidden is the recording; the others are named.
Above the numbers stand the headings and, if there is one, a row of units, as in delimited text. Of
a formula the value counts that was saved with it.
"""

from __future__ import annotations

import datetime
import zipfile
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from impc.errors import DataError
from impc.extras import optional
from impc.files.delimited import is_number
from impc.files.headings import are_units, named_columns
from impc.files.table import make_table
from impc.files.thousands import require_no_thousands

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from impc.arrays import Array
    from impc.files.table import Table

__all__ = ["read_cells", "read_spreadsheet"]

_HEAD = 100  # rows in which the first row of numbers must stand
_DAY = 86_400.0
_TIMES = (datetime.datetime, datetime.date, datetime.time, datetime.timedelta)


def read_spreadsheet(path: Path, largest: int) -> Table:
    """Read the columns of the first sheet that has rows of numbers.

    Dates and times become seconds after the first. Numbers that were saved as text, with decimal
    commas too, are numbers.

    Parameters
    ----------
    path : Path
        Of the file.
    largest : int
        The most bytes that it may unpack to, and its arrays take.

    Raises
    ------
    DataError
        When it is damaged, locked by a password, or no sheet has rows of numbers.
    ImpcError
        When python-calamine is not installed.
    """
    source = str(path)
    sheets = list(_sheets(path, largest))
    for index, sheet in enumerate(sheets):
        first = _first_numbers(sheet.rows[:_HEAD])
        if first is not None:
            others = sheets[:index] + sheets[index + 1 :]
            skipped = {f"sheet {other.name}": "is another sheet" for other in others}
            return _table(source, sheet, first, skipped)
    problem = f"has no rows of numbers in the first {_HEAD} rows of a sheet"
    raise DataError(source, problem, "save one signal a column, its name above it")


def read_cells(path: Path, largest: int) -> dict[str, Any]:
    """The cells of the first sheet as texts, a row in each list.

    Parameters
    ----------
    path : Path
        Of the file.
    largest : int
        The most bytes that it may unpack to.

    Raises
    ------
    DataError
        As of `read_spreadsheet`.
    ImpcError
        When python-calamine is not installed.
    """
    sheet = next(_sheets(path, largest), None)
    return {"cells": [[_text(cell) for cell in row] for row in sheet.rows] if sheet else []}


@dataclass(frozen=True)
class _Sheet:
    """The cells of a sheet from its first one that is not empty, `corner` (row, column)."""

    name: str
    rows: list[list[Any]]
    corner: tuple[int, int]

    def cell(self, row: int, column: int) -> str:
        """How a spreadsheet calls a cell: B7."""
        letters, number = "", column + self.corner[1] + 1
        while number:
            number, letter = divmod(number - 1, 26)
            letters = chr(ord("A") + letter) + letters
        return f"{letters}{row + self.corner[0] + 1}"


def _sheets(path: Path, largest: int) -> Iterator[_Sheet]:
    """The sheets that are not hidden, one after the other."""
    source = str(path)
    calamine = optional("python_calamine", source)
    with zipfile.ZipFile(path) as archive:
        unpacked = sum(item.file_size for item in archive.infolist())
    if unpacked > largest:
        problem = f"is too large once it is unpacked ({unpacked / 1e9:.1f} GB)"
        raise DataError(source, problem, "save only the signals that are needed")
    try:
        with calamine.CalamineWorkbook.from_path(source) as book:
            for place, found in enumerate(book.sheets_metadata):
                if found.visible == calamine.SheetVisibleEnum.Visible:
                    sheet = book.get_sheet_by_index(place)
                    yield _Sheet(found.name, sheet.to_python(), sheet.start or (0, 0))
    except calamine.PasswordError:
        raise DataError(source, "is locked by a password", "save it without one") from None


def _first_numbers(rows: Sequence[Sequence[Any]]) -> int | None:
    """The first row in which more than half of the columns that have numbers have one."""
    counts = [sum(_is_value(cell) for cell in row) for row in rows]
    most = max(counts, default=0)
    return next((place for place, count in enumerate(counts) if 0 < most < 2 * count), None)


def _is_value(cell: Any) -> bool:
    """Whether a cell is a number or a time, saved as such or as text."""
    if isinstance(cell, str):
        return any(is_number(cell.strip(), mark) for mark in ".,")
    return not isinstance(cell, bool)


def _table(source: str, sheet: _Sheet, first: int, skipped: dict[str, str]) -> Table:
    above = [[_text(cell) for cell in row] for row in sheet.rows[:first] if any(map(_text, row))]
    columns: dict[str, Array] = {}
    width = len(sheet.rows[first])
    units, heads = [""] * width, [""] * width
    if len(above) > 1 and are_units(above[-1]):
        units = above.pop()
    if above:
        heads = above[-1]
    names, told = named_columns(source, heads, units)
    for index, name in enumerate(names):
        cells = [row[index] for row in sheet.rows[first:]]
        if all(cell == "" for cell in cells):
            if name:
                skipped[name] = "is empty"
            continue
        found = _column(source, sheet, (first, index), name, cells)
        if isinstance(found, str):
            skipped[name or f"column_{index + 1}"] = found
            continue
        columns[name or f"column_{index + 1}"] = found
        if isinstance(cells[0], _TIMES):
            told[name] = "s"
    return make_table(source, columns, told, None, skipped)


def _column(
    source: str, sheet: _Sheet, corner: tuple[int, int], name: str, cells: Sequence[Any]
) -> Array | str:
    """The numbers below a cell, or why there are none."""
    given = [cell for cell in cells if cell != ""]
    if all(isinstance(cell, bool) for cell in given):
        return "holds true and false"
    texts = [cell.strip() for cell in given if isinstance(cell, str)]
    mark = "," if any("," in text for text in texts) else "."
    values = [_value(cell, mark) for cell in cells]
    wrong = [place for place, value in enumerate(values) if value is None]
    where = sheet.cell(corner[0] + (wrong or [0])[0], corner[1])
    if len(wrong) == len(given):
        return f"is text, such as {str(given[0])[:20]!r} in cell {where}"
    if wrong:
        problem = (
            f"column {name!r} has text in {len(wrong)} of {len(cells)} rows, the first "
            f"{str(cells[wrong[0]])[:20]!r} in cell {where}"
        )
        remedy = "correct those cells or save the column as numbers, without thousands separators"
        raise DataError(source, problem, remedy)
    lines = ((corner[0] + row + 1, [cell]) for row, cell in enumerate(map(str, cells)))
    if texts:
        require_no_thousands(source, {0: name}, lines, mark)
    kinds = {_kind(cell) for cell in given}
    if len(kinds) > 1:
        problem = f"column {name!r} has {' and '.join(sorted(kinds))}"
        raise DataError(source, problem, "save it as numbers, all of one kind")
    numbers = np.array(values, dtype=np.float64)
    return numbers if kinds == {"numbers"} else numbers - numbers[0]


def _kind(cell: Any) -> str:
    if isinstance(cell, datetime.time | datetime.timedelta):
        return "times of the day"
    return "dates" if isinstance(cell, datetime.date) else "numbers"


def _value(cell: Any, mark: str) -> float | None:
    """The number of a cell, NaN where it is empty, times in s; None of a word."""
    if isinstance(cell, str):
        return _typed(cell.strip(), mark)
    if isinstance(cell, bool):
        return None
    return _seconds(cell) if isinstance(cell, _TIMES) else float(cell)


def _typed(text: str, mark: str) -> float | None:
    if not text:
        return np.nan
    if not is_number(text, mark):
        return None
    return np.nan if text.upper() in ("NA", "N/A", "NULL") else float(text.replace(",", "."))


def _seconds(
    time: datetime.datetime | datetime.date | datetime.time | datetime.timedelta,
) -> float:
    """Since a moment that is the same for all of a kind."""
    if isinstance(time, datetime.timedelta):
        return time.total_seconds()
    if isinstance(time, datetime.time):
        return time.hour * 3600 + time.minute * 60 + time.second + time.microsecond / 1e6
    if isinstance(time, datetime.datetime):
        return time.replace(tzinfo=datetime.UTC).timestamp()
    return _DAY * (time.toordinal() - datetime.date(1970, 1, 1).toordinal())


def _text(cell: Any) -> str:
    """A cell as it would be typed: a whole number without a point."""
    if isinstance(cell, float) and cell.is_integer() and abs(cell) < 1e15:
        return str(int(cell))
    return str(cell).strip()
