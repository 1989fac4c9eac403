"""Read delimited text: CSV, TSV or blank-separated columns, with decimal point or comma.

Above the first row of numbers stand titles and settings (ignored), the header, and a row of units
below it. Lines below the last row of the block are reported and not read. Numbers are parsed in
pieces, so that a file needs no more memory than its content and its numbers.
"""

from __future__ import annotations

import csv
import io
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from impc.errors import DataError
from impc.files.disk import LARGEST
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
from impc.files.table import make_table

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    import pandas as pd

    from impc.arrays import Array
    from impc.files.table import Table

_DELIMITERS = {".csv": ",;\t", ".lvm": "\t,;", ".txt": "\t;, "}
_TABS = "\t", "\t "  # .tsv; OpenSim files, whose columns may also be separated by blanks
_NAMES = {",": "commas", ";": "semicolons", "\t": "tabs", " ": "blanks", "|": "bars", ":": "colons"}
# Texts for a missing number, including errors of spreadsheets and of C.
_MISSING = [
    *("", "NaN", "nan", "NAN", "NA", "N/A", "n/a", "null", "-nan", "-nan(ind)", "nan(ind)"),
    *("#N/A", "#NV", "#NA", "#DIV/0!", "#VALUE!", "#WERT!", "#NUM!", "#ZAHL!", "#REF!", "#BEZUG!"),
    *("#NAME?", "#NULL!", "1.#QNAN", "-1.#IND"),
]
# Possessive quantifiers (++): without them, 50 000 digits and a letter take minutes.
_NUMBER = re.compile(
    r"[+-]?(\d++[.,]?\d*+|[.,]\d++)(e[+-]?\d++)?|[+-]?inf(inity)?|nan", re.IGNORECASE
)
_LONGEST = 50_000  # characters of a line: 2000 columns of 24
# Where a spreadsheet would begin a formula: at the start, or behind a possible end of a cell (in
# many European locales a semicolon, quoted or not).
_FORMULA = re.compile(r"(^|[;\t\r\n])(?=\s*[=+@\-])")
_SAMPLE = 3 * HEAD  # lines from which the layout is determined
_PIECE = 100_000  # rows parsed at once


@dataclass(frozen=True)
class _Text:
    """Content of a file with newlines normalised, its delimiter and its decimal sign."""

    source: str
    content: bytes
    encoding: str
    delimiter: str = ""
    decimal: str = ""

    def lines(self) -> Iterator[tuple[int, str]]:
        """Lines that are not empty, with their numbers in the file."""
        blank = " " if self.delimiter == "\t" else " \t"
        for number, line in enumerate(io.BytesIO(self.content), 1):
            text = line.decode(self.encoding, "replace").rstrip("\n")
            if text.strip(blank):
                yield number, text

    def fields(self, line: str) -> list[str]:
        """Fields of a line."""
        if self.delimiter == "\n":
            return [line.strip()]
        if self.delimiter == " ":
            blanks = csv.reader([line.replace("\t", " ")], delimiter=" ", skipinitialspace=True)
            return [item for item in next(blanks) if item] if '"' in line else line.split()
        return [item.strip() for item in next(csv.reader([line], delimiter=self.delimiter))]

    def width(self, line: str) -> int:
        """Number of fields of a line."""
        if '"' in line or self.delimiter == " ":
            return len(self.fields(line))
        return line.count(self.delimiter) + 1  # the delimiter "\n" occurs in no line

    def kinds(self, line: str) -> list[int]:
        """Kind of each field: `EMPTY`, `NUMBER` or `WORD`."""
        return [
            EMPTY if not item else NUMBER if is_number(item, self.decimal) else WORD
            for item in self.fields(line)
        ]


@dataclass(frozen=True)
class _Body:
    """Block of numbers: lines above it, its rows, fields of the longest row, note on the rest."""

    start: int
    rows: int
    width: int
    rest: str


