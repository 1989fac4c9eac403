"""A report as one value: its verdict, the sections of its page, and the files beside it.

Text is escaped when the page is made. Where a sentence holds a piece of code or a link it is a
`markupsafe.Markup`, whose `format` escapes what is put into it.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import pandas as pd
from markupsafe import Markup
from matplotlib.figure import Figure

from impc.files.results import SCHEMA
from impc.files.spreadsheet import workbook_bytes
from impc.reporting.finding import MOST_CELLS, Chart, Finding, Level, Picture, csv_bytes
from impc.reporting.provenance import Provenance
from impc.reporting.rendering import plain, render_page
from impc.reporting.style import inline, written
from impc.reporting.verdict import Alert, Key, Verdict


@dataclass(frozen=True)
class Lines:
    """Sentences as a list."""

    lines: Sequence[str]  # One an entry


@dataclass(frozen=True)
class Terms:
    """Terms, and what is said of each."""

    terms: Sequence[tuple[str, str]]


@dataclass(frozen=True)
class Quiet:
    """Why something does not stand where a reader looks for it."""

    text: str


@dataclass(frozen=True)
class Check:
    """One line of a list of checks."""

    level: Level
    name: str
    text: str


@dataclass(frozen=True)
class Checks:
    """What was checked, and how it came out."""

    checks: Sequence[Check]


@dataclass(frozen=True)
class Fold:
    """What a reader has to open."""

    summary: str  # What is inside, always shown
    blocks: Sequence[Block]


@dataclass(frozen=True)
class Pair:
    """Two parts beside each other, on a phone below each other."""

    left: Block
    right: Block


#: What a section is made of; a str is a paragraph.
Block = str | Finding | Picture | Chart | Lines | Terms | Quiet | Checks | Alert | Fold | Pair


@dataclass(frozen=True)
class Section:
    """A section of the page."""

    title: str  # Its heading
    blocks: Sequence[Block]  # What stands in it, in this order
    contents: str = ""  # Its name in the contents; by default the title

    @property
    def anchor(self) -> str:
        """Its id on the page."""
        words = self.contents or self.title
        return "".join(mark if mark.isalnum() else "-" for mark in words.lower())


@dataclass(frozen=True)
class Copy:
    """What may be copied into a paper."""

    methods: str
    results: str


#: How a figure is drawn; True for the drawing of a phone.
Draw = Callable[[bool], Figure]


@dataclass(frozen=True)
class Report:
    """All that a command leaves behind; nothing is written here."""

    window: str  # Title of the browser's window
    kind: str  # Such as "fit report"
    verdict: Verdict
    sections: Sequence[Section]
    meta: Sequence[str] = ()  # What the page is about, in a few words each
    hero: Picture | None = None  # Beside the verdict
    keys: Sequence[Key] = ()
    figures: Mapping[str, Draw] = field(default_factory=dict)
    copy: Copy | str | None = None  # Or why there is nothing to copy
    beside: Sequence[Finding] = ()  # Whose tables are written as files and stand on no page
    # Content of result.json beside the findings and what every one has (docs/results.md)
    data: Mapping[str, Any] = field(default_factory=dict)
    provenance: Provenance = field(default_factory=Provenance)  # Where the result comes from

    def page(self) -> str:
        """The page as one HTML text that needs no other file."""
        return render_page(self, any(isinstance(one, Chart) for one in self._blocks()))

    def picture(self, shown: Picture) -> Markup:
        """The drawing of a picture within the page."""
        return inline(self.figures[shown.name], shown.name, shown.alternative, phone=shown.phone)

    def findings(self) -> list[Finding]:
        """Those of the page, in the order in which they stand there."""
        return [one for one in self._blocks() if isinstance(one, Finding)]

    def _blocks(self) -> list[Block]:
        return _flat([item for section in self.sections for item in section.blocks])

    def _tables(self) -> dict[str, pd.DataFrame]:
        found = [*self.findings(), *self.beside]
        return {item.name: item.table for item in found if item.table is not None}

    def files(self, *, pdf: bool = False) -> dict[str, bytes]:
        """Page, result.json, tables and figures by name; with `pdf` the figures as PDF too."""
        tables = self._tables()
        heads = {one.name: one.labels for one in [*self.findings(), *self.beside]}
        sheets = {
            name: one.rename(columns=heads[name])
            for name, one in tables.items()
            if one.size <= MOST_CELLS
        }
        found = {item.name: item.data() for item in self.findings()}
        own = {"schema": SCHEMA, **self.provenance.data(), "verdict": self.verdict.data()}
        drawn = {
            f"figures/{name}.{kind}": written(draw, kind)
            for name, draw in self.figures.items()
            for kind in (("svg", "pdf") if pdf else ("svg",))
        }
        return {
            "report.html": self.page().encode(),
            "result.json": json_bytes({**own, **self.data, "findings": found}),
            **{f"{name}.csv": csv_bytes(table) for name, table in tables.items()},
            **({"tables.xlsx": workbook_bytes(sheets, self._readme(sheets))} if sheets else {}),
            **drawn,
        }

    def _readme(self, sheets: Mapping[str, pd.DataFrame]) -> pd.DataFrame:
        """The first sheet: what the workbook is, and what each other sheet holds."""
        captions = {item.name: item.caption for item in [*self.findings(), *self.beside]}
        rows = [
            ("verdict", f"{self.verdict.words}: {self.verdict.headline}"),
            ("made", f"{self.provenance.made}, impc {self.provenance.versions['impc']}"),
            ("command", self.provenance.command),
            *((name, captions[name]) for name in sheets),
        ]
        return pd.DataFrame(rows, columns=["sheet", "what it holds"])


def _flat(blocks: Sequence[Block]) -> list[Block]:
    found: list[Block] = []
    for item in blocks:
        inside: Sequence[Block] = ()
        if isinstance(item, Fold):
            inside = item.blocks
        elif isinstance(item, Pair):
            inside = (item.left, item.right)
        elif isinstance(item, Finding) and item.figure is not None:
            inside = (item.figure,)
        found += [item, *_flat(inside)]
    return found


def json_bytes(content: Mapping[str, Any]) -> bytes:
    """The `content` of result.json, UTF-8; what is not a number is null."""
    return (json.dumps(plain(content), indent=1, allow_nan=False) + "\n").encode()
