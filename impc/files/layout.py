"""Find the block of numbers in rows of text or cells, and the names and units of its columns.

Each cell is a number, a word or empty. The recording begins at the first row whose width and kinds
continue below it. Names and units stand above: ``angle (deg)``, or a row of units. A few rows of
statistics may stand below it; more rows of numbers are an error, as they may be lost samples.
"""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import chain, count
from typing import NamedTuple

import numpy as np

from impc.errors import DataError
from impc.files.cells import EMPTY, NUMBER, WORD, Column, require_no_thousands
from impc.files.table import Table, make_table
from impc.files.units import is_unit

#: Rows among which the first row of numbers must be.
HEAD = 100
# Rows of one shape that make a recording; more if they begin with a word, as settings do.
_SEVERAL, _NAMED = 3, 20
# Rows of numbers below a recording that may be statistics: in all, and without a label.
_BELOW, _UNLABELLED = 12, 3


@dataclass
class Block:
    """Consecutive rows of one shape: index of the first, kind of each column, and counts."""

    first: int
    kinds: list[int] = field(default_factory=list)  # of each column, over all rows
    rows: int = 0
    numbers: int = 0
    words: int = 0

    @property
    def width(self) -> int:
        """Number of columns up to the last one with numbers."""
        return max(
            (place + 1 for place, kind in enumerate(self.kinds) if kind == NUMBER), default=0
        )

    @property
    def share(self) -> float:
        """Share of numbers among the cells that are not empty."""
        return self.numbers / max(self.numbers + self.words, 1)

    @property
    def several(self) -> bool:
        """Whether it has enough rows and mostly numbers."""
        return self.share > 0.5 and self.rows >= (_NAMED if self.kinds[0] == WORD else _SEVERAL)

    def fits(self, row: Sequence[int], after_blank: bool = False) -> bool:
        """Whether a row has the same shape; further or missing cells must not be numbers.

        `after_blank`: behind an empty row, the first number (the clock) must be present.
        """
        if after_blank and row[self.kinds.index(NUMBER) :][:1] != [NUMBER]:
            return False
        if len(row) < self.width or NUMBER in row[len(self.kinds) :]:
            return False
        return not any(
            {kind, own} == {NUMBER, WORD} for kind, own in zip(row, self.kinds, strict=False)
        )

    def add(self, row: Sequence[int]) -> None:
        """Include a row that fits."""
        self.kinds += [EMPTY] * (len(row) - len(self.kinds))
        self.kinds[: len(row)] = [kind or own for kind, own in zip(row, self.kinds, strict=False)]
        self.rows += 1
        self.numbers += row.count(NUMBER)
        self.words += row.count(WORD)

    def ends_at(self, row: Sequence[int], following: Sequence[int], after_blank: bool) -> bool:
        """Whether a row that does not fit ends the block (otherwise it is damaged).

        It ends behind an empty row, at a heading of words, or at a label (as of statistics) if
        the `following` row does not fit either.
        """
        words = NUMBER not in row
        if after_blank or (words and row.count(WORD) > 1):
            return True
        label = WORD in row[: self.kinds.index(NUMBER) + 1]
        return (words or label) and not (following and self.fits(following))


def first_block(rows: Sequence[Sequence[int]], alone: bool) -> Block | None:
    """First block with enough rows and mostly numbers, else the one with most numbers.

    `rows` are kinds from the top of a file; `alone`: a row may be a single number. Rows of the
    same width directly above that begin with a number belong to it: they have a word instead of a
    number.
    """
    blocks: list[Block] = []
    for index, row in enumerate(rows):
        if NUMBER not in row or (len(row) < 2 and not alone):
            continue
        if not (blocks and blocks[-1].first + blocks[-1].rows == index and blocks[-1].fits(row)):
            blocks.append(Block(index))
        blocks[-1].add(row)
    found = [block for block in blocks if block.share >= 0.5 and block.first < HEAD]
    if not found:
        return None
    most = max(found, key=lambda block: block.numbers)
    best = next((block for block in found if block.several), most)
    for above in reversed(blocks[: blocks.index(best)]):
        same = len(above.kinds) == len(best.kinds) and above.kinds[0] == best.kinds[0] == NUMBER
        if not same or above.share < 0.5 or above.first + above.rows != best.first:
            break
        best.first = above.first
    return best


class Row(NamedTuple):
    """A row from the first of a block on."""

    place: str  # such as "line 12"
    text: str
    kinds: Sequence[int] | None  # None if it certainly fits
    after_blank: bool = False
    width: int = 0  # number of its fields