@dataclass
class _Column:
    """Numbers of a column; count of its words, and the first word with its row."""

    values: Array
    signs: bool = False  # whether some of its numbers may have a decimal sign
    words: int = 0
    word: str = ""
    row: int = 0
    truths: bool = False


def read_delimited(path: Path, largest: int = LARGEST) -> Table:
    """Read the text file at `path`; its ending determines the possible delimiters."""
    source = str(path)
    content, encoding = _decoded(source, path.read_bytes())
    text, block = _divided(_Text(source, content, encoding), path.suffix.lower())
    body = _body(text, block)
    if 8 * body.rows * body.width > largest:
        problem = f"has {body.rows} rows of {body.width} values, too many to read"
        raise DataError(source, problem, "export only the signals that are needed")
    columns = _columns(text, body)
    end = _statistics(text, block, body, columns)
    if end is not None:
        body = end
        columns = _columns(text, body)
    above = [line for _, (_, line) in zip(range(block.first), text.lines(), strict=False)]
    return _table(text, body, columns, above)


def encode_delimited(table: Table, suffix: str) -> bytes:
    """Encode a table with all digits; .csv is comma-separated, all else tab-separated."""
    delimiter = "," if suffix == ".csv" else "\t"
    text = io.StringIO()
    writer = csv.writer(text, delimiter=delimiter, lineterminator="\n")
    heads = [written_heading(name, table.units.get(name)) for name in table.columns]
    writer.writerow([text_cell(head) for head in heads])
    columns = [values.tolist() for values in table.columns.values()]
    writer.writerows([repr(value) for value in row] for row in zip(*columns, strict=True))
    return text.getvalue().encode()


def text_cell(text: str) -> str:
    """Put an apostrophe before text that a spreadsheet would take for a formula."""
    return _FORMULA.sub(r"\1'", text)


def is_number(text: str, decimal: str) -> bool:
    """Whether `text` is a number with this `decimal` sign, or marks a missing number."""
    other = "," if decimal == "." else "."
    return text in _MISSING[1:] or (_NUMBER.fullmatch(text) is not None and other not in text)


def _decoded(source: str, content: bytes) -> tuple[bytes, str]:
    """Content with normalised newlines, and its encoding."""
    if content.startswith((b"\xff\xfe", b"\xfe\xff")):
        content = content.decode("utf-16", errors="replace").encode()
    content = content.removeprefix(b"\xef\xbb\xbf")
    if b"\r" in content:
        content = content.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    if b"\0" in content:
        line = content[: content.index(b"\0")].count(b"\n") + 1
        raise DataError(
            source, f"is not text (a zero byte in line {line})", "export it as CSV again"
        )
    if not content.strip():
        raise DataError(source, "is empty", "export it again")
    long = re.search(rb"[^\n]{%d,}" % (_LONGEST + 1), content)
    if long is not None:
        line, size = content[: long.start()].count(b"\n") + 1, len(long[0])
        problem = f"line {line} has {size} characters; at most {_LONGEST} are read"
        raise DataError(source, problem, "export it again, one sample per row")
    try:
        content.decode()
    except UnicodeDecodeError:
        return content, "latin-1"
    return content, "utf-8"


def _divided(text: _Text, suffix: str) -> tuple[_Text, Block]:
    """Choose the delimiter and decimal sign with most numbers; locate the block of numbers."""
    allowed = _DELIMITERS.get(suffix, _TABS[suffix != ".tsv"])
    best, most = None, 0.5
    for delimiter in (*allowed, "\n"):
        for decimal in (".", ","):
            found = _Text(text.source, text.content, text.encoding, delimiter, decimal)
            block, share = _block(found)
            if block is not None and share > most:
                best, most = (found, block), share
    if best is not None:
        return best
    others = {mark: _Text(text.source, text.content, text.encoding, mark, ".") for mark in _NAMES}
    between = next(
        (mark for mark in _NAMES if mark not in allowed and _block(others[mark])[1] > 0.9), None
    )
    expected = " or ".join(_NAMES[mark] for mark in allowed)
    if between is None:
        problem = f"has no rows of numbers separated by {expected} in the first {HEAD} of its lines"
    else:
        problem = f"is separated by {_NAMES[between]}; a {suffix} file needs {expected}"
    raise DataError(text.source, problem, "export it again, one signal per column")


