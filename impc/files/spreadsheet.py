"""Workbooks of Excel (.xlsx) and LibreOffice (.ods), read with python-calamine (extra `excel`).

The recording is the requested sheet, else the first visible one with a block of numbers; the other
sheets are listed as skipped. Rows above and below the block are treated as in delimited text. For a
formula the saved value counts. Workbooks are written with openpyxl.
"""

from __future__ import annotations

import html
import io
import re
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from impc.errors import DataError, one_line
from impc.extras import optional
from impc.files.cells import WORD, Column, kind_of
from impc.files.delimited import text_cell
from impc.files.layout import HEAD, Block, Row, extent, first_block, table_of, written_heading
from impc.files.table import OTHER_SHEET, Table

if TYPE_CHECKING:
    import pandas as pd

_LONGEST_NAME = 31  # characters of a sheet name
_ANY_LENGTH = 32_767  # characters of a cell
_WIDEST, _LOOKED_AT = 100, 200  # column width in characters; rows that determine it
_NUMBER = re.compile(r"[+-]?\d+(\.\d*)?")
_RELATIONS = "xl/_rels/workbook.xml.rels"
_HIDDEN = re.compile(rb"<(?:\w+:)?(row|col)\s[^>]*hidden=[\"'](?:1|true)[\"'][^>]*>")
_HIDDEN_ODS = re.compile(
    rb"<table:table-(row|col)(?:umn)?\s[^>]*table:visibility=[\"'](?:collapse|filter)"
)


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
        problem = f"has no rows of numbers in the first {HEAD} rows of a visible sheet"
        raise DataError(source, problem, "save one signal per column, its name above it")
    full = [item for item in found if item[1].several]
    chosen, block = (full or found)[0]
    skipped = {f"sheet {item.name}": OTHER_SHEET for item in sheets if item is not chosen}
    notes = (f"sheet {chosen.name!r} is read; other sheets have rows of numbers too",)
    return _table(path, chosen, block, skipped, notes if len(full) > 1 else ())


def _block(sheet: _Sheet) -> Block | None:
    return first_block([_kinds(row) for row in sheet.rows[: 3 * HEAD]], alone=True)


def _kinds(row: Sequence[Any]) -> list[int]:
    return [kind_of(cell, ".", ",") for cell in row]


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


def _table(
    path: Path, sheet: _Sheet, block: Block, skipped: dict[str, str], notes: Sequence[str]
) -> Table:
    source, first = str(path), block.first
    rows = (
        Row(f"row {index + 1 + sheet.corner[0]}", _joined(row), _kinds(row), width=len(row))
        for index, row in enumerate(sheet.rows[first:], first)
    )
    body = extent(source, block, rows, cut_short=False)
    cells = sheet.rows[first : first + body.rows]
    columns = [_column(part) for part in zip(*cells, strict=True)]

    def where(row: int, column: int) -> str:
        return f"cell {sheet.cell(first + row, column)}"

    def texts(column: int) -> Iterator[tuple[str, str]]:
        for row, cell in enumerate(cells):
            if isinstance(cell[column], str):
                yield where(row, column), cell[column].strip()

    above = [[_text(cell) for cell in row] for row in sheet.rows[:first]]
    hidden = _hidden(path, sheet, range(first + 1, first + 1 + body.rows), body.width)
    return table_of(
        source, above, columns, where, texts, named_rows=isinstance(cells[0][0], str),
        notes=[*notes, body.note, hidden], skipped=skipped,
    )  # fmt: skip


def _joined(row: Sequence[Any]) -> str:
    return " ".join(text for text in map(_text, row) if text)


def _column(cells: Sequence[Any]) -> Column:
    """Column of cells, with the decimal sign by which fewer texts are words."""
    texts = [cell.strip() for cell in cells if isinstance(cell, str)]
    commas = any("," in text for text in texts)
    words = {sign: sum(kind_of(text, sign) == WORD for text in texts) for sign in ",."}
    found = Column(len(cells), "," if commas and words[","] <= words["."] else ".")
    found.add([None if cell == "" else cell for cell in cells])
    return found


def _hidden(path: Path, sheet: _Sheet, rows: range, width: int) -> str:
    """Note on hidden `rows` of a sheet, counted from its first, and columns up to a `width`."""
    with zipfile.ZipFile(path) as archive:
        if ods := path.suffix.lower() == ".ods":
            parts = archive.read("content.xml").split(b"<table:table ")
            own = [part for part in parts if _attribute(part, "table:name") == sheet.name]
        else:
            tags = re.findall(rb"<(?:\w+:)?sheet\s[^>]*>", archive.read("xl/workbook.xml"))
            named = [tag for tag in tags if _attribute(tag, "name") == sheet.name]
            wanted = _attribute(named[0], r"\w+:id") if named else ""
            tags = re.findall(rb"<(?:\w+:)?Relationship\s[^>]*>", archive.read(_RELATIONS))
            targets = [_attribute(tag, "Target") for tag in tags if _attribute(tag, "Id") == wanted]
            files = [f"xl/{name.removeprefix('/xl/')}" for name in targets]
            own = [archive.read(name) for name in files if name in archive.namelist()]
    marked = [(found[1], found[0]) for part in own
              for found in (_HIDDEN_ODS if ods else _HIDDEN).finditer(part)]  # fmt: skip
    last = sheet.corner[1] + width
    columns = [tag for kind, tag in marked
               if kind == b"col" and int(_attribute(tag, "min") or 0) <= last]  # fmt: skip
    # Rows of .ods have no numbers.
    numbers = [int(_attribute(tag, "r") or 0) - sheet.corner[0]
               for kind, tag in marked if kind == b"row"]  # fmt: skip
    inside = [number for number in numbers if ods or number in rows]
    first = f", the first {inside[0] + sheet.corner[0]}" if inside and not ods else ""
    said = [f"{len(inside)} hidden rows{first}"] if inside else []
    said += [f"{len(columns)} hidden columns"] if columns else []
    if not said:
        return ""
    read = f"sheet {sheet.name!r} has {' and '.join(said)}, which are read like the others"
    return f"{read}: delete them in the file if they are not to count"


def _attribute(tag: bytes, name: str) -> str:
    """Value of the first attribute of this name in an XML tag; empty without one."""
    found = re.search(rf"(?:^|\s){name}\s*=\s*[\"']([^\"']*)".encode(), tag)
    return html.unescape(found[1].decode()) if found else ""


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