class Extent(NamedTuple):
    """Rows of a block, fields of its longest row, and a note on the rows below."""

    rows: int
    width: int
    note: str = ""


def extent(source: str, block: Block, rows: Iterable[Row], cut_short: bool) -> Extent:
    """Extent of a `block` in its rows and those below; `cut_short`: the last line has no end."""
    left: Iterator[Row] = iter(rows)
    seen, kept, width, blank = 0, 0, len(block.kinds), False
    for row in left:
        blank |= row.after_blank
        if row.kinds is not None and not any(row.kinds):  # counts if rows of numbers follow it
            seen, blank = seen + 1, True
            continue
        if row.kinds is not None and not block.fits(row.kinds, blank):
            following = next(left, None)
            beyond = following.kinds or block.kinds if following else ()
            ends = block.ends_at(row.kinds, beyond, blank)
            cut = following is None and cut_short and row.width < block.width
            cut = cut and not re.match(r"[^\W\d_]{3}", row.text)
            if ends and not cut:
                _require_statistics(source, row, following, left)
                note = f"{row.place} and all below are not read; they begin with "
                return Extent(kept, width, f"{note}{row.text.strip()[:40]!r}")
            if cut or row.width != len(block.kinds):
                said = f"{row.place} has {row.width} values where the first row has "
                said += f"{len(block.kinds)}{': the file ends in the middle of a row' * cut}"
                raise DataError(source, said, "copy or export the file again")
            left = chain([following] if following else [], left)
        seen, width, blank = seen + 1, max(width, row.width), False
        kept = seen
    return Extent(kept, width)


def _require_statistics(source: str, end: Row, following: Row | None, left: Iterator[Row]) -> None:
    """Require that few rows of numbers stand from row `end` on, most of them with a label."""
    numbers = unlabelled = 0
    for row in chain([end], [following] if following else [], left):
        kinds = row.kinds or [NUMBER]
        numbers += NUMBER in kinds
        unlabelled += kinds[0] == NUMBER
        if numbers > _BELOW or unlabelled > _UNLABELLED:
            raise DataError(
                source,
                f"{end.place} ({end.text.strip()[:40]!r}) ends the recording, but more rows of "
                f"numbers follow, such as {row.place} ({row.text.strip()[:40]!r})",
                f"if they belong to it, correct {end.place}; otherwise export each block as a file "
                "of its own",
            )


def table_of(
    source: str,
    above: Sequence[Sequence[str]],
    columns: Sequence[Column],
    where: Callable[[int, int], str],
    texts: Callable[[int], Iterable[tuple[str, str]]],
    *,
    named_rows: bool,
    notes: Sequence[str],
    skipped: dict[str, str],
) -> Table:
    """Table of `columns` with the rows `above` them; `where` is the place of (row, column).

    `texts` are the places and texts of a column, to tell decimals from thousands.
    """
    empty = [column.empty for column in columns]
    heads = find_headings(source, above, [not one.numeric for one in columns], named_rows)
    first = _counts(columns)
    kept, units, said = {}, dict(heads.units), [*heads.notes]
    for place, (name, column) in enumerate(zip(heads.names, columns, strict=True)):
        known = name or f"column_{place + 1}"
        if empty[place]:
            skipped |= {name: "is empty"} if name else {}
            continue

        def at(row: int, place: int = place) -> str:
            return where(row, place)

        found, note = column.numbers(source, known, at)
        said += [note] if note else []
        if isinstance(found, str):
            skipped[known] = found
            continue
        if column.grouped:
            require_no_thousands(source, known, texts(place), column.decimal)
        kept[known] = found[first:]
        kept[known].flags.writeable = False  # used without a copy
        units |= {known: "s"} if column.timed else {}
    return make_table(source, kept, units, None, skipped, (*said, *filter(None, notes)))


def _counts(columns: Sequence[Column]) -> int:
    """1 if the first row holds the number of rows below it (AcqKnowledge), otherwise 0."""
    first = [one.values[0] for one in columns if one.numeric and not np.isnan(one.values[0])]
    rows = len(columns[0].values)
    return int(rows > _NAMED and {*first} == {rows - 1.0})


# Lines that may end the settings of a file without headings (LabVIEW, OpenSim).
_NO_HEAD = ("endofheader", "endheader")
_TITLES, _UNITS = "ChannelTitle=", "UnitName="
# Columns that rows may omit where they are empty.
_REMARKS = ("comment", "comments", "kommentar", "event", "events", "note", "notes", "remarks")

# A unit in brackets, or behind a comma or slash: "tilt (deg)", "tilt, deg", "tilt / deg".
_HEADING = re.compile(r"(.*\S)\s*[(\[]([^()\[\]]*)[)\]]|(.*\S)(?:, ?| / )([^,]+)")


