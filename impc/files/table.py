"""Content of a file: named numeric columns of equal length."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from impc.arrays import Array, Frozen, frozen, with_shape
from impc.checking import checked
from impc.errors import DataError
from impc.files.alignment import aligned, own_clocks, rising, unwrapped

#: Why a sheet of a workbook is skipped.
OTHER_SHEET = "is another sheet"
# Where a counter of 8 to 32 bits begins anew, which may count units, thousandths or millionths.
_WRAPS = tuple(2.0**bits / unit for bits in range(8, 33) for unit in (1, 1e3, 1e6))
_LONGEST = 160  # characters of a name, a unit or a reason, as used in messages and TOML


@dataclass(frozen=True)
class Table(Frozen):
    """Numeric columns of one file."""

    source: str  # file, for messages
    # by name, in the order of the file, each (samples,); NaN where the file has no value
    columns: Mapping[str, Array]
    units: Mapping[str, str]  # as the file writes them, for the columns that have one
    rate: float | None  # samples per second, if the file states it (TDMS, C3D)
    skipped: Mapping[str, str] = field(default_factory=dict)  # other content, and why it is skipped
    notes: tuple[str, ...] = ()  # renamed columns, rows that were not read

    @property
    def samples(self) -> int:
        """Number of samples."""
        return len(next(iter(self.columns.values())))


@checked
def make_table(
    source: str,
    columns: Mapping[str, ArrayLike],
    units: Mapping[str, str] | None = None,
    rate: float | None = None,
    skipped: Mapping[str, str] | None = None,
    notes: tuple[str, ...] = (),
) -> Table:
    """Make a table from columns of equal length; those of another length are skipped.

    Columns with clocks of their own are first interpolated to the fastest clock.

    Parameters
    ----------
    source : str
        File, for messages.
    columns : mapping of str to array_like
        Columns by name, (samples,) each. Masked entries become NaN.
    units : mapping of str to str, optional
        Units by column, as the file writes them.
    rate : float, optional
        Samples per second, if the file states it.
    skipped : mapping of str to str, optional
        Content that was not read, and why.
    notes : tuple of str, optional
        Remarks for the user, such as renamed columns.

    Returns
    -------
    Table
        The columns of the most frequent length; the others are listed in `skipped`.

    Raises
    ------
    DataError
        If no column of numbers is left.

    Examples
    --------
    >>> import impc
    >>> table = impc.make_table("simulated", {"t": [0, 0.01], "tilt": [0.5, 0.6]}, {"tilt": "deg"})
    >>> table.samples, dict(table.units)
    (2, {'tilt': 'deg'})
    """
    vectors: dict[str, Any] = {
        _line(name): with_shape(name, np.asarray(value), (None,)) for name, value in columns.items()
    }
    if len(vectors) < len(columns):
        raise DataError(source, "has two columns of one name", "give each its own name")
    units = {_line(name): _line(unit) for name, unit in (units or {}).items()}
    left_out = {_line(name): _line(reason) for name, reason in (skipped or {}).items()}
    vectors, wrapped = _unwrapped(vectors)
    vectors, said = aligned(source, vectors, own_clocks(vectors, units))
    lengths = Counter(len(values) for values in vectors.values() if len(values) > 1)
    if not lengths:
        left_out |= {name: f"has {len(values)} values" for name, values in vectors.items()}
        found = next((f"{name} {reason}" for name, reason in left_out.items()), "it is empty")
        raise DataError(
            source, f"has no column of numbers ({found})", "save each signal as a column"
        )
    # If two are equally frequent, the longer one.
    usual = max(lengths, key=lambda length: (lengths[length], length))
    kept = {}
    for name, values in vectors.items():
        if len(values) == usual:
            kept[name] = values if not values.flags.writeable else frozen(values)
        else:
            left_out[name] = f"has {len(values)} values where most columns have {usual}"
    stated = {name: unit for name, unit in units.items() if name in kept and unit}
    return Table(source, kept, stated, rate, left_out, tuple(map(_line, (*notes, *wrapped, *said))))


def _unwrapped(columns: Mapping[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """Columns of which counters that wrap are continued, and a note on each."""
    found, notes = dict(columns), []
    for name, values in columns.items():
        made, wrap = unwrapped(values, _WRAPS)
        if wrap and len(rising(made)) == len(made):
            found[name] = made
            notes.append(f"counter {name!r} begins anew at {wrap:.10g}: continued")
    return found, notes


def _line(text: str) -> str:
    """Text of a file reduced to printable characters and a limited length."""
    line = "".join(mark if mark.isprintable() else " " for mark in text[: 10 * _LONGEST]).strip()
    return line if len(line) <= _LONGEST else f"{line[: _LONGEST - 3]}..."


def in_columns(rows: Sequence[Sequence[str]], left: int = 1) -> str:
    """Format `rows` as lines: the first `left` columns flush left, the others flush right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join(
        "  ".join(
            cell.ljust(width) if place < left else cell.rjust(width)
            for place, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    )
