"""A report as one value: the sections of its page, and the tables, figures and numbers beside it.

Text is escaped when the page is made. Where a sentence holds a piece of code or a link it is a
`markupsafe.Markup`, whose `format` escapes what is put into it.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

from impc.files.columns import in_columns
from impc.files.results import SCHEMA
from impc.files.workbook import MOST_ROWS, workbook_bytes
from impc.reporting.csv_text import csv_bytes
from impc.reporting.glossary import Glossary, used_words
from impc.reporting.matlab_tables import matlab_tables
from impc.reporting.provenance import Provenance
from impc.reporting.rendering import plain, render_template

__all__ = [
    "Block",
    "Chart",
    "Details",
    "Heading",
    "Lines",
    "Note",
    "Picture",
    "Report",
    "Section",
    "Terms",
    "TextTable",
    "Verdict",
    "json_bytes",
    "table_of",
]

T = TypeVar("T")


@dataclass(frozen=True)
class TextTable:
    """A table of texts, or of numbers when it is only written as CSV.

    Attributes
    ----------
    caption : str
        Above the table.
    heads : sequence of str
        One a column.
    rows : sequence of sequences
        Their first cell is a head of its own.
    """

    caption: str
    heads: Sequence[str]
    rows: Sequence[Sequence[Any]]

    def csv(self) -> bytes:
        """As a file for spreadsheets, without the caption."""
        return csv_bytes(self.heads, self.rows)

    def text(self) -> str:
        """In columns of a fixed width for a terminal, without the caption."""
        return in_columns([self.heads, *self.rows])


def table_of(
    caption: str, items: Iterable[T], columns: Mapping[str, Callable[[T], str]]
) -> TextTable:
    """A table with a row for each of the `items`.

    Parameters
    ----------
    caption : str
        Above it.
    items : iterable
        What the rows are about.
    columns : mapping of str to callable
        Head -> what its cell says of an item.
    """
    rows = [tuple(cell(item) for cell in columns.values()) for item in items]
    return TextTable(caption, tuple(columns), rows)


@dataclass(frozen=True)
class Picture:
    """A figure of the report.

    Attributes
    ----------
    name : str
        Of its PNG among the report's figures, without the ending.
    alternative : str
        In place of the picture for those who do not see it.
    caption : str
        Below it.
    narrow : bool
        Whether its words can be read at the width of a phone.
    """

    name: str
    alternative: str
    caption: str
    narrow: bool = False


@dataclass(frozen=True)
class Chart:
    """A figure whose curves the page's script lets a reader move, zoom and switch on and off.

    Attributes
    ----------
    picture : Picture
        What is seen without scripts, in print, and before a reader asks for more.
    data : mapping
        The curves, as `impc.studies.charts` makes them.
    """

    picture: Picture
    data: Mapping[str, Any]


@dataclass(frozen=True)
class Lines:
    """Sentences as a list.

    Attributes
    ----------
    lines : sequence of str
        One an entry.
    """

    lines: Sequence[str]


@dataclass(frozen=True)
class Terms:
    """Terms, and what is said of each.

    Attributes
    ----------
    terms : sequence of (str, sequence of str)
        Each term with its paragraphs.
    """

    terms: Sequence[tuple[str, Sequence[str]]]


@dataclass(frozen=True)
class Heading:
    """Heading of a part of a section.

    Attributes
    ----------
    text : str
        Its words.
    """

    text: str


@dataclass(frozen=True)
class Note:
    """A paragraph that stands out.

    Attributes
    ----------
    title : str
        Its first words, in bold.
    text : str
        The others.
    """

    title: str
    text: str


@dataclass(frozen=True)
class Verdict:
    """The one sentence that answers what the page was made for.

    Attributes
    ----------
    text : str
        The sentence.
    """

    text: str


@dataclass(frozen=True)
class Details:
    """What is folded until a reader asks for it.

    Attributes
    ----------
    summary : str
        What is inside, always shown.
    blocks : sequence of Block
        What is folded, in this order.
    """

    summary: str
    blocks: Sequence[Block]


#: What a section is made of; a str is a paragraph.
Block = str | TextTable | Picture | Chart | Lines | Terms | Heading | Note | Verdict | Details


@dataclass(frozen=True)
class Section:
    """A section of the page.

    Attributes
    ----------
    title : str
        Its heading.
    blocks : sequence of Block
        What stands in it, in this order.
    contents : str
        Its name in the table of contents; without one it is not there.
    together : bool
        Whether it stays on the page of what is before it when it is printed.
    folded : bool
        Whether its blocks show only when a reader opens it.
    """

    title: str
    blocks: Sequence[Block]
    contents: str = ""
    together: bool = False
    folded: bool = False


@dataclass(frozen=True)
class Report:
    """All that a command leaves behind; nothing is written here.

    Attributes
    ----------
    window : str
        Title of the browser's window.
    title : str
        First heading.
    opening : sequence of Block
        Before the first section.
    sections : sequence of Section
    figures : mapping of str to bytes
        By the name of the file.
    tables : mapping of str to TextTable
        Written as CSV under these names, and together as tables.xlsx and tables.mat.
    data : mapping
        Content of result.json, beside what every one has (docs/results.md).
    provenance : Provenance
        Where the result comes from.
    words : sequence of (str, str)
        What the page is about, signals and parameters: with these its glossary begins.
    template : str
        page.html, or one that extends it, by its path in this package.
    values : mapping
        What such a template names beside the report.
    """

    window: str
    title: str
    opening: Sequence[Block]
    sections: Sequence[Section]
    figures: Mapping[str, bytes] = field(default_factory=dict)
    tables: Mapping[str, TextTable] = field(default_factory=dict)
    data: Mapping[str, Any] = field(default_factory=dict)
    provenance: Provenance = field(default_factory=Provenance)
    words: Sequence[tuple[str, str]] = ()
    template: str = "page.html"
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
