"""Every table that is written as CSV.

A spreadsheet takes a cell that begins with = + - or @ for a formula, and runs it; names come from
files of others. Numbers stay numbers, and text that would be taken for a formula gets an
apostrophe (`text_cell`), which spreadsheets know as the mark of text.
"""

from __future__ import annotations

import csv
import io
import math
import re
from typing import TYPE_CHECKING, Any

from impc.errors import one_line
from impc.files.delimited import text_cell

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

_NUMBER = r"[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?"
# What the project writes itself: no value; a number, with a unit, with an interval.
_HARMLESS = re.compile(
    rf"-|{_NUMBER}%?( [a-z]+[²³]?)?( \({_NUMBER}, {_NUMBER}\))?|[+-]?(inf|nan)", re.IGNORECASE
)
_ANY_LENGTH = 10**9


def csv_bytes(heads: Sequence[Any], rows: Iterable[Sequence[Any]]) -> bytes:
    """The table of these `heads` and `rows` as CSV in UTF-8; None and NaN are empty cells."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow([_cell(head) for head in heads])
    writer.writerows([_cell(value) for value in row] for row in rows)
    return stream.getvalue().encode()


def _cell(value: Any) -> Any:
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return ""
    if not isinstance(value, str):
        return value
    return one_line(value if _HARMLESS.fullmatch(value) else text_cell(value), _ANY_LENGTH)