def split_heading(heading: str) -> tuple[str, str]:
    """Name and unit of a heading such as ``angle (deg)``; the unit may be empty."""
    found = _HEADING.fullmatch(heading.strip())
    name, unit = [part for part in found.groups() if part is not None] if found else ("", "")
    return (name, unit.strip()) if is_unit(unit) else (heading.strip(), "")


def written_heading(name: str, unit: str | None) -> str:
    """Heading of `name` and `unit`, the inverse of `split_heading`."""
    return f"{name} ({unit})" if unit else name


def are_units(row: Sequence[str]) -> bool:
    """Whether a row of headings contains units only."""
    plain = [_bare(item) for item in row]
    return any(plain) and all(not item or is_unit(item) for item in plain)


class Headings(NamedTuple):
    """Headings above the numbers."""

    names: list[str]  # of all columns; empty for a column without a name
    units: dict[str, str]  # of the columns that have one
    notes: tuple[str, ...] = ()  # names that differ from those of the file


def find_headings(
    source: str, above: Sequence[Sequence[str]], empty: Sequence[bool], named_rows: bool
) -> Headings:
    """Names and units from the rows `above` the numbers, the last of which are the header.

    `empty`: columns without values; `named_rows`: the first column may hold row names without a
    heading; `source`: file, for messages.
    """
    width = len(empty)
    rows = [row for row in map(_trimmed, above) if row]
    if rows and rows[-1][0].strip("*_ ").lower().replace("_", "") in _NO_HEAD:
        rows = []
    units: Sequence[str] = ()
    if titles := [row for row in rows if row[0] == _TITLES]:  # of LabChart, above their units
        units = next((["", *row[1:]] for row in rows if row[0] == _UNITS), ())
        rows = [["time", *titles[0][1:]]]
    if len(rows) > 1 and len(rows[-1]) <= width and are_units(rows[-1]) and not are_units(rows[-2]):
        units = rows.pop()
    if not rows:
        return Headings([f"column_{place + 1}" for place in range(width)], {})
    heads = rows[-1]
    if len(heads) == width - 1 and not empty[-1] and named_rows:
        heads, rows = ["", *heads], [["", *row] for row in rows]
    if all(item.lower() in _REMARKS for item in heads[width:]):
        heads = heads[:width]
    if len(heads) > width or not all(empty[len(heads) :]):
        raise DataError(
            source,
            f"the header names {len(heads)} columns, but the rows below have {width} values",
            "export with a point as decimal sign, or with semicolons between columns",
        )
    level = rows[-2] if len(rows) > 1 and 1 < len(rows[-2]) <= width else ()
    return _named(*([*row, *[""] * (width - len(row))] for row in (heads, units, level)))


def _named(heads: Sequence[str], units: Sequence[str], level: Sequence[str]) -> Headings:
    """Distinct names from the `heads` of all columns, and units of those that have one.

    `units` is a separate row of units (or empty); `level` the row above the heads, which names
    columns without a name and distinguishes equal names.
    """
    split = [split_heading(item) for item in heads]
    short = [name for name, _ in split]
    kept = heads if _repeated(short) and not _repeated(heads) else short  # with their units
    names = [name or above for name, above in zip(kept, level, strict=True)]
    again, group = _repeated(names), ""
    made: list[str] = []
    known, numbers = set[str](), defaultdict[str, Iterator[int]](lambda: count(2))
    for name, above in zip(names, level, strict=True):
        group = above or group
        whole = f"{group} {name}" if name in again and group else name
        numbered = (f"{whole}_{number}" for number in numbers[whole])  # goes on where it ended
        made.append(next(one for one in chain([whole], numbered) if not one or one not in known))
        known.add(made[-1])
    changed = [f"{new!r}" for old, new in zip(names, made, strict=True) if old != new]
    note = f"columns with the same name were renamed: {', '.join(changed[:12])}"
    stated = {
        name: _bare(below) or own for name, (_, own), below in zip(made, split, units, strict=True)
    }
    stated = {name: unit for name, unit in stated.items() if name and unit}
    return Headings(made, stated, (note,) if changed else ())


def _repeated(names: Sequence[str]) -> set[str]:
    """Names that occur more than once; empty ones do not count."""
    return {name for name, times in Counter(names).items() if name and times > 1}


def _trimmed(row: Sequence[str]) -> list[str]:
    """Row without empty fields at the end."""
    filled = [place for place, item in enumerate(row) if item]
    return list(row[: filled[-1] + 1]) if filled else []


def _bare(item: str) -> str:
    return item.strip("()[] ")
