"""Content of a report: verdict, sections of the page, figures, and files.

Text is escaped when the page is rendered. Sentences with code or links are `markupsafe.Markup`,
whose `format` escapes its arguments.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import pandas as pd
from markupsafe import Markup

from impc.files.results import SCHEMA
from impc.files.spreadsheet import workbook_bytes
from impc.levels import Level
from impc.reporting.exchange import mat_bytes
from impc.reporting.finding import MOST_CELLS, Chart, Finding, Moving, Picture, csv_bytes
from impc.reporting.provenance import Provenance
from impc.reporting.rendering import plain, render_page
from impc.reporting.style import drawn, inline
from impc.reporting.verdict import Alert, Key, Verdict

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Lines:
    """Sentences as a numbered list."""

    lines: Sequence[str]


@dataclass(frozen=True)
class Terms:
    """Pairs of a term and its description."""

    terms: Sequence[tuple[str, str]]


@dataclass(frozen=True)
class Quiet:
    """Explanation why an expected result is not shown."""

    text: str


@dataclass(frozen=True)
class Check:
    """One check and its outcome."""

    level: Level
    name: str
    text: str


@dataclass(frozen=True)
class Checks:
    """List of checks."""

    checks: Sequence[Check]


@dataclass(frozen=True)
class Fold:
    """Collapsible part of the page."""

    summary: str  # Title, always visible
    blocks: Sequence[Block]


#: Content of a section; a str is a paragraph.
Block = str | Finding | Picture | Chart | Moving | Lines | Terms | Quiet | Checks | Alert | Fold


@dataclass(frozen=True)
class Section:
    """A section of the page."""

    title: str  # Heading
    blocks: Sequence[Block]
    contents: str = ""  # Name in the table of contents; default: the title

    @property
    def anchor(self) -> str:
        """HTML id of the section."""
        words = self.contents or self.title
        return "".join(mark if mark.isalnum() else "-" for mark in words.lower())


@dataclass(frozen=True)
class Copy:
    """Text to copy into a paper."""

    methods: str
    results: str


#: Function that draws a figure.
Draw = Callable[[], "Figure"]


@dataclass(frozen=True)
class Report:
    """Content of all files that a command writes."""

    window: str  # Title of the browser window
    kind: str  # For example "fit report"
    verdict: Verdict
    sections: Sequence[Section]
    meta: Sequence[str] = ()  # Line above the verdict: subject, number of trials, date
    hero: Picture | None = None  # Figure next to the verdict
    keys: Sequence[Key] = ()  # Key numbers at the top of the page
    figures: Mapping[str, Draw] = field(default_factory=dict)
    copy: Copy | str | None = None  # Text for a paper, or the reason why there is none
    beside: Sequence[Finding] = ()  # Tables that are written as files and not shown on the page
    # Content of result.json in addition to findings and common keys (docs/ref/results.md)
    data: Mapping[str, Any] = field(default_factory=dict)
    provenance: Provenance = field(default_factory=Provenance)

    def page(self) -> str:
        """Self-contained HTML page."""
        return render_page(self, any(isinstance(one, Chart) for one in self._blocks()))

    def picture(self, shown: Picture) -> Markup:
        """Inline SVG of a figure."""
        return inline(self._drawn[shown.name], shown.name, shown.alternative)

    @functools.cached_property
    def _drawn(self) -> dict[str, bytes]:
        """Figures, drawn once for page and files."""
        return {name: drawn(draw, "svg") for name, draw in self.figures.items()}

    def findings(self) -> list[Finding]:
        """Findings of the page, in page order."""
        return [one for one in self._blocks() if isinstance(one, Finding)]

    def _blocks(self) -> list[Block]:
        return _flat([item for section in self.sections for item in section.blocks])

    def files(self, *, pdf: bool = False) -> dict[str, bytes]:
        """Files by name: page, result.json, tables, .mat, figures; with `pdf` also PDF figures."""
        every = [*self.findings(), *self.beside]
        tables = {one.name: one.table for one in every if one.table is not None}
        # Hidden columns keep their own names, so that no heading is there twice.
        heads = {
            one.name: {name: head for name, head in one.labels.items() if name not in one.hidden}
            for one in every
        }
        sheets = {
            name: one.rename(columns=heads[name])
            for name, one in tables.items()
            if one.size <= MOST_CELLS
        }
        found = {item.name: item.data() for item in self.findings()}
        own = {"schema": SCHEMA, **self.provenance.data(), "verdict": self.verdict.data()}
        figures = {f"figures/{name}.svg": svg for name, svg in self._drawn.items()}
        if pdf:
            figures |= {
                f"figures/{name}.pdf": drawn(draw, "pdf") for name, draw in self.figures.items()
            }
        return {
            "report.html": self.page().encode(),
            "result.json": json_bytes({**own, **self.data, "findings": found}),
            **{f"{name}.csv": csv_bytes(table) for name, table in tables.items()},
            **({"results.mat": mat_bytes({**own, **self.data}, tables)} if tables else {}),
            **({"tables.xlsx": workbook_bytes(sheets, self._readme(sheets))} if sheets else {}),
            **figures,
        }

    def _readme(self, sheets: Mapping[str, pd.DataFrame]) -> pd.DataFrame:
        """First sheet of the workbook: verdict, command, and a description of each sheet."""
        captions = {item.name: item.caption for item in [*self.findings(), *self.beside]}
        rows = [
            ("verdict", f"{self.verdict.words}: {self.verdict.headline}"),
            ("made", f"{self.provenance.made}, impc {self.provenance.versions['impc']}"),
            ("command", self.provenance.command),
            *((name, captions[name]) for name in sheets),
        ]
        return pd.DataFrame(rows, columns=["sheet", "contents"])


def _flat(blocks: Sequence[Block]) -> list[Block]:
    found: list[Block] = []
    for item in blocks:
        inside: Sequence[Block] = ()
        if isinstance(item, Fold):
            inside = item.blocks
        elif isinstance(item, Finding) and item.figure is not None:
            inside = (item.figure,)
        found += [item, *_flat(inside)]
    return found


def json_bytes(content: Mapping[str, Any]) -> bytes:
    """The `content` of result.json in UTF-8; NaN and infinity become null."""
    return (json.dumps(plain(content), indent=1, allow_nan=False) + "\n").encode()
