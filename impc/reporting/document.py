"""A report as one value: the sections of its page, and the tables, figures and numbers beside it.

Text is escaped when the page is made. Where a sentence holds a piece of code or a link it is a
`markupsafe.Markup`, whose `format` escapes what is put into it.

The tables of a result as one MATLAB file: a struct a table, a field a column (docs/results.md).

Names follow MATLAB's rules: letters, digits and underscores, a letter first, 63 characters at most.
Columns of numbers are column vectors, all others cell arrays of text.
"""

from __future__ import annotations

import base64
import io
import json
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import scipy.io

from impc.files.columns import in_columns
from impc.files.results import SCHEMA
from impc.files.workbook import MOST_ROWS, workbook_bytes
from impc.reporting.csv_text import csv_bytes
from impc.reporting.glossary import Glossary, used_words
from impc.reporting.provenance import Provenance
from impc.reporting.rendering import plain, render_template

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

T = TypeVar("T")


@dataclass(frozen=True)
class TextTable:
    """A table of texts, or of numbers when it is only written as CSV."""

    caption: str  # Above the table
    heads: Sequence[str]  # One a column
    rows: Sequence[Sequence[Any]]  # Their first cell is a head of its own

    def csv(self) -> bytes:
        """As a file for spreadsheets, without the caption."""
        return csv_bytes(self.heads, self.rows)

    def text(self) -> str:
        """In columns of a fixed width for a terminal, without the caption."""
        return in_columns([self.heads, *self.rows])


def table_of(
    caption: str, items: Iterable[T], columns: Mapping[str, Callable[[T], str]]
) -> TextTable:
    """A table with a row for each of the `items`."""
    rows = [tuple(cell(item) for cell in columns.values()) for item in items]
    return TextTable(caption, tuple(columns), rows)


@dataclass(frozen=True)
class Picture:
    """A figure of the report."""

    name: str  # Of its PNG among the report's figures, without the ending
    alternative: str  # In place of the picture for those who do not see it
    caption: str  # Below it
    narrow: bool = False  # Whether its words can be read at the width of a phone


@dataclass(frozen=True)
class Chart:
    """A figure whose curves the page's script lets a reader move, zoom and switch on and off."""

    picture: Picture  # What is seen without scripts, in print, and before a reader asks for more
    data: Mapping[str, Any]  # The curves, as `impc.studies.charts` makes them


@dataclass(frozen=True)
class Lines:
    """Sentences as a list."""

    lines: Sequence[str]  # One an entry


@dataclass(frozen=True)
class Terms:
    """Terms, and what is said of each."""

    terms: Sequence[tuple[str, Sequence[str]]]  # Each term with its paragraphs


@dataclass(frozen=True)
class Heading:
    """Heading of a part of a section."""

    text: str  # Its words


@dataclass(frozen=True)
class Note:
    """A paragraph that stands out."""

    title: str  # Its first words, in bold
    text: str  # The others


@dataclass(frozen=True)
class Verdict:
    """The one sentence that answers what the page was made for."""

    text: str  # The sentence


@dataclass(frozen=True)
class Details:
    """What is folded until a reader asks for it."""

    summary: str  # What is inside, always shown
    blocks: Sequence[Block]  # What is folded, in this order


#: What a section is made of; a str is a paragraph.
Block = str | TextTable | Picture | Chart | Lines | Terms | Heading | Note | Verdict | Details


@dataclass(frozen=True)
class Section:
    """A section of the page."""

    title: str  # Its heading
    blocks: Sequence[Block]  # What stands in it, in this order
    contents: str = ""  # Its name in the table of contents; without one it is not there
    together: bool = False  # Whether it stays on the page of what is before it when it is printed
    folded: bool = False  # Whether its blocks show only when a reader opens it


