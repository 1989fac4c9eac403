"""Names and units of columns from what stands above them: ``angle (deg)``, or a row of units."""

from __future__ import annotations

import re
from collections import Counter
from typing import TYPE_CHECKING

from impc.errors import DataError
from impc.files.units import is_unit

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["are_units", "named_columns", "split_heading", "written_heading"]

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


def named_columns(
    source: str, heads: Sequence[str], units: Sequence[str]
) -> tuple[list[str], dict[str, str]]:
    """Names of all columns, and units of those that have one.

    Parameters
    ----------
    source : str
        File, for the message.
    heads : sequence of str
        As they stand above the columns.
    units : sequence of str
        From a row of their own; empty where there is none.

    Raises
    ------
    DataError
        When two columns have one name, with their units too.
    """
    split = [split_heading(item) for item in heads]
    names = [name for name, _ in split]
    repeated = _repeated(names)
    if repeated is not None:
        names = list(heads)  # angle (deg) beside angle (rad)
        repeated = _repeated(names)
    if repeated is not None:
        raise DataError(source, f"names two columns {repeated!r}", "give each its own name")
    told = {
        name: _bare(below) or own
        for name, (_, own), below in zip(names, split, units, strict=True)
        if name and (_bare(below) or own)
    }
    return names, told


def _bare(item: str) -> str:
    return item.strip("()[] ")


def _repeated(names: Sequence[str]) -> str | None:
    """The first name that comes again; columns without a name do not count."""
    times = Counter(names)
    return next((name for name in names if name and times[name] > 1), None)
