"""Read and write MATLAB .mat files up to version 7 (v5 in their header) with scipy.

A flipped bit can crash scipy's reader: files are read in a separate process (`impc.files.apart`).
Vectors become columns of their name, columns of a matrix `name_1`, `name_2`, ..., numeric fields of
a struct `s.field`. The longer side of a matrix is time.
"""

from __future__ import annotations

import io
import re
import warnings
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy

from impc.errors import DataError, OutputError
from impc.files.table import make_table

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from impc.arrays import Array
    from impc.files.table import Table

_DEPTH = 8
_LONGEST = 1_000_000  # characters of the names in a saved plant
# How to save a class of MATLAB instead. Only MATLAB reads its objects: their format is not
# documented, and the libraries that guess it change scipy (mat-io) or read one version.
_INSTEAD = {
    "timetable": 'save s = table2struct(timetable2table(T), "ToScalar", true), or writetimetable',
    "timeseries": "save s.Time = ts.Time; s.Data = ts.Data",
    "datetime": "save seconds(t - t(1))",
    "duration": "save seconds(t)",
    "cell": "save a struct of vectors, or writematrix(cell2mat(c))",
    "string": "",
}
_TABLE = 'save a struct of vectors: s = table2struct(T, "ToScalar", true), or writetable'
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,62}")


def read_matlab(path: Path, _largest: int) -> Table:
    """Read a .mat file of version 5 to 7 (the process limits the memory)."""
    columns: dict[str, Array] = {}
    skipped: dict[str, str] = {}
    for name, value in _variables(path).items():
        _collect(name, value, columns, skipped, 0)
    return make_table(str(path), columns, None, None, skipped)


def read_matrices(path: Path, _largest: int) -> dict[str, Array | list[str | None]]:
    """Read the real matrices, texts and cell arrays of text of a saved plant (.mat v5 to v7)."""
    found: dict[str, Array | list[str | None]] = {}
    for name, value in _variables(path).items():
        if type(value) is np.ndarray and value.dtype.kind in "USO":
            found[name] = _names(value)
            continue
        reason = _unreadable(value).split(";")[0]
        if reason or value.dtype.names:
            remedy = "save matrices, and names by cellstr"
            raise DataError(str(path), f"{name} {reason or 'is a struct'}", remedy)
        if value.dtype.kind not in "fiub":
            raise DataError(str(path), f"has a complex matrix {name}", "save real numbers")
        found[name] = np.asarray(value, dtype=np.float64)
    return found


def unread(kind: str) -> str:
    """Reason why a value of a MATLAB class (such as table) has no column, and what to save."""
    what = "is a cell array" if kind == "cell" else f"is a MATLAB {kind or 'object'}"
    return "; ".join(filter(None, (what, _INSTEAD.get(kind, _TABLE))))


def array_columns(name: str, array: Any) -> dict[str, Array] | str:
    """Columns (samples,) of a real numeric array called `name`, or why it has none.

    Time is the longer side of a matrix, and the last of three dimensions (Simulink: m x n x N).
    """
    if array.dtype.kind not in "fiub":
        return "is complex" if array.dtype.kind == "c" else "is not numeric"
    if array.size < 2:
        return f"is one number ({array.item():g})" if array.size else "is empty"
    values = np.asarray(array, dtype=np.float64).squeeze()
    if values.ndim == 3 and values.shape[2] > values.shape[0] * values.shape[1]:
        values = values.reshape(-1, values.shape[2], order="F")
    if values.ndim > 2:
        return f"has {values.ndim} dimensions, none of them much longer than the others"
    if values.ndim == 1:
        return {name: values}
    if values.shape[1] > values.shape[0]:
        values = values.T
    return {f"{name}_{index + 1}": column for index, column in enumerate(values.T)}


