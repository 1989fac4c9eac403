"""Numbers of a column of texts or cells: decimal signs, thousands, missing values, and clocks.

A clock is a time (0:01.50, 10:15:00.000, 3:15 PM), with or without a date, and becomes seconds
after the first. A thousands point, comma, blank or apostrophe counts where the decimal sign is
another one. Marks of a missing value become NaN; a word that is repeated among numbers does too,
with a note.
"""

from __future__ import annotations

import datetime
import functools
import re
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

from impc.arrays import Array
from impc.errors import DataError
from impc.files.alignment import unwrapped

#: Kinds of a cell.
EMPTY, NUMBER, WORD = 0, 1, 2

# Possessive quantifiers (++): without them, 50 000 digits and a letter take minutes.
_NUMBER = r"[+-]?(\d++[{0}]?\d*+|[{0}]\d++)(e[+-]?\d++)?|[+-]?inf(inity)?"
_GROUPED = r"[+-]?[1-9]\d{{0,2}}(?:{1}\d{{3}})(?:{1}\d{{3}})*+(?:[{0}]\d*+)?"
_GROUPS = {".": "[,\u2009\u202f\u00a0 '’]", ",": "[.\u2009\u202f\u00a0 '’]"}
_NUMBERS = {
    sign: (re.compile(_NUMBER.format(sign), re.IGNORECASE),
           re.compile(_GROUPED.format(sign, group)))
    for sign, group in _GROUPS.items()
}  # fmt: skip
# Texts for a missing number, including errors of spreadsheets and of C; of a spreadsheet in any
# language, and marks without a letter or digit.
_MISSING = re.compile(
    r"[+-]?nan(\(\w*\))?|na|n/a|null|none|nil|[+-]?1[.,]#[a-z]+\d*"
    r"|(?-i:#N/?[AV]|#[A-ZÄÖÜ0/]{3,9}[!?])",
    re.IGNORECASE,
)
_MARK = re.compile(r"[^\w\s\"'#%]{1,4}")
# Kinds of a column. The day of a clock, AM and PM and the zone need no reading: a recording is
# shorter than its clock's turn, so each fall by one is the next turn.
_DATES, _CLOCKS, _PLAIN = "dates", "clocks", "numbers"
_DATE = re.compile(r"\d{1,4}[-/.]\d\d?[-/.](\d{4}|\d\d)")
_CLOCK = re.compile(
    r"(?:(?P<date>(?=[^:]*\d)[\w,./ -]{5,30}?)(?:[t_]|,?\s)\s*)?"
    r"(?:(?P<hour>\d{1,4}):)?(?P<minute>\d{1,3}):(?P<second>\d\d?)"
    r"(?:[.,](?P<part>\d{0,12})|:(?P<milli>\d{3}))?\s*(?P<half>[ap]\.?\s?m\.?)?"
    r"\s*(?:z|utc|[a-z]{2,3}t|[+-]\d\d(?::?\d\d)?)?",
    re.IGNORECASE,
)
# Where the text of a clock may begin anew: at an hour, at noon and at midnight, s.
_TURNS = (3600.0, 43_200.0, 86_400.0)


def number(text: str, decimal: str) -> float | None:
    """Number of a text with this `decimal` sign; NaN if it is missing, None if it is a word."""
    plain, grouped = _NUMBERS[decimal]
    if plain.fullmatch(text):
        return float(text.replace(decimal, "."))
    if not text or _MISSING.fullmatch(text):
        return np.nan
    if grouped.fullmatch(text):
        return float(re.sub(_GROUPS[decimal], "", text).replace(decimal, "."))
    return None


def certain(text: str, decimal: str) -> bool:
    """Whether a text is a clock, or a number not only by its thousands with this `decimal` sign."""
    if number(text, decimal) is None:
        return clock(text) is not None
    return decimal in text or bool(_NUMBERS[decimal][0].fullmatch(text))


def kind_of(cell: Any, *decimals: str) -> int:
    """Kind of a text or cell; a number may have one of the `decimals` signs."""
    if not isinstance(cell, str):
        return EMPTY if cell is None else WORD if isinstance(cell, bool) else NUMBER
    text = cell.strip()
    if not text or _MARK.fullmatch(text):
        return EMPTY
    if any(number(text, sign) is not None for sign in decimals):
        return NUMBER
    return NUMBER if clock(text) is not None else WORD


@functools.lru_cache(maxsize=2)  # a cell is asked for its kind, and then for its number
def clock(text: str) -> tuple[str, float] | None:
    """Kind of a clock or date, and its seconds; None if a text is neither."""
    if len(text) > 40 or not (found := _CLOCK.fullmatch(text)):
        return (_DATES, 0.0) if _DATE.fullmatch(text) else None
    hour, minute, second = (int(found[key] or 0) for key in ("hour", "minute", "second"))
    if found["hour"] is None and (found["date"] or found["half"]):
        hour, minute, second = minute, second, 0  # hours and minutes
    if second > 59 or (minute > 59 and found["hour"]):
        return None
    part = float(f"0.{found['part'] or found['milli'] or 0}")
    return _CLOCKS, 3600.0 * hour + 60.0 * minute + second + part


