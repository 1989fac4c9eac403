"""MATLAB .mat files up to version 7 (called v5 after their header) as tables.

Vectors are columns by their name, the columns of a matrix are `name_1`, `name_2` and so on, numeric
fields of a struct are `s.field`. The longer side of a matrix is taken as time.
"""

from __future__ import annotations

import io
import re
from typing import TYPE_CHECKING, Any

import numpy as np

from impc.errors import DataError, OutputError
from impc.files.matlab5 import Cells, Other, Text, TooLargeError, read_variables
from impc.files.table import make_table

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from impc.arrays import Array
    from impc.files.table import Table

__all__ = ["AS_STRUCT", "array_columns", "encode_matlab", "nested_columns", "read_matlab"]

_DEPTH = 8
#: What a cell, table or object has to become; each sentence ends a reason.
AS_STRUCT = 'save a struct of vectors: s = table2struct(T, "ToScalar", true)'
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,62}")


def read_matlab(path: Path, largest: int) -> Table:
    """Read a .mat file of version 5 to 7.

    Parameters
    ----------
    path : Path
        Of the file.
    largest : int
        The most bytes that its arrays may take once they are unpacked.

    Raises
    ------
    DataError
        When it holds no numeric vector or matrix: cells, tables and objects cannot be read.
    ValueError
        When it is damaged.
    """
    try:
        found = read_variables(path, largest)
    except TooLargeError as error:
        raise DataError(
            str(path),
            f"would take {error.args[0] / 1e9:.1f} GB once it is unpacked",
            "save only the signals that are needed",
        ) from None
    columns: dict[str, Array] = {}
    skipped: dict[str, str] = {}
    for name, value in found.items():
        _collect(name, value, columns, skipped, 0)
    return make_table(str(path), columns, None, None, skipped)


def array_columns(name: str, array: Any) -> dict[str, Array] | str:
    """The columns (samples,) of a real numeric array called `name`, or why it has none."""
    if array.dtype.kind not in "fiub":
        return "is complex" if array.dtype.kind == "c" else "is not numeric"
    if array.size < 2:
        return f"is one number ({array.item():g})" if array.size else "is empty"
    if array.ndim > 2:
        return f"has {array.ndim} dimensions"
    values = np.asarray(array, dtype=np.float64)
    if values.ndim == 1 or 1 in values.shape:
        return {name: values.ravel()}
    if values.shape[1] > values.shape[0]:
        values = values.T
    return {f"{name}_{index + 1}": column for index, column in enumerate(values.T)}


def encode_matlab(table: Table) -> bytes:
    """The bytes of a v5 .mat file with one column vector for each column; units are not kept."""
    import scipy.io  # noqa: PLC0415  # a third of a second, for who writes only

    content = io.BytesIO()
    vectors = {name: values[:, None] for name, values in table.columns.items()}
    save: Any = scipy.io.savemat  # its stubs know paths only
    save(content, nested_columns(table.source, vectors), long_field_names=True)
    return content.getvalue()


def nested_columns(source: str, columns: Mapping[str, Array]) -> dict[str, Any]:
    """Columns as MATLAB variables; `s.field` as the field of a struct.

    Parameters
    ----------
    source : str
        File, for the message.
    columns : mapping of str to Array
        (samples,) each.

    Raises
    ------
    OutputError
        When a column cannot be the name of a MATLAB variable.
    """
    nested: dict[str, Any] = {}
    for name, values in columns.items():
        *parents, last = name.split(".")
        if not all(_NAME.fullmatch(part) for part in (*parents, last)):
            raise OutputError(
                f"column {name!r} of {source}", "cannot be the name of a variable in MATLAB",
                "rename it with letters, digits and _",
            )  # fmt: skip
        place = nested
        for parent in parents:
            place = place.setdefault(parent, {})
        place[last] = values
    return nested


def _collect(
    name: str, value: Any, columns: dict[str, Array], skipped: dict[str, str], depth: int
) -> None:
    """Put a variable's columns, or the reason why it has none, in their place."""
    if isinstance(value, dict):
        if depth >= _DEPTH:
            skipped[name] = "is nested too deep; save plain vectors"
            return
        for part, inner in value.items():
            _collect(f"{name}.{part}", inner, columns, skipped, depth + 1)
        return
    found = array_columns(name, value) if isinstance(value, np.ndarray) else _unreadable(value)
    if isinstance(found, str):
        skipped[name] = found
    else:
        columns.update(found)


def _unreadable(value: Text | Cells | Other) -> str:
    """Why a MATLAB value is no array of numbers or struct."""
    if isinstance(value, Text):
        return "is text"
    if isinstance(value, Cells):
        return f"is a cell array; {AS_STRUCT}, or cell2mat"
    object_like = value.kind.startswith("a MATLAB ")
    return f"is {value.kind}; {AS_STRUCT}, or writetable" if object_like else f"is {value.kind}"
