"""MATLAB .mat files up to version 7 (called v5 after their header), by scipy.

Vectors are columns by their name, the columns of a matrix are `name_1`, `name_2` and so on, numeric
fields of a struct are `s.field`. The longer side of a matrix is taken as time.
"""

from __future__ import annotations

import io
import re
import struct
import warnings
import zlib
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.io
import scipy.sparse
from scipy.io.matlab import MatlabFunction, MatlabObject, MatlabOpaque, MatReadWarning

from impc.errors import DataError, OutputError
from impc.files.table import make_table

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from impc.arrays import Array
    from impc.files.table import Table

__all__ = ["array_columns", "encode_matlab", "nested_columns", "read_matlab"]

_DEPTH = 8
_COMPRESSED = 15  # miCOMPRESSED: a variable packed by zlib
# What a cell, table or object has to become; each sentence ends a reason.
_AS_STRUCT = 'save a struct of vectors: s = table2struct(T, "ToScalar", true)'
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
    """
    source = str(path)
    unpacked = _unpacked(path)
    if unpacked > largest:
        raise DataError(
            source,
            f"would take {unpacked / 1e9:.1f} GB once it is unpacked",
            "save only the signals that are needed",
        )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        # Two variables of one name, or a variable cut off: never a part of a file.
        warnings.simplefilter("error", MatReadWarning)
        # scipy calls every object None, strings among them: two are no fault.
        warnings.filterwarnings("ignore", 'Duplicate variable name "None"', MatReadWarning)
        found = scipy.io.loadmat(path, struct_as_record=True)
    columns: dict[str, Array] = {}
    skipped: dict[str, str] = {}
    for name, value in found.items():
        if name.startswith("__"):
            continue
        known = name
        if isinstance(value, MatlabOpaque):  # scipy calls these None; the name is inside
            known = _text(value, "s0") or name
        _collect(known, value, columns, skipped, 0)
    return make_table(source, columns, None, None, skipped)


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


def _unpacked(path: Path) -> int:
    """Bytes of all variables once they are unpacked, from the tags in front of them.

    `scipy.io.whosmat` would tell, but not in the presence of a table.
    """
    total = 0
    with path.open("rb") as file:
        order = ">" if file.read(128)[126:] == b"MI" else "<"
        while len(tag := file.read(8)) == 8:
            kind, size = struct.unpack(f"{order}II", tag)
            inner = size
            if kind == _COMPRESSED:
                start = file.tell()
                begin = zlib.decompressobj().decompress(file.read(min(size, 64)), 8)
                inner = struct.unpack(f"{order}II", begin.ljust(8, b"\0"))[1]
                file.seek(start)
            total += inner
            file.seek(size, 1)
    return total


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
    if isinstance(value, MatlabOpaque):
        kind = _text(value, "s2") or "unknown class"
        return f"is a MATLAB {kind}; {_AS_STRUCT}, or writetable"
    if isinstance(value, MatlabObject):
        return f"is a MATLAB object of class {value.classname}; {_AS_STRUCT}"
    if isinstance(value, MatlabFunction) or not isinstance(value, np.ndarray):
        return "is sparse; save full(x)" if scipy.sparse.issparse(value) else "is not numeric"
    kinds = {"U": "is text", "S": "is text", "O": f"is a cell array; {_AS_STRUCT}, or cell2mat"}
    return kinds.get(value.dtype.kind, "")


def _text(value: Any, part: str) -> str:
    names: Iterator[str] = iter(value.dtype.names or ())
    return value[part].flat[0].decode("latin-1", "replace") if part in names else ""
