"""MATLAB .mat files up to version 7 (called v5 after their header), by scipy.

A flipped bit can end the process in scipy's reader: files are read in a process of their own
(`impc.files.apart`).

Vectors are columns by their name, the columns of a matrix are `name_1`, `name_2` and so on, numeric
fields of a struct are `s.field`. The longer side of a matrix is taken as time.
"""

from __future__ import annotations

import io
import re
import warnings
from typing import TYPE_CHECKING, Any

import numpy as np

from impc.errors import DataError, OutputError
from impc.files.table import make_table

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from impc.arrays import Array
    from impc.files.table import Table

_DEPTH = 8
_LONGEST = 1_000_000  # characters of the names in a saved plant
#: What a cell, table or object has to become; each sentence ends a reason.
AS_STRUCT = 'save a struct of vectors: s = table2struct(T, "ToScalar", true)'
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,62}")


def read_matlab(path: Path, _largest: int) -> Table:
    """Read the .mat file of version 5 to 7 at `path`; the process bounds what it unpacks to."""
    columns: dict[str, Array] = {}
    skipped: dict[str, str] = {}
    for name, value in _variables(path).items():
        _collect(name, value, columns, skipped, 0)
    return make_table(str(path), columns, None, None, skipped)


def read_matrices(path: Path, _largest: int) -> dict[str, Array | list[str | None]]:
    """Read the matrices and names of a saved plant from the .mat file of version 5 to 7 at `path`.

    Real numbers in MATLAB's sizes, (rows, columns) or more; of a text
    its rows, of a cell array its texts, None for what is no text.
    """
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
    """The `columns`, (samples,) each, as MATLAB variables; `s.field` as the field of a struct.

    `source` is the file, for the message.
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


def _variables(path: Path) -> dict[str, Any]:
    """The variables of a file by name, as scipy has them."""
    import scipy.io  # noqa: PLC0415  # in the process that reads only
    from scipy.io.matlab import MatlabOpaque, MatReadWarning  # noqa: PLC0415

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        # Two variables of one name, or a variable cut off: never a part of a file.
        warnings.simplefilter("error", MatReadWarning)
        # scipy calls every object None, strings among them: two are no fault.
        warnings.filterwarnings("ignore", 'Duplicate variable name "None"', MatReadWarning)
        found = scipy.io.loadmat(path, appendmat=False, struct_as_record=True)
    return {
        # scipy calls opaque objects None; the name is inside.
        (_text(value, "s0") or name) if isinstance(value, MatlabOpaque) else name: value
        for name, value in found.items()
        if not name.startswith("__")
    }


def _collect(
    name: str, value: Any, columns: dict[str, Array], skipped: dict[str, str], depth: int
) -> None:
    """Put a variable's columns, or the reason why it has none, in their place."""
    reason = _unreadable(value)
    if reason:
        skipped[name] = reason
    elif value.dtype.names:
        if value.size != 1 or depth >= _DEPTH:
            skipped[name] = f"is an array of {value.size} structs; save each as a file of its own"
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
    """Why a MATLAB value is no array of numbers or struct; empty when it is one."""
    import scipy.sparse  # noqa: PLC0415
    from scipy.io.matlab import MatlabFunction, MatlabObject, MatlabOpaque  # noqa: PLC0415

    if isinstance(value, MatlabOpaque):
        kind = _text(value, "s2") or "unknown class"
        return f"is a MATLAB {kind}; {AS_STRUCT}, or writetable"
    if isinstance(value, MatlabObject):
        return f"is a MATLAB object of class {value.classname}; {AS_STRUCT}"
    if isinstance(value, MatlabFunction) or not isinstance(value, np.ndarray):
        return "is sparse; save full(x)" if scipy.sparse.issparse(value) else "is not numeric"
    kinds = {"U": "is text", "S": "is text", "O": f"is a cell array; {AS_STRUCT}, or cell2mat"}
    return kinds.get(value.dtype.kind, "")


def _text(value: Any, part: str) -> str:
    names: Iterator[str] = iter(value.dtype.names or ())
    return value[part].flat[0].decode("latin-1", "replace") if part in names else ""


def _names(value: Any) -> list[str | None]:
    """The rows of a text, or the texts of a cell array; None for a cell of something else."""
    if value.dtype.kind == "O":
        rows = [_names(cell) if _is_text(cell) else None for cell in value.ravel(order="F")]
        return [None if row is None else " ".join(map(str, row)) for row in rows]
    if value.nbytes > 4 * _LONGEST:
        raise ValueError(f"a text of more than {_LONGEST} characters")
    return [str(row).rstrip() for row in value.ravel()]


def _is_text(value: Any) -> bool:
    return isinstance(value, np.ndarray) and value.dtype.kind in "US"
