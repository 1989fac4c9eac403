"""Workbooks of Excel (.xlsx) and LibreOffice (.ods), read with python-calamine (extra `excel`).

The recording is the requested sheet, else the first visible one with a block of numbers; the other
sheets are listed as skipped. Rows above and below the block are treated as in delimited text. For a
formula the saved value counts. Workbooks are written with openpyxl.
"""

from __future__ import annotations

import datetime
import io
import re
import zipfile
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from impc.errors import DataError, one_line
from impc.extras import optional
from impc.files.delimited import is_number, text_cell
from impc.files.layout import (
    EMPTY,
    HEAD,
    NUMBER,
    WORD,
    Block,
    find_headings,
    first_block,
    require_no_thousands,
    written_heading,
)
from impc.files.table import OTHER_SHEET, make_table

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from pathlib import Path

    import pandas as pd

    from impc.arrays import Array
    from impc.files.table import Table

_DAY = 86_400.0
_LONGEST_NAME = 31  # characters of a sheet name
_ANY_LENGTH = 32_767  # characters of a cell
_WIDEST, _LOOKED_AT = 100, 200  # column width in characters; rows that determine it
_NUMBER = re.compile(r"[+-]?\d+(\.\d*)?")
_TIMES = (datetime.datetime, datetime.date, datetime.time, datetime.timedelta)


def read_spreadsheet(path: Path, largest: int, sheet: str = "") -> Table:
    """Read `sheet`, or the first sheet that has a block of numbers.

    Dates and times become seconds after the first. Numbers saved as text count, with decimal
    commas too. The file may unpack to `largest` bytes.
    """
    source = str(path)
    sheets = list(_sheets(path, largest))
    if sheet and sheet not in [item.name for item in sheets]:
        named = ", ".join(item.name for item in sheets[:12])
        remedy = f"set recording.sheet to {named}"
        raise DataError(source, f"has no sheet {sheet!r}", remedy).at("", "recording", "sheet")
    found = [
        (item, block)
        for item in sheets
        if (not sheet or item.name == sheet) and (block := _block(item)) is not None
    ]
    if not found:
        problem = f"has no rows of numbers in the first {HEAD} rows of a sheet"
        raise DataError(source, problem, "save one signal per column, its name above it")
    full = [item for item in found if item[1].several]
    chosen, block = (full or found)[0]
    skipped = {f"sheet {item.name}": OTHER_SHEET for item in sheets if item is not chosen}
    notes = (f"sheet {chosen.name!r} is read; other sheets have rows of numbers too",)
    return _table(source, chosen, block, skipped, notes if len(full) > 1 else ())


def _block(sheet: _Sheet) -> Block | None:
    return first_block([_kinds(row) for row in sheet.rows[: 3 * HEAD]], alone=True)


def _kinds(row: Sequence[Any]) -> list[int]:
    return [_kind_of(cell) for cell in row]


def _kind_of(cell: Any) -> int:
    if isinstance(cell, str):
        text = cell.strip()
        return (NUMBER if any(is_number(text, mark) for mark in ".,") else WORD) if text else EMPTY
    return WORD if isinstance(cell, bool) else NUMBER


def read_cells(path: Path, largest: int) -> dict[str, Any]:
    """Cells of the first sheet as texts, row by row; it may unpack to `largest` bytes."""
    sheet = next(_sheets(path, largest), None)
    return {"cells": [[_text(cell) for cell in row] for row in sheet.rows] if sheet else []}


@dataclass(frozen=True)
class _Sheet:
    """Cells of a sheet from `corner` (row, column), the first that is not empty."""

    name: str
    rows: list[list[Any]]
    corner: tuple[int, int]

    def cell(self, row: int, column: int) -> str:
        """Spreadsheet name of a cell, such as B7."""
        letters, number = "", column + self.corner[1] + 1
        while number:
            number, letter = divmod(number - 1, 26)
            letters = chr(ord("A") + letter) + letters
        return f"{letters}{row + self.corner[0] + 1}"


def _sheets(path: Path, largest: int) -> Iterator[_Sheet]:
    """Visible sheets, one after the other."""
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


def _body(sheet: _Sheet, block: Block) -> tuple[list[list[Any]], str]:
    """Rows of a block, and a note on what stands below it."""
    last, blank = block.first, False
    for index, row in enumerate(sheet.rows[block.first :], start=block.first):
        kinds = _kinds(row)
        if not any(kinds):
            blank = True
            continue
        if not block.fits(kinds, blank) and block.ends_at(kinds, _following(sheet, index), blank):
            place = next(cell for cell, kind in enumerate(kinds) if kind)
            where, what = sheet.cell(index, place), str(row[place])[:40]
            note = f"row {where} and the rows below are not read; they begin with {what!r}"
            return sheet.rows[block.first : last + 1], note
        last, blank = index, False
    return sheet.rows[block.first : last + 1], ""


def _following(sheet: _Sheet, index: int) -> list[int]:
    """Kinds of the next row that is not empty."""
    below = (_kinds(sheet.rows[place]) for place in range(index + 1, len(sheet.rows)))
    return next((kinds for kinds in below if any(kinds)), [])