def encode_matlab(table: Table) -> bytes:
    """Content of a v5 .mat file with one column vector per column; units are not stored."""
    content = io.BytesIO()
    vectors = {name: values[:, None] for name, values in table.columns.items()}
    save: Any = scipy.io.savemat  # its stubs know paths only
    save(content, nested_columns(table.source, vectors), long_field_names=True)
    return content.getvalue()


def nested_columns(source: str, columns: Mapping[str, Array]) -> dict[str, Any]:
    """Nest `columns` (samples,) as MATLAB variables: `s.field` becomes a field of a struct."""
    nested: dict[str, Any] = {}
    for name, values in columns.items():
        *parents, last = name.split(".")
        if not all(_NAME.fullmatch(part) for part in (*parents, last)):
            raise OutputError(
                f"column {name!r} of {source}", "is not a valid MATLAB variable name",
                "rename it with letters, digits and _",
            )  # fmt: skip
        place = nested
        for parent in parents:
            place = place.setdefault(parent, {})
        place[last] = values
    return nested


def _variables(path: Path) -> dict[str, Any]:
    """Variables of a file by name, as scipy returns them."""
    from scipy.io.matlab import MatlabOpaque, MatReadWarning  # noqa: PLC0415

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        # Duplicate names or a truncated variable are errors: never read part of a file.
        warnings.simplefilter("error", MatReadWarning)
        # Except for "None", which scipy calls every object, strings included.
        warnings.filterwarnings("ignore", 'Duplicate variable name "None"', MatReadWarning)
        found = scipy.io.loadmat(path, appendmat=False, struct_as_record=True)
    return {
        # scipy calls opaque objects None; their name is inside.
        (_text(value, "s0") or name) if isinstance(value, MatlabOpaque) else name: value
        for name, value in found.items()
        if not name.startswith("__")
    }


def _collect(
    name: str, value: Any, columns: dict[str, Array], skipped: dict[str, str], depth: int
) -> None:
    """Add the columns of a variable, or the reason why it has none."""
    reason = _unreadable(value)
    if reason:
        skipped[name] = reason
    elif value.dtype.names:
        if value.size != 1 or depth >= _DEPTH:
            skipped[name] = (
                f"is an array of {value.size} structs; save one of them, such as s = {name}(1)"
            )
            return
        for part in value.dtype.names:
            _collect(f"{name}.{part}", value.flat[0][part], columns, skipped, depth + 1)
    else:
        found = array_columns(name, value)
        if isinstance(found, str):
            skipped[name] = found
        else:
            columns.update(found)


def _unreadable(value: Any) -> str:
    """Reason why a MATLAB value is neither a numeric array nor a struct; empty if it is."""
    from scipy.io.matlab import MatlabFunction, MatlabObject, MatlabOpaque  # noqa: PLC0415

    if isinstance(value, MatlabOpaque):
        return unread(_text(value, "s2"))
    if isinstance(value, MatlabObject):
        return unread(f"object of class {value.classname}")
    if isinstance(value, MatlabFunction) or not isinstance(value, np.ndarray):
        return "is sparse; save full(x)" if scipy.sparse.issparse(value) else "is not numeric"
    kinds = {"U": "is text", "S": "is text", "O": unread("cell")}
    return kinds.get(value.dtype.kind, "")


def _text(value: Any, part: str) -> str:
    names: Iterator[str] = iter(value.dtype.names or ())
    return value[part].flat[0].decode("latin-1", "replace") if part in names else ""


def _names(value: Any) -> list[str | None]:
    """Rows of a text, or texts of a cell array; None for a cell without text."""
    if value.dtype.kind == "O":
        rows = [_names(cell) if _is_text(cell) else None for cell in value.ravel(order="F")]
        return [None if row is None else " ".join(map(str, row)) for row in rows]
    if value.nbytes > 4 * _LONGEST:
        raise ValueError(f"a text of more than {_LONGEST} characters")
    return [str(row).rstrip() for row in value.ravel()]


def _is_text(value: Any) -> bool:
    return isinstance(value, np.ndarray) and value.dtype.kind in "US"