def _block(text: _Text) -> tuple[Block | None, float]:
    """Block of numbers, and the share of numbers among its fields that are not empty."""
    if text.decimal == text.delimiter:
        return None, 0.0
    sample = zip(range(_SAMPLE), text.lines(), strict=False)
    rows = [text.kinds(line) for _, (_, line) in sample]
    block = first_block(rows, text.delimiter == "\n")
    below = [kind for row in rows[block.first :] for kind in row if kind] if block else []
    return block, below.count(NUMBER) / max(len(below), 1)


def _body(text: _Text, block: Block) -> _Body:
    """Rows from the first of the block to the last one with as many fields."""
    width, rows, kept, before = len(block.kinds), 0, 0, 0
    lines = text.lines()
    for _ in range(block.first):
        before, _line = next(lines)
    for number, line in lines:
        found, blank = text.width(line), number > before + 1
        usual = found == len(block.kinds) and not blank
        if not usual and not block.fits(text.kinds(line), blank):
            _, following = next(lines, (0, ""))
            ends = block.ends_at(text.kinds(line), text.kinds(following), blank)
            cut = not following and found < block.width and not _is_word(line, text)
            if cut or not ends:
                raise DataError(
                    text.source,
                    f"line {number} has {found} values where the first row has {len(block.kinds)}"
                    + (": the file ends in the middle of a row" if cut else ""),
                    "copy or export the file again",
                )
            return _Body(block.first, kept, width, _rest(number, line))
        rows, width = rows + 1, max(width, found)
        if line.strip(f" {text.delimiter}"):
            kept, before = rows, number  # trailing rows of delimiters alone do not count
    return _Body(block.first, kept, width, "")


def _is_word(line: str, text: _Text) -> bool:
    """Whether a line begins with a word (which a truncated number does not)."""
    return re.match(r"[^\W\d_]{3}", text.fields(line)[0]) is not None or text.content.endswith(
        b"\n"
    )


def _rest(number: int, line: str) -> str:
    return f"line {number} and the lines below are not read; they begin with {line.strip()[:40]!r}"


def _statistics(text: _Text, block: Block, body: _Body, columns: Sequence[_Column]) -> _Body | None:
    """Body without trailing rows of summary statistics; None if there are none."""
    mixed = [column.row for column in columns if column.words and np.isfinite(column.values).any()]
    if not mixed:
        return None
    row = min(mixed)
    lines = text.lines()
    for _ in range(block.first + row - 1):
        next(lines)
    before = next(lines)[0] if block.first + row else 0
    (number, line), (_, following) = next(lines), next(lines, (0, ""))
    if row == 0 or not block.ends_at(text.kinds(line), text.kinds(following), number > before + 1):
        return None
    return _Body(body.start, row, body.width, _rest(number, line))


def _columns(text: _Text, body: _Body) -> list[_Column]:
    """Columns of the body, parsed piece by piece."""
    import pandas as pd  # noqa: PLC0415  # takes 0.5 s; not needed for text files

    found = [_Column(np.full(body.rows, np.nan)) for _ in range(body.width)]
    separator: Any = {"\n": "\x1f", " ": r"\s+"}.get(text.delimiter, text.delimiter)
    stream, left = io.BytesIO(text.content), body.start
    blank = b" " if text.delimiter == "\t" else b" \t"
    while left:
        left -= bool(stream.readline().strip(blank + b"\n"))
    try:
        pieces = pd.read_csv(
            stream,
            sep=separator,
            header=None,
            names=range(body.width),
            index_col=False,
            decimal=text.decimal,
            na_values=_MISSING,
            keep_default_na=False,
            skipinitialspace=True,
            encoding=text.encoding,
            encoding_errors="replace",
            nrows=body.rows,
            chunksize=_PIECE,
        )
        with pieces:
            start = 0
            for piece in pieces:
                for place, column in enumerate(found):
                    _take(column, piece[place], start, text.decimal)
                start += len(piece)
    except (ValueError, OverflowError) as error:
        reason = str(error).strip().splitlines()[0]
        problem = f"cannot be split into columns ({reason})"
        raise DataError(text.source, problem, "export it again") from None
    return found