@dataclass(frozen=True)
class Report:
    """All that a command leaves behind; nothing is written here."""

    window: str  # Title of the browser's window
    title: str  # First heading
    opening: Sequence[Block]  # Before the first section
    sections: Sequence[Section]
    figures: Mapping[str, bytes] = field(default_factory=dict)  # By the name of the file
    # Written as CSV under these names, and together as tables.xlsx and tables.mat
    tables: Mapping[str, TextTable] = field(default_factory=dict)
    # Content of result.json, beside what every one has (docs/results.md)
    data: Mapping[str, Any] = field(default_factory=dict)
    provenance: Provenance = field(default_factory=Provenance)  # Where the result comes from
    # What the page is about, signals and parameters: with these its glossary begins
    words: Sequence[tuple[str, str]] = ()
    template: str = "page.html"  # page.html, or one that extends it, by its path in this package
    # What such a template names beside the report
    values: Mapping[str, Any] = field(default_factory=dict)

    def page(self) -> str:
        """The page as one HTML text that needs no other file; it ends with its glossary."""
        bare = render_template(self.template, report=self, glossary=Glossary(), **self.values)
        found = Glossary((*self.words, *used_words(bare)))
        return render_template(self.template, report=self, glossary=found, **self.values)

    def source(self, name: str) -> str:
        """The picture `name` as the address of an <img> that needs no other file."""
        return "data:image/png;base64," + base64.b64encode(self.figures[f"{name}.png"]).decode()

    def _together(self) -> dict[str, bytes]:
        """All tables in one file; a sheet of Excel holds so many rows and no more."""
        if not self.tables:
            return {}
        sheets = {
            name: (table.heads, table.rows)
            for name, table in self.tables.items()
            if len(table.rows) < MOST_ROWS
        }
        return {
            "tables.mat": matlab_tables(self.tables),
            **({"tables.xlsx": workbook_bytes(sheets)} if sheets else {}),
        }

    def files(self) -> dict[str, bytes]:
        """Page, result.json, tables and figures by name."""
        return {
            "report.html": self.page().encode(),
            "result.json": json_bytes({"schema": SCHEMA, **self.provenance.data(), **self.data}),
            **{f"{name}.csv": table.csv() for name, table in self.tables.items()},
            **self._together(),
            **self.figures,
        }


def json_bytes(content: Mapping[str, Any]) -> bytes:
    """The `content` of result.json, UTF-8; what is not a number is null."""
    return (json.dumps(plain(content), indent=1, allow_nan=False) + "\n").encode()


_LONGEST = 63


def matlab_tables(tables: Mapping[str, TextTable]) -> bytes:
    """The bytes of a .mat file of version 5."""
    content = {}
    for name, table in zip(_names(list(tables)), tables.values(), strict=True):
        columns = list(zip(*table.rows, strict=True)) or [()] * len(table.heads)
        fields = zip(_names(table.heads), columns, strict=True)
        content[name] = {field: _column(values) for field, values in fields}
    stream = io.BytesIO()
    save: Any = scipy.io.savemat  # its stubs know paths only
    save(stream, content, long_field_names=True, oned_as="column")
    return stream.getvalue()


def _names(given: Sequence[str]) -> list[str]:
    """Names that MATLAB takes; what becomes the same is told apart by a number."""
    found: list[str] = []
    for text in given:
        name = re.sub(r"\W", "_", text, flags=re.ASCII)
        name = (name if re.match("[A-Za-z]", name) else f"x{name}")[:_LONGEST]
        count = 1
        while name in found:
            count += 1
            name = f"{name[: _LONGEST - 4]}_{count}"
        found.append(name)
    return found


def _column(values: Sequence[Any]) -> Any:
    numbers = [math.nan if value is None else value for value in values]
    if all(isinstance(value, int | float) for value in numbers):
        return np.array(numbers, dtype=np.float64)[:, None]
    cells = np.empty((len(numbers), 1), dtype=object)
    cells[:, 0] = [str(value) for value in values]
    return cells