class Column:
    """The numbers of a column, whose cells are added from the top."""

    def __init__(self, rows: int, decimal: str) -> None:
        self.values: Array = np.full(rows, np.nan)
        self.decimal = decimal
        self.signs = False  # whether some of its numbers may have a decimal sign
        self._filled = 0
        self._kinds: set[str] = set()
        self._words = Counter[str]()
        self._first = (0, "")  # row and text of the first word
        self._last = 0  # row of the last word

    @property
    def empty(self) -> bool:
        """Whether it has no value and no word."""
        return not self._kinds and not self._words

    @property
    def numeric(self) -> bool:
        """Whether it has numbers or clocks."""
        return bool(self._kinds)

    @property
    def words(self) -> bool:
        """Whether it has words."""
        return bool(self._words)

    def add(self, cells: Sequence[Any] | Array) -> None:
        """Add numbers, or cells: texts, numbers, dates, times and truth values."""
        start, self._filled = self._filled, self._filled + len(cells)
        if isinstance(cells, np.ndarray) and cells.dtype.kind in "fiu":
            self.values[start : self._filled] = cells
            self.signs |= cells.dtype.kind == "f"
            self._kinds |= set() if np.isnan(cells).all() else {_PLAIN}
            return
        for row, cell in enumerate(cells, start):
            if cell is None or (isinstance(cell, float) and np.isnan(cell)):
                continue
            value = self._value(cell)
            if value is not None:
                self.values[row] = value
                continue
            word = str(cell).strip()[:20]
            if not self._words:
                self._first = row, word
            self._words[word] += 1
            self._last = row

    def _value(self, cell: Any) -> float | None:
        """Number of a cell, which may be a clock; None for a word."""
        if isinstance(cell, bool | np.bool_):
            return None
        if not isinstance(cell, str):
            timed = _timed(cell)
            if timed is None:
                self._kinds.add(_PLAIN)
                self.signs |= not float(cell).is_integer()
                return float(cell)
        else:
            text = cell.strip()
            self.signs |= self.decimal in text
            value = number(text, self.decimal)
            if value is not None:
                if text:
                    self._kinds.add(_PLAIN)
                return value
            timed = clock(text)
            if timed is None:
                return None
        self._kinds.add(timed[0])
        return timed[1]

    def numbers(
        self, source: str, name: str, where: Callable[[int], str]
    ) -> tuple[Array | str, str]:
        """Numbers or the reason why there are none, and a note; `where` is the place of a row."""
        row, word = self._first
        if not self._kinds:
            if set(self._words) <= {"True", "False"}:
                return "holds true and false", ""
            return f"is text, such as {word!r} in {where(row)}", ""
        if self._kinds == {_DATES}:
            return "holds dates without a time", ""
        note, times = "", self._words.total()
        if times:
            among = f"{times} of {len(self.values)} rows, the first {word!r} in {where(row)}"
            marks = all(_MARK.fullmatch(one) for one in self._words)
            again = len(self._words) == 1 and times > 1 and word not in ("True", "False")
            if not again and not (marks and self._last < len(self.values) - 1):
                remedy = "correct those rows or export the column as numbers"
                raise DataError(source, f"column {name!r} has text in {among}", remedy)
            note = f"column {name!r} has {word!r} in {among[: among.index(', the')]}, from "
            note += f"{where(row)}: read as missing values"
        if _PLAIN in self._kinds and len(self._kinds) > 1:
            problem = f"column {name!r} has {' and '.join(sorted(self._kinds))}"
            raise DataError(source, problem, "save the column as numbers, all of one kind")
        if _PLAIN in self._kinds:
            return self.values, note
        turned, turn = unwrapped(self.values, _TURNS)
        finite = turned[np.isfinite(turned)]
        if turn:
            note = f"clock {name!r} begins anew every {turn / 3600:g} hours: continued {note}"
        return turned - finite[0], note.strip()

    @property
    def grouped(self) -> bool:
        """Whether each of its numbers that has a decimal sign has three digits behind it."""
        sizes = np.abs(self.values[np.isfinite(self.values)])
        parts = sizes[sizes % 1 != 0]
        three = np.abs(1000 * parts - np.rint(1000 * parts)) < 1e-6
        return self.signs and bool(np.all(three & (parts > 1) & (parts < 1000)))

    @property
    def timed(self) -> bool:
        """Whether it holds clocks, which are read in seconds."""
        return _CLOCKS in self._kinds


def _timed(cell: Any) -> tuple[str, float] | None:
    """Kind and seconds of a date or time of a workbook; None for a number."""
    if isinstance(cell, datetime.timedelta):
        return _CLOCKS, cell.total_seconds()
    if isinstance(cell, datetime.time | datetime.datetime):
        seconds = cell.hour * 3600 + cell.minute * 60 + cell.second + cell.microsecond / 1e6
        return _CLOCKS, seconds
    # A time that is exactly midnight is a date there.
    return (_DATES, 0.0) if isinstance(cell, datetime.date) else None


def require_no_thousands(
    source: str, name: str, cells: Iterable[tuple[str, str]], decimal: str
) -> None:
    """Reject a column whose `decimal` sign may be a thousands separator; `cells`: place and text.

    That is possible if the sign always stands before three digits and behind one to three that do
    not begin with 0, while other values are whole numbers without it. Programs that write decimals
    write 999.000 or 1. there.
    """
    grouped = re.compile(rf"[+-]?[1-9]\d{{0,2}}(?:{re.escape(decimal)}\d{{3}})+")
    whole, first = False, ("", "")
    for place, text in cells:
        if decimal not in text:
            whole |= text.lstrip("+-").isdigit()
        elif not grouped.fullmatch(text):
            return  # certainly decimals
        elif not first[0]:
            first = place, text
    if whole and first[0]:
        raise DataError(
            source,
            f"column {name!r} has whole numbers, and {first[1]!r} in {first[0]} can be a decimal "
            "or thousands",
            "export it without thousands separators, or with equal decimals in every row",
        )
