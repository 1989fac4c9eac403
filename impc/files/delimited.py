"""Delimited text: CSV with comma or semicolon, TSV, columns of blanks; decimal point or comma.

What stands above the first row of numbers may be lines of another width (ignored), the header, and
a row of units below it. A header may carry its unit: ``angle (deg)`` or ``angle [deg]``.
"""

from __future__ import annotations

import csv
import io
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from impc.errors import DataError
from impc.files.headings import are_units, named_columns, written_heading
from impc.files.table import make_table
from impc.files.thousands import require_no_thousands

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    import pandas as pd

    from impc.arrays import Array
    from impc.files.table import Table

__all__ = ["encode_delimited", "is_number", "read_delimited", "text_cell"]

_DELIMITERS = {".csv": ",;\t", ".tsv": "\t", ".txt": "\t;, "}
_NAMES = {",": "commas", ";": "semicolons", "\t": "tabs", " ": "blanks", "|": "bars", ":": "colons"}
_MISSING = ["", "NaN", "nan", "NAN", "NA", "N/A", "null"]
# Digits are taken once (++): a field of 50 000 of them and a letter is no matter of a minute.
_NUMBER = re.compile(
    r"[+-]?(\d++[.,]?\d*+|[.,]\d++)(e[+-]?\d++)?|[+-]?inf(inity)?|nan", re.IGNORECASE
)
_LONGEST = 50_000  # characters of a line: 2000 columns of 24
# Where a spreadsheet would begin a formula: at the start, or behind what it may take for the end of
# a cell. A list separator is a semicolon in half of Europe, whether the text is quoted or not.
_FORMULA = re.compile(r"(^|[;\t\r\n])(?=\s*[=+@\-])")
_HEAD = 100  # lines in which the first row of numbers must stand


@dataclass(frozen=True)
class _Layout:
    """How the text is laid out: its delimiter, decimal sign, width, and where its numbers begin."""

    delimiter: str
    decimal: str
    width: int
    first: int


def read_delimited(path: Path) -> Table:
    """Read the .csv, .tsv or .txt file at `path`.

    Raises
    ------
    DataError
        When it is not text, when no delimiter divides it into columns, when a row has more or
        fewer values than the others, or when a column of numbers has text in it.
    """
    source = str(path)
    lines = _lines(source, path.read_bytes())
    layout = _layout(source, path.suffix.lower(), [text for _, text in lines[:_HEAD]])
    body = lines[layout.first :]
    _require_width(source, body, layout)
    names, units = _headings(source, lines[: layout.first], layout)
    frame = _frame(source, body, layout)
    columns: dict[str, Array] = {}
    skipped: dict[str, str] = {}
    floats: dict[int, str] = {}
    numbers = [number for number, _ in body]
    for index, name in enumerate(names):
        if not name and frame[index].isna().all():
            continue  # the empty column behind a delimiter at the end of each line
        values = _column(source, name, frame[index], numbers, layout.decimal)
        if isinstance(values, str):
            skipped[name] = values
        else:
            columns[name or f"column_{index + 1}"] = values
            if frame[index].dtype.kind == "f":  # in a column of whole numbers no sign stands
                floats[index] = name
    _require_no_thousands(source, floats, body, layout)
    return make_table(source, columns, units, None, skipped)


def encode_delimited(table: Table, suffix: str) -> bytes:
    """The bytes of a file with every digit kept; `suffix` .csv has commas, others have tabs."""
    delimiter = "," if suffix == ".csv" else "\t"
    text = io.StringIO()
    writer = csv.writer(text, delimiter=delimiter, lineterminator="\n")
    heads = [written_heading(name, table.units.get(name)) for name in table.columns]
    writer.writerow([text_cell(head) for head in heads])
    columns = [values.tolist() for values in table.columns.values()]
    writer.writerows([repr(value) for value in row] for row in zip(*columns, strict=True))
    return text.getvalue().encode()


def text_cell(text: str) -> str:
    """A text of which no spreadsheet makes a formula: an apostrophe stands before its sign."""
    return _FORMULA.sub(r"\1'", text)


def _lines(source: str, content: bytes) -> list[tuple[int, str]]:
    """The lines that are not empty, with their numbers in the file."""
    if content.startswith((b"\xff\xfe", b"\xfe\xff")):
        text = content.decode("utf-16", errors="replace")
    else:
        try:
            text = content.decode("utf-8-sig")
        except UnicodeDecodeError:
            text = content.decode("latin-1")
    if "\0" in text:
        line = text[: text.index("\0")].count("\n") + 1
        raise DataError(
            source, f"is not text (a zero byte in line {line})", "export it as CSV again"
        )
    split = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    lines = [(number, line) for number, line in enumerate(split, 1) if line.strip()]
    if not lines:
        raise DataError(source, "is empty", "export it again")
    long = next(((number, len(line)) for number, line in lines if len(line) > _LONGEST), None)
    if long is not None:
        problem = f"line {long[0]} has {long[1]} characters, and {_LONGEST} is the most"
        raise DataError(source, problem, "export it again, one sample a row")
    return lines


def _layout(source: str, suffix: str, head: Sequence[str]) -> _Layout:
    """The delimiter and decimal sign with which most fields of the rows are numbers."""
    best, most = None, 0.5
    for delimiter in (*_DELIMITERS[suffix], "\n"):
        for decimal in (".", ","):
            share, layout = _share_of_numbers(head, delimiter, decimal)
            if layout is not None and share > most:
                best, most = layout, share
    if best is not None:
        return best
    others = [mark for mark in _NAMES if mark not in _DELIMITERS[suffix]]
    between = next((mark for mark in others if _share_of_numbers(head, mark, ".")[0] > 0.9), None)
    expected = " or ".join(_NAMES[mark] for mark in _DELIMITERS[suffix])
    if between is None:
        problem = (
            f"has no rows of numbers divided by {expected} in the first {len(head)} of its lines"
        )
    else:
        problem = f"is divided by {_NAMES[between]}, and a {suffix} file is by {expected}"
    raise DataError(source, problem, "export it again, one signal a column")


