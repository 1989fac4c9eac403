"""Result of one assessment, from which page, CSV, workbook and result.json are made.

To add an assessment, write a function that returns a `Finding` and add it to a section of a page.
"""

from __future__ import annotations

import io
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np
import pandas as pd

from impc.files.spreadsheet import as_data
from impc.files.table import in_columns
from impc.levels import Level
from impc.reporting.rendering import fixed, p_value, sentence_case

T = TypeVar("T")


@dataclass(frozen=True)
class Picture:
    """A figure of the report."""

    name: str  # Key among the report's figures
    alternative: str  # Text alternative for screen readers
    caption: str


@dataclass(frozen=True)
class Chart:
    """Interactive curves; empty if scripts are disabled."""

    title: str
    data: Mapping[str, Any]  # Curves in the form of `impc.studies.charts`


@dataclass(frozen=True)
class Moving:
    """A body that a script moves over time; still figures in print."""

    data: Mapping[str, Any]  # In the form of `impc.studies.fit.movement`
    box: str  # SVG view box
    stills: Sequence[tuple[str, int]]  # Words and frame
    caption: str


@dataclass(frozen=True, eq=False)
class Finding:
    """Result of one assessment: table, sentences, figure, and level of restriction.

    Column names are words joined by `_`, valid names in R and MATLAB; numbers are in the units of
    the plant. Column `p` and columns that begin with `p_` hold p-values.
    """

    name: str  # Key in result.json, name of the CSV file and of the sheet
    table: pd.DataFrame | None = None
    caption: str = ""  # Above the table
    sentences: Sequence[str] = ()  # Before the figure
    figure: Picture | Chart | None = None
    level: Level = Level.NOTE
    folded: str = ""  # Title if the table is collapsed on the page
    digits: int = 4  # Significant digits on the page
    # Column headings by column name; default: the name with spaces
    labels: Mapping[str, str] = field(default_factory=dict)
    hidden: Sequence[str] = ()  # Columns that are written to files only
    links: Mapping[str, str] = field(default_factory=dict)  # Link targets by text of the first cell
    badges: Mapping[str, Level] = field(default_factory=dict)  # Cell texts that are shown as badges

    @property
    def shown(self) -> list[str]:
        """Names of the columns on the page."""
        names = [] if self.table is None else list(map(str, self.table.columns))
        return [name for name in names if name not in self.hidden]

    @property
    def heads(self) -> list[str]:
        """Column headings on the page."""
        words = {name: name.replace("percent", "(%)").replace("_", " ") for name in self.shown}
        return [sentence_case(self.labels.get(name, words[name])) for name in self.shown]

    @property
    def rows(self) -> list[list[str]]:
        """Formatted cells, row by row."""
        if self.table is None:
            return []
        columns = [
            [_shown(name, value, self.digits) for value in self.table[name]] for name in self.shown
        ]
        return [list(row) for row in zip(*columns, strict=True)]

    def text(self) -> str:
        """Table in fixed-width columns for a terminal."""
        return in_columns([self.heads, *self.rows])

    def data(self) -> dict[str, Any]:
        """Entry in result.json."""
        table = {} if self.table is None else {"table": self.table.to_dict("list")}
        return {"level": self.level.value, "sentences": list(self.sentences), **table}


def table_of(items: Iterable[T], columns: Mapping[str, Callable[[T], Any]]) -> pd.DataFrame:
    """Table with one row per item; `columns` maps each name to the function of its cells."""
    found = list(items)
    return pd.DataFrame(
        {name: pd.Series([cell(item) for item in found], dtype=None if found else object)
         for name, cell in columns.items()}
    )  # fmt: skip


def csv_bytes(table: pd.DataFrame) -> bytes:
    """Table as CSV in UTF-8; texts are escaped so that no spreadsheet runs them as formulas."""
    stream = io.StringIO()
    as_data(table).to_csv(stream, index=False, lineterminator="\n")
    return stream.getvalue().encode()


#: Largest table (cells) in the workbook; larger ones, slow to write, are CSV only.
MOST_CELLS = 20_000


def _shown(column: str, value: Any, digits: int) -> str:
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "-"
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if not isinstance(value, float | np.floating):
        return str(value)
    if re.match(r"p(_|$)", column):
        return p_value(float(value))
    return fixed(float(value), digits)
