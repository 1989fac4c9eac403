"""A finding: what one assessment says, as one value.

Page, CSV, workbook and result.json are made from the list of findings (`impc.reporting.document`):
a new assessment is one function that returns a `Finding`, and one line in the sections of a page.
"""

from __future__ import annotations

import enum
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
from impc.reporting.rendering import fixed, number

T = TypeVar("T")


class Level(enum.Enum):
    """How far a finding restricts what may be said of the subject."""

    GREEN = "green"  # Nothing speaks against it
    AMBER = "amber"  # Some statements must not be made
    RED = "red"  # Nothing may be said about the person's control
    NOTE = "note"  # For information


@dataclass(frozen=True)
class Picture:
    """A figure of the report."""

    name: str  # Of its drawing among the report's figures
    alternative: str  # In place of the picture for those who do not see it
    caption: str  # Below it
    phone: bool = True  # Whether it has a drawing for the width of a phone


@dataclass(frozen=True)
class Chart:
    """Curves that a reader may zoom, move and switch on and off; without scripts nothing of it."""

    title: str
    data: Mapping[str, Any]  # The curves, as `impc.studies.charts` makes them


@dataclass(frozen=True, eq=False)
class Finding:
    """Name, table, sentences and figure of one assessment, and how far it restricts a report.

    Heads of the table are words joined by `_`, which R and MATLAB take for names, and numbers are
    numbers in the units of the plant. `p` and heads that begin with `p_` are of probabilities.
    """

    name: str  # Key in result.json, name of the CSV file and of the sheet
    table: pd.DataFrame | None = None
    caption: str = ""  # Above the table
    sentences: Sequence[str] = ()  # Before the figure
    figure: Picture | Chart | None = None
    level: Level = Level.NOTE
    folded: str = ""  # What the table is called where a reader has to unfold it on the page
    digits: int = 4  # Of its numbers on the page
    # Heads for readers, by the names of columns; others are their names in words
    labels: Mapping[str, str] = field(default_factory=dict)
    hidden: Sequence[str] = ()  # Columns that stand in the files alone
    links: Mapping[str, str] = field(default_factory=dict)  # Addresses of first cells, on the page
    badges: Mapping[str, Level] = field(default_factory=dict)  # Cells that are badges on the page

    @property
    def shown(self) -> list[str]:
        """The columns of the page."""
        names = [] if self.table is None else list(map(str, self.table.columns))
        return [name for name in names if name not in self.hidden]

    @property
    def heads(self) -> list[str]:
        """Heads of the table for readers."""
        words = {name: name.replace("percent", "(%)").replace("_", " ") for name in self.shown}
        heads = [self.labels.get(name, words[name]) for name in self.shown]
        return [head[:1].upper() + head[1:] for head in heads]

    @property
    def rows(self) -> list[list[str]]:
        """Cells of the table for readers."""
        if self.table is None:
            return []
        columns = [
            [_shown(name, value, self.digits) for value in self.table[name]] for name in self.shown
        ]
        return [list(row) for row in zip(*columns, strict=True)]

    def text(self) -> str:
        """The table in columns of a fixed width, for a terminal."""
        return in_columns([self.heads, *self.rows])

    def data(self) -> dict[str, Any]:
        """For result.json."""
        table = {} if self.table is None else {"table": self.table.to_dict("list")}
        return {"level": self.level.value, "sentences": list(self.sentences), **table}


def table_of(items: Iterable[T], columns: Mapping[str, Callable[[T], Any]]) -> pd.DataFrame:
    """A table with a row for each of the `items`; every column has its name and its function."""
    found = list(items)
    return pd.DataFrame(
        {name: pd.Series([cell(item) for item in found], dtype=None if found else object)
         for name, cell in columns.items()}
    )  # fmt: skip


def csv_bytes(table: pd.DataFrame) -> bytes:
    """A table as CSV in UTF-8 that a spreadsheet may open: none of its texts is a formula."""
    stream = io.StringIO()
    as_data(table).to_csv(stream, index=False, lineterminator="\n")
    return stream.getvalue().encode()


#: Cells of a table that is in the workbook too; a larger one, some seconds to write, is CSV alone.
MOST_CELLS = 200_000


def _shown(column: str, value: Any, digits: int) -> str:
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "-"
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if not isinstance(value, float | np.floating):
        return str(value)
    if re.match(r"p(_|$)", column):
        return "< 0.001" if value < 1e-3 else number(float(value), 2)
    return fixed(float(value), digits)