def _take(column: _Column, piece: pd.Series[Any], start: int, decimal: str) -> None:
    """Store the values of some rows and count the words among them."""
    values = column.values[start : start + len(piece)]
    column.signs |= piece.dtype.kind not in "iu"
    if piece.dtype.kind in "fiu":
        values[:] = piece
        return
    for place, item in enumerate(piece):
        written = str(item).strip()
        if isinstance(item, float) or item is None:  # missing, or a number of a piece with words
            values[place] = item
        elif is_number(written, decimal) and not isinstance(item, bool):
            values[place] = float("nan" if written in _MISSING else written.replace(",", "."))
        else:
            if not column.words:
                column.word, column.row = written[:20], start + place
                column.truths = isinstance(item, bool)
            column.words += 1


def _table(text: _Text, body: _Body, columns: Sequence[_Column], above: Sequence[str]) -> Table:
    empty = [not column.words and bool(np.isnan(column.values).all()) for column in columns]
    quoted = any(line.lstrip().startswith('"') for line in _first(text, body))
    rows = [text.fields(line.strip(" ").lstrip("#%").strip(" ")) for line in above]
    heads = find_headings(text.source, rows, empty, named_rows=quoted or bool(columns[0].words))
    kept: dict[str, Array] = {}
    skipped: dict[str, str] = {}
    floats: dict[int, str] = {}
    for place, (name, column) in enumerate(zip(heads.names, columns, strict=True)):
        known = name or f"column_{place + 1}"
        if empty[place]:
            skipped |= {name: "is empty"} if name else {}
        elif column.words:
            skipped[known] = _words(text, body, known, column)
        else:
            column.values.flags.writeable = False  # used without a copy
            kept[known] = column.values
            floats |= {place: name} if column.signs else {}
    _require_no_thousands(text, body, floats)
    notes = (*heads.notes, *([body.rest] if body.rest else []))
    return make_table(text.source, kept, heads.units, None, skipped, notes)


def _first(text: _Text, body: _Body) -> Iterator[str]:
    """First three rows of the body."""
    for index, (_, line) in zip(range(body.start + 3), text.lines(), strict=False):
        if index >= body.start:
            yield line


def _words(text: _Text, body: _Body, name: str, column: _Column) -> str:
    """Reason why a column with words is skipped; an error if it also has numbers."""
    row = body.start + column.row
    line = next(number for index, (number, _) in enumerate(text.lines()) if index == row)
    if column.truths:
        return "holds true and false"
    if np.isnan(column.values).all():
        return f"is text, such as {column.word!r} in line {line}"
    raise DataError(
        text.source,
        f"column {name!r} has text in {column.words} of {body.rows} rows, the first "
        f"{column.word!r} in line {line}",
        "correct those rows or export the column as numbers, without thousands separators",
    )


def _require_no_thousands(text: _Text, body: _Body, floats: dict[int, str]) -> None:
    """Search for thousands separators if some non-integer columns lack a decimal sign."""
    sign = text.decimal.encode()
    if text.content.count(sign) >= body.rows * len(floats):
        return
    rows = (
        (number, text.fields(line))
        for index, (number, line) in enumerate(text.lines())
        if body.start <= index < body.start + body.rows
    )
    require_no_thousands(text.source, floats, rows, text.decimal)
