"""Names and units of columns from what stands above them: ``angle (deg)``, or a row of units."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING

from impc.errors import DataError
from impc.files.units import is_unit

if TYPE_CHECKING:
    from collections.abc import Sequence

# What may end the settings of a file without heads: LabVIEW's, OpenSim's.
_NO_HEAD = ("endofheader", "endheader")
# Columns that rows may leave away where they are empty.
_REMARKS = ("comment", "comments", "kommentar", "event", "events", "note", "notes", "remarks")

_HEADING = re.compile(r"(.*\S)\s*[(\[]([^()\[\]]*)[)\]]")


def split_heading(heading: str) -> tuple[str, str]:
    """Name and unit of a heading such as ``angle (deg)``; the unit is empty when it has none."""
    found = _HEADING.fullmatch(heading.strip())
    if found and is_unit(found[2]):
        return found[1], found[2].strip()
    return heading.strip(), ""


def written_heading(name: str, unit: str | None) -> str:
    """The heading of a `name` and its `unit` that `split_heading` takes apart."""
    return f"{name} ({unit})" if unit else name


def are_units(row: Sequence[str]) -> bool:
    """Whether a row of headings names units and nothing else."""
    plain = [_bare(item) for item in row]
    return any(plain) and all(not item or is_unit(item) for item in plain)


@dataclass(frozen=True)
class Headings:
    """What stands above the numbers."""

    names: tuple[str, ...]  # Of all columns; empty for one without a name
    units: dict[str, str]  # Of the columns that have one
    notes: tuple[str, ...] = ()  # Which names are not those of the file


def find_headings(
    source: str, above: Sequence[Sequence[str]], empty: Sequence[bool], named_rows: bool
) -> Headings:
    """Names and units from the rows `above` the numbers, the last of which are the header.

    `empty` says which columns below have no value, `named_rows` whether the first may be names of
    rows, above which nothing stands; `source` is the file.
    """
    width = len(empty)
    rows = [row for row in map(_trimmed, above) if row]
    if rows and rows[-1][0].strip("*_ ").lower().replace("_", "") in _NO_HEAD:
        rows = []
    units: Sequence[str] = ()
    if len(rows) > 1 and len(rows[-1]) <= width and are_units(rows[-1]) and not are_units(rows[-2]):
        units = rows.pop()
    if not rows:
        return Headings(tuple(f"column_{place + 1}" for place in range(width)), {})
    heads = rows[-1]
    if len(heads) == width - 1 and not empty[-1] and named_rows:
        heads, rows = ["", *heads], [["", *row] for row in rows]
    if all(item.lower() in _REMARKS for item in heads[width:]):
        heads = heads[:width]
    if len(heads) > width or not all(empty[len(heads) :]):
        raise DataError(
            source,
            f"the header names {len(heads)} columns, and the rows below have {width} values",
            "export with a point as decimal sign, or with semicolons between columns",
        )
    level = rows[-2] if len(rows) > 1 and len(rows[-2]) <= width else ()
    return named_columns(_padded(heads, width), _padded(units, width), _padded(level, width))


def named_columns(heads: Sequence[str], units: Sequence[str], level: Sequence[str]) -> Headings:
    """Names from the `heads` of all columns, made distinct, and units of those that have one.

    `units` is a row of their own, empty where there is none; `level` the row above the heads, which
    names what has no name, and tells apart what has the same.
    """
    split = [split_heading(item) for item in heads]
    names = [name or above for (name, _), above in zip(split, level, strict=True)]
    if _repeated([name for name, _ in split]) and not _repeated(heads):
        names = [head or above for head, above in zip(heads, level, strict=True)]  # angle (rad) too
    found = _distinct(names, level)
    changed = [f"{new!r}" for old, new in zip(names, found, strict=True) if old != new]
    note = f"columns of one name are told apart: {', '.join(changed[:12])}"
    told = {
        name: _bare(below) or own
        for name, (_, own), below in zip(found, split, units, strict=True)
        if name and (_bare(below) or own)
    }
    return Headings(tuple(found), told, (note,) if changed else ())


def _distinct(names: Sequence[str], level: Sequence[str]) -> list[str]:
    """Names that differ: by what stands above them, else by a number."""
    groups, group = [], ""
    for above in level:
        group = above or group
        groups.append(group)
    repeated = _repeated(names)
    found = [
        f"{group} {name}" if name in repeated and group else name
        for name, group in zip(names, groups, strict=True)
    ]
    made: list[str] = []
    seen: set[str] = set()
    numbers = Counter[str]()
    for name in found:
        other = name
        while other and other in seen:
            numbers[name] += 1
            other = f"{name}_{numbers[name] + 1}"
        seen.add(other)
        made.append(other)
    return made


def _repeated(names: Sequence[str]) -> set[str]:
    """The names that come again; columns without a name do not count."""
    return {name for name, times in Counter(names).items() if name and times > 1}


def _trimmed(row: Sequence[str]) -> list[str]:
    """Without empty fields at the end."""
    filled = [place for place, item in enumerate(row) if item]
    return list(row[: filled[-1] + 1]) if filled else []


def _padded(row: Sequence[str], width: int) -> list[str]:
    return [*row, *[""] * (width - len(row))]


def _bare(item: str) -> str:
    return item.strip("()[] ")
