"""A file as it stands: named columns of equal length, before anything is made of them."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from impc.arrays import Frozen, frozen
from impc.checking import checked
from impc.errors import DataError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import ArrayLike

    from impc.arrays import Array

_LONGEST = 160  # characters of a name, a unit or a reason: they stand in messages and in TOML


@dataclass(frozen=True)
class Table(Frozen):
    """The numeric columns of one file."""

    source: str  # Where they come from, for messages
    # By name, in the order of the file, each (samples,). NaN where the file has no value.
    columns: Mapping[str, Array]
    # Units of the columns for which the file says them, as it writes them
    units: Mapping[str, str]
    rate: float | None  # Samples per second, where the file says it itself (TDMS, C3D)
    # What else the file holds, and why it is no column
    skipped: Mapping[str, str] = field(default_factory=dict)
    # What a user of the columns has to know of the file: names that were changed, rows that were
    # not read
    notes: tuple[str, ...] = ()

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
    """Keep the columns of the length that most have; the others are named among the skipped.

    Parameters
    ----------
    source : str
        File, for messages.
    columns : mapping of str to array_like
        (samples,) each, by name. What a masked array masks is missing: NaN.
    units : mapping of str to str, optional
        As the file writes them, of the columns that have one.
    rate : float, optional
        Samples per second, where the file says it.
    skipped : mapping of str to str, optional
        What was not read, and why.
    notes : tuple of str, optional
        What a user of the columns has to know.

    Raises
    ------
    DataError
        When no column of numbers is left.

    Examples
    --------
    >>> import impc
    >>> table = impc.make_table("simulated", {"t": [0, 0.01], "tilt": [0.5, 0.6]}, {"tilt": "deg"})
    >>> table.samples, dict(table.units)
    (2, {'tilt': 'deg'})
    """
    vectors: dict[str, Any] = {_line(name): value for name, value in columns.items()}
    if len(vectors) < len(columns):
        raise DataError(source, "has two columns of one name", "give each its own")
    units = {_line(name): _line(unit) for name, unit in (units or {}).items()}
    left_out = {_line(name): _line(reason) for name, reason in (skipped or {}).items()}
    lengths = Counter(len(values) for values in vectors.values() if len(values) > 1)
    if not lengths:
        left_out |= {name: f"has {len(values)} values" for name, values in vectors.items()}
        found = next((f"{name} {reason}" for name, reason in left_out.items()), "nothing in it")
        raise DataError(
            source, f"holds no column of numbers ({found})", "save each signal as a column"
        )
    # The longer one where two are equally frequent.
    usual = max(lengths, key=lambda length: (lengths[length], length))
    kept = {}
    for name, values in vectors.items():
        if len(values) == usual:
            kept[name] = values if not values.flags.writeable else frozen(values)
        else:
            left_out[name] = f"has {len(values)} values where most columns have {usual}"
    stated = {name: unit for name, unit in units.items() if name in kept and unit}
    return Table(source, kept, stated, rate, left_out, tuple(map(_line, notes)))


def _line(text: str) -> str:
    """A name or a unit of a file's, of printable signs."""
    line = "".join(mark if mark.isprintable() else " " for mark in text[: 10 * _LONGEST]).strip()
    return line if len(line) <= _LONGEST else f"{line[: _LONGEST - 3]}..."


def in_columns(rows: Sequence[Sequence[str]], left: int = 1) -> str:
    """The `rows`, a line each: the first `left` columns flush left, the others flush right.

    pandas would set all of them flush right, names of methods too, or want a formatter a column.
    """
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join(
        "  ".join(
            cell.ljust(width) if place < left else cell.rjust(width)
            for place, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    )