def _share_of_numbers(
    head: Sequence[str], delimiter: str, decimal: str
) -> tuple[float, _Layout | None]:
    """Share of numbers among the fields of the rows, of which the first has at least half."""
    if decimal == delimiter:
        return 0.0, None
    rows = [_fields(line, delimiter) for line in head]
    kinds = [[not item or is_number(item, decimal) for item in row] for row in rows]
    alone = 1 if delimiter == "\n" else 2
    for index, (row, numbers) in enumerate(zip(rows, kinds, strict=True)):
        some = any(is_number(item, decimal) for item in row)
        if some and len(row) >= alone and sum(numbers) >= len(row) / 2:
            below = [kind for line in kinds[index:] for kind in line]
            share = sum(below) / len(below)
            return share, _Layout(delimiter, decimal, len(row), index)
    return 0.0, None


def _fields(line: str, delimiter: str) -> list[str]:
    if delimiter == "\n":
        return [line.strip()]
    if delimiter == " ":
        return line.split()
    return [item.strip() for item in next(csv.reader([line], delimiter=delimiter))]


def is_number(text: str, decimal: str) -> bool:
    """Whether the `text` of a field is a number with this `decimal` sign, or stands for none."""
    other = "," if decimal == "." else "."
    return text in _MISSING[1:] or (_NUMBER.fullmatch(text) is not None and other not in text)


def _require_width(source: str, body: Sequence[tuple[int, str]], layout: _Layout) -> None:
    for position, (number, line) in enumerate(body):
        width = len(_fields(line, layout.delimiter)) if '"' in line else _width(line, layout)
        if width != layout.width:
            last = position == len(body) - 1 and width < layout.width
            raise DataError(
                source,
                f"line {number} has {width} values where the first row has {layout.width}"
                + (": the file ends in the middle of a row" if last else ""),
                "copy or export the file again",
            )


def _width(line: str, layout: _Layout) -> int:
    if layout.delimiter == " ":
        return len(line.split())
    return line.count(layout.delimiter) + 1


def _headings(
    source: str, above: Sequence[tuple[int, str]], layout: _Layout
) -> tuple[list[str], dict[str, str]]:
    """Names and units from the lines above the numbers."""
    rows = [_fields(line.strip().lstrip("#%").strip(), layout.delimiter) for _, line in above]
    if not rows:
        return [f"column_{index + 1}" for index in range(layout.width)], {}
    row_of_units = [""] * layout.width
    last = rows[-1]
    if len(rows) > 1 and len(last) == len(rows[-2]) == layout.width and are_units(last):
        row_of_units = last
        last = rows[-2]
    if len(last) != layout.width:
        raise DataError(
            source,
            f"line {above[-1][0]} names {len(last)} columns, and the rows below have "
            f"{layout.width} values",
            "export with a point as decimal sign, or with semicolons between columns",
        )
    return named_columns(source, last, row_of_units)


def _frame(source: str, body: Sequence[tuple[int, str]], layout: _Layout) -> pd.DataFrame:
    import pandas as pd  # noqa: PLC0415  # half a second, for who reads text only

    text = "\n".join(line for _, line in body)
    separator: Any = {"\n": "\x1f", " ": r"\s+"}.get(layout.delimiter, layout.delimiter)
    try:
        return pd.read_csv(
            io.StringIO(text),
            sep=separator,
            header=None,
            decimal=layout.decimal,
            na_values=_MISSING,
            keep_default_na=False,
            skipinitialspace=True,
            low_memory=False,
        )
    except (ValueError, OverflowError) as error:
        reason = str(error).strip().splitlines()[0]
        problem = f"cannot be divided into columns ({reason})"
        raise DataError(source, problem, "export it again") from None


def _column(
    source: str, name: str, values: pd.Series[Any], lines: Sequence[int], decimal: str
) -> Array | str:
    """The numbers of a column, or why it has none."""
    import pandas as pd  # noqa: PLC0415

    if pd.api.types.is_bool_dtype(values):
        return "holds true and false"
    numbers = pd.to_numeric(values, errors="coerce")
    text = np.asarray(numbers.isna() & values.notna())
    if decimal == "," and values.dtype.kind not in "fiu":
        # Beside a word the rest is text to pandas: 2,5 is a number, and 1.000 is none.
        text = np.array([not is_number(str(item).strip(), ",") for item in values])
        text &= np.asarray(values.notna())
    if not text.any():
        return np.asarray(numbers, dtype=np.float64)
    first = int(np.argmax(text))
    written = str(values.iloc[first])[:20]
    if numbers.notna().any() or not text.all():
        raise DataError(
            source,
            f"column {name!r} has text in {int(text.sum())} of {len(values)} rows, the first "
            f"{written!r} in line {lines[first]}",
            "correct those rows or export the column as numbers, without thousands separators",
        )
    return f"is text, such as {written!r} in line {lines[first]}"


def _require_no_thousands(
    source: str, floats: dict[int, str], body: Sequence[tuple[int, str]], layout: _Layout
) -> None:
    """Look for thousands where some of the numbers that are not whole have no decimal sign."""
    signs = sum(line.count(layout.decimal) for _, line in body)
    if signs >= len(body) * len(floats):
        return
    split = None if layout.delimiter == " " else layout.delimiter
    rows = (
        (number, _fields(line, layout.delimiter) if '"' in line else line.split(split))
        for number, line in body
    )
    require_no_thousands(source, floats, rows, layout.decimal)