def _table(
    source: str, sheet: _Sheet, block: Block, skipped: dict[str, str], notes: tuple[str, ...]
) -> Table:
    rows, rest = _body(sheet, block)
    above = [[_text(cell) for cell in row] for row in sheet.rows[: block.first]]
    places = list(zip(*rows, strict=True))
    empty = [all(cell == "" for cell in cells) for cells in places]
    heads = find_headings(source, above, empty, named_rows=isinstance(rows[0][0], str))
    units = dict(heads.units)
    columns: dict[str, Array] = {}
    for index, (name, cells) in enumerate(zip(heads.names, places, strict=True)):
        if empty[index]:
            skipped |= {name: "is empty"} if name else {}
            continue
        found = _column(source, sheet, (block.first, index), name, cells)
        if isinstance(found, str):
            skipped[name or f"column_{index + 1}"] = found
            continue
        columns[name or f"column_{index + 1}"] = found
        if isinstance(cells[0], _TIMES):
            units[name] = "s"
    notes = (*heads.notes, *notes, *([rest] if rest else []))
    return make_table(source, columns, units, None, skipped, notes)


def _column(
    source: str, sheet: _Sheet, corner: tuple[int, int], name: str, cells: Sequence[Any]
) -> Array | str:
    """Numbers of a column, or the reason why there are none."""
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
        raise DataError(source, problem, "save the column as numbers, all of one kind")
    numbers = np.array(values, dtype=np.float64)
    return numbers if kinds == {"numbers"} else numbers - numbers[0]


def _kind(cell: Any) -> str:
    if isinstance(cell, datetime.time | datetime.timedelta):
        return "times of the day"
    return "dates" if isinstance(cell, datetime.date) else "numbers"


def _value(cell: Any, mark: str) -> float | None:
    """Number of a cell: NaN if empty, times in s; None for a word."""
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
    """Seconds since a moment that is the same for all values of a kind."""
    if isinstance(time, datetime.timedelta):
        return time.total_seconds()
    if isinstance(time, datetime.time):
        return time.hour * 3600 + time.minute * 60 + time.second + time.microsecond / 1e6
    if isinstance(time, datetime.datetime):
        return time.replace(tzinfo=datetime.UTC).timestamp()
    return _DAY * (time.toordinal() - datetime.date(1970, 1, 1).toordinal())


def _text(cell: Any) -> str:
    """Cell as text; whole numbers without a decimal point."""
    if isinstance(cell, float) and cell.is_integer() and abs(cell) < 1e15:
        return str(int(cell))
    return str(cell).strip()


def workbook_bytes(tables: Mapping[str, pd.DataFrame], readme: pd.DataFrame | None = None) -> bytes:
    """Workbook (.xlsx) with a sheet for each table, `readme` first; not finite: empty cell."""
    import openpyxl  # noqa: PLC0415  # only needed to write workbooks

    book = openpyxl.Workbook(write_only=True)
    first = {} if readme is None else {"README": readme}
    for name, table in {**first, **tables}.items():
        sheet = book.create_sheet(name[:_LONGEST_NAME])
        data = as_data(table).replace([np.inf, -np.inf], np.nan)
        sheet.freeze_panes = "A2"
        for place, head in enumerate(data.columns):
            longest = max(len(str(cell)) for cell in (head, *data.iloc[:_LOOKED_AT, place]))
            letter = openpyxl.utils.get_column_letter(place + 1)
            sheet.column_dimensions[letter].width = min(longest, _WIDEST) + 2
        heads = [openpyxl.cell.WriteOnlyCell(sheet, head) for head in data.columns]
        for cell in heads:
            cell.font = openpyxl.styles.Font(bold=True)
        sheet.append(heads)
        for row in data.itertuples(index=False, name=None):
            sheet.append(row)
    stream = io.BytesIO()
    book.save(stream)
    return stream.getvalue()


def encode_workbook(table: Table) -> bytes:
    """Workbook with one sheet, units in its headings, to 16 digits."""
    import pandas as pd  # noqa: PLC0415  # takes 0.5 s; not needed for text files

    heads = [written_heading(name, table.units.get(name)) for name in table.columns]
    columns = pd.DataFrame(dict(enumerate(table.columns.values())))
    return workbook_bytes({"recording": columns.set_axis(heads, axis=1)})


def as_data(table: pd.DataFrame) -> pd.DataFrame:
    """Table with formula-like texts escaped by an apostrophe, and truth values as yes and no.

    Spreadsheets run texts that begin with = + - or @, and names come from other people's files.
    """
    safe = table.copy(deep=False)
    for place, kind in enumerate(table.dtypes):
        if kind.kind not in "iuf":
            safe.isetitem(place, [_safe(value) for value in table.iloc[:, place]])
    return safe.set_axis([_safe(name) for name in table.columns], axis=1)


def _safe(value: Any) -> Any:
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if not isinstance(value, str):
        return value
    return one_line(value if _NUMBER.fullmatch(value) else text_cell(value), _ANY_LENGTH)
