"""A report as one value: the sections of its page, and the tables, figures and numbers beside it.

Text is escaped when the page is made. Where a sentence holds a piece of code or a link it is a
`markupsafe.Markup`, whose `format` escapes what is put into it.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import pandas as pd

from impc.files.results import SCHEMA
from impc.files.spreadsheet import workbook_bytes
from impc.reporting.finding import (
    MOST_CELLS,
    Chart,
    Finding,
    Picture,
    csv_bytes,
)
from impc.reporting.glossary import Glossary, used_words
from impc.reporting.provenance import Provenance
from impc.reporting.rendering import plain, render_page


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
Block = str | Finding | Picture | Chart | Lines | Terms | Heading | Note | Verdict | Details


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
    beside: Sequence[Finding] = ()  # Whose tables are written as files and stand on no page
    # Content of result.json beside the findings and what every one has (docs/results.md)
    data: Mapping[str, Any] = field(default_factory=dict)
    provenance: Provenance = field(default_factory=Provenance)  # Where the result comes from
    # What the page is about, signals and parameters: with these its glossary begins
    words: Sequence[tuple[str, str]] = ()

    def page(self) -> str:
        """The page as one HTML text that needs no other file; it ends with its glossary."""
        bare = render_page(report=self, glossary=Glossary())
        found = Glossary((*self.words, *used_words(bare)))
        return render_page(report=self, glossary=found)

    def source(self, name: str) -> str:
        """The picture `name` as the address of an <img> that needs no other file."""
        return "data:image/png;base64," + base64.b64encode(self.figures[f"{name}.png"]).decode()

    def findings(self) -> list[Finding]:
        """Those of the page, in the order in which they stand there."""
        blocks = [*self.opening, *(item for section in self.sections for item in section.blocks)]
        return _findings(blocks)

    def _tables(self) -> dict[str, pd.DataFrame]:
        found = [*self.findings(), *self.beside]
        return {item.name: item.table for item in found if item.table is not None}

    def files(self) -> dict[str, bytes]:
        """Page, result.json, tables and figures by name."""
        tables = self._tables()
        sheets = {name: one for name, one in tables.items() if one.size <= MOST_CELLS}
        found = {item.name: item.data() for item in self.findings()}
        own = {"schema": SCHEMA, **self.provenance.data(), **self.data}
        return {
            "report.html": self.page().encode(),
            "result.json": json_bytes({**own, "findings": found} if found else own),
            **{f"{name}.csv": csv_bytes(table) for name, table in tables.items()},
            **({"tables.xlsx": workbook_bytes(sheets)} if sheets else {}),
            **self.figures,
        }


def _findings(blocks: Sequence[Block]) -> list[Finding]:
    found: list[Finding] = []
    for item in blocks:
        if isinstance(item, Finding):
            found.append(item)
        elif isinstance(item, Details):
            found += _findings(item.blocks)
    return found


def json_bytes(content: Mapping[str, Any]) -> bytes:
    """The `content` of result.json, UTF-8; what is not a number is null."""
    return (json.dumps(plain(content), indent=1, allow_nan=False) + "\n").encode()
