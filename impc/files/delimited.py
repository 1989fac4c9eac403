"""Read delimited text: CSV, TSV or blank-separated columns, with decimal point or comma.

Above the first row of numbers stand titles and settings (ignored), the header, and a row of units
below it. Lines below the last row of the block are reported and not read. Numbers are parsed in
pieces, so that a file needs no more memory than its content and its numbers.
"""

from __future__ import annotations

import csv
import io
import itertools
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from impc.checking import replace
from impc.errors import DataError
from impc.files.cells import NUMBER, WORD, Column, certain, kind_of
from impc.files.disk import LARGEST
from impc.files.layout import (
    HEAD,
    Block,
    Extent,
    Row,
    extent,
    first_block,
    table_of,
    written_heading,
)
from impc.files.table import Table

_DELIMITERS = "\t;,| \n"  # the last: a single column
# Texts for a missing number that pandas takes for one; others are recognised cell by cell.
_MISSING = ["", "NaN", "nan", "NA", "N/A", "null", "#N/A", "#NV"]
_BEGINS = tuple("0123456789+-. ")  # first characters of a row of numbers
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
        return [kind_of(item, self.decimal) for item in self.fields(line)]


def read_delimited(path: Path, largest: int = LARGEST) -> Table:
    """Read the text file at `path`."""
    source = str(path)
    content, encoding = _decoded(source, path.read_bytes())
    text, block = _divided(_Text(source, content, encoding))
    above = [line for _, (_, line) in zip(range(block.first), text.lines(), strict=False)]
    body = extent(source, block, _rows(text, block), not content.endswith(b"\n"))
    if 8 * body.rows * body.width > largest:
        problem = f"has {body.rows} rows of {body.width} values, too many to read"
        raise DataError(source, problem, "export only the signals that are needed")
    columns = _columns(text, block.first, body)
    first = [line for _, line in _from(text, block.first, 3)]
    quoted = any(line.lstrip().startswith('"') for line in first)
    heads = [text.fields(line.strip(" ").lstrip("#%").strip(" ")) for line in above]

    def where(row: int, _: int = 0) -> str:
        return f"line {next(_from(text, block.first + row, 1))[0]}"

    def texts(column: int) -> Iterator[tuple[str, str]]:
        for number, line in _from(text, block.first, body.rows):
            yield f"line {number}", text.fields(line)[column]

    return table_of(
        source, heads, columns, where, texts,
        named_rows=quoted or columns[0].words, notes=[body.note], skipped={},
    )  # fmt: skip


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


def _divided(text: _Text) -> tuple[_Text, Block]:
    """Choose the delimiter and decimal sign with most numbers; locate the block of numbers."""
    best, most = None, 0.5
    for delimiter, decimal in itertools.product(_DELIMITERS, ".,"):
        found = replace(text, delimiter=delimiter, decimal=decimal)
        block, share = _block(found)
        if block is not None and share > most:
            best, most = (found, block), share
    if best is None:
        problem = f"has no rows of numbers in the first {HEAD} of its lines"
        raise DataError(text.source, problem, "export it again, one signal per column")
    return best


def _block(text: _Text) -> tuple[Block | None, float]:
    """Block of numbers, and the share of certain numbers among its fields that are not empty."""
    lines = [line for _, line in _from(text, 0, _SAMPLE)]
    block = first_block([text.kinds(line) for line in lines], text.delimiter == "\n")
    fields = [item for line in lines[block.first :] for item in text.fields(line)] if block else []
    known = sum(certain(item, text.decimal) for item in fields)
    if text.decimal == text.delimiter:  # quoted numbers, which may have thousands instead
        known -= sum("," in item and kind_of(item, ".") == NUMBER for item in fields)
    return block, known / max(sum(map(bool, fields)), 1)


def _from(text: _Text, start: int, most: int) -> Iterator[tuple[int, str]]:
    """At most so many lines with their numbers, from that of an index on."""
    return itertools.islice(text.lines(), start, start + most)


def _rows(text: _Text, block: Block) -> Iterator[Row]:
    """Rows from the first of the block on; the kinds are determined where one may not fit."""
    before, width, named = 0, len(block.kinds), block.kinds[0] == WORD
    for number, line in itertools.islice(text.lines(), block.first, None):
        after_blank, found = before > 0 and number > before + 1, text.width(line)
        usual = found == width and not after_blank and not named and line[:1] in _BEGINS
        kinds = None if usual else text.kinds(line)
        yield Row(f"line {number}", line, kinds, after_blank, found)
        before = number


def _columns(text: _Text, start: int, body: Extent) -> list[Column]:
    """Columns of the rows from a `start` on, parsed piece by piece."""
    import pandas as pd  # noqa: PLC0415  # takes 0.5 s; not needed for text files

    found = [Column(body.rows, text.decimal) for _ in range(body.width)]
    separator: Any = {"\n": "\x1f", " ": r"\s+"}.get(text.delimiter, text.delimiter)
    stream = io.BytesIO(text.content)
    blank = b" " if text.delimiter == "\t" else b" \t"
    while start:
        start -= bool(stream.readline().strip(blank + b"\n"))
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
            for piece in pieces:
                for place, column in enumerate(found):
                    column.add(piece[place].to_numpy())
    except (ValueError, OverflowError) as error:
        reason = str(error).strip().splitlines()[0]
        problem = f"cannot be split into columns ({reason})"
        raise DataError(text.source, problem, "export it again") from None
    return found
