"""MATLAB .mat files up to version 7 (called v5 after their header), by scipy.

A flipped bit can end the process in scipy's reader. So all tags are looked at first, and files are
read in a process of their own (`impc.files.apart`).

Vectors are columns by their name, the columns of a matrix are `name_1`, `name_2` and so on, numeric
fields of a struct are `s.field`. The longer side of a matrix is taken as time.

A file is a header of 128 bytes and a sequence of elements: a tag of 8 bytes (type, length), then as
many bytes. An array is an element of elements. scipy's reader looks types up in a table without
looking at its end, so that a flipped bit ends the process or takes what stands behind the table for
a type; and it takes the memory that a length asks for. Nothing is read here but tags: whether the
elements are those that scipy expects is not known, and some that are not end its process. They do
it at the address zero, as the types that are let through are all in the table or empty in it.
"""

from __future__ import annotations

import io
import re
import struct
import warnings
import zlib
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


def read_matlab(path: Path, largest: int) -> Table:
    """Read the .mat file of version 5 to 7 at `path`; unpacked it takes `largest` bytes at most."""
    columns: dict[str, Array] = {}
    skipped: dict[str, str] = {}
    for name, value in _variables(path, largest).items():
        _collect(name, value, columns, skipped, 0)
    return make_table(str(path), columns, None, None, skipped)


def read_matrices(path: Path, largest: int) -> dict[str, Array | list[str | None]]:
    """Read the matrices and names of a saved plant from the .mat file of version 5 to 7 at `path`.

    Real numbers in MATLAB's sizes, (rows, columns) or more, of `largest` bytes at most; of a text
    its rows, of a cell array its texts, None for what is no text.
    """
    found: dict[str, Array | list[str | None]] = {}
    left = largest
    for name, value in _variables(path, largest).items():
        if type(value) is np.ndarray and value.dtype.kind in "USO":
            found[name] = _names(value)
            continue
        reason = _unreadable(value).split(";")[0]
        if reason or value.dtype.names:
            remedy = "save matrices, and names by cellstr"
            raise DataError(str(path), f"{name} {reason or 'is a struct'}", remedy)
        if value.dtype.kind not in "fiub":
            raise DataError(str(path), f"has a complex matrix {name}", "save real numbers")
        left -= 8 * value.size
        if left < 0:
            raise too_large(path, largest - left)
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


def _variables(path: Path, largest: int) -> dict[str, Any]:
    """The variables of a file by name, as scipy has them, once their tags are found sound."""
    import scipy.io  # noqa: PLC0415  # in the process that reads only
    from scipy.io.matlab import MatlabOpaque, MatReadWarning  # noqa: PLC0415

    look_at_tags(path, largest)
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


# Types of elements: numbers and text, arrays (of elements), and a variable packed by zlib.
_PLAIN = {1, 2, 3, 4, 5, 6, 7, 9, 12, 13, 16, 17, 18}
_MATRIX, _PACKED = 14, 15
_FLAGS = (6, 8)  # type and length of the first element of an array: scipy takes them for granted
_NESTED = 100  # arrays within one another: scipy's reader calls itself for each


def look_at_tags(path: Path, largest: int) -> None:
    """Require types that exist, lengths that are there, and `largest` bytes unpacked at the most.

    The header of the file at `path` is not looked at.
    """
    content = memoryview(path.read_bytes())
    order = "<" if bytes(content[126:128]) == b"IM" else ">"  # as scipy has it
    left = largest
    for kind, size, inside in _elements(content[128:], order, padded=False):
        left -= size
        if left < 0:
            raise too_large(path, largest - left)
        if kind == _PACKED:
            unpacked = _unpacked(path, inside, order, left)
            left -= len(unpacked)
            for each, _, matrix in _elements(unpacked, order, padded=False):
                _look_into(each, matrix, order, 0)
        else:
            _look_into(kind, inside, order, 0)


def _unpacked(path: Path, packed: memoryview, order: str, most: int) -> memoryview:
    """What zlib packed: as many bytes as the tag in front of it says, and no more than `most`."""
    try:
        tag = zlib.decompressobj().decompress(packed, 8).ljust(8, b"\0")
        size = 8 + struct.unpack(f"{order}II", tag)[1]
        if size > most:
            raise too_large(path, size)
        unpacker = zlib.decompressobj()
        content = unpacker.decompress(packed, size)
        surplus = unpacker.decompress(unpacker.unconsumed_tail, 1)  # reads the checksum
    except zlib.error as error:
        raise ValueError(str(error)) from None
    if surplus or not unpacker.eof:
        raise ValueError("a packed variable is not as long as it says")
    return memoryview(content)


def too_large(path: Path, size: int) -> DataError:
    """The reason to raise for the file at `path`, whose variables take `size` bytes."""
    return DataError(
        str(path),
        f"would take {size / 1e9:.1f} GB once it is unpacked",
        "save only the signals that are needed",
    )


def _look_into(kind: int, content: memoryview, order: str, depth: int) -> None:
    """The tags within an array, which is all that may stand here."""
    if kind != _MATRIX:
        raise ValueError(f"an element of type {kind} is out of place")
    if depth > _NESTED:
        raise ValueError(f"more than {_NESTED} arrays within one another")
    if content and bytes(content[:8]) != struct.pack(f"{order}II", *_FLAGS):
        raise ValueError("an array without flags")
    for inner, _, inside in _elements(content, order):
        if inner not in _PLAIN:
            _look_into(inner, inside, order, depth + 1)


def _elements(
    content: memoryview, order: str, padded: bool = True
) -> Iterator[tuple[int, int, memoryview]]:
    """Type, length and bytes of each element that stands in `content`."""
    tag = struct.Struct(f"{order}II")
    at = 0
    while at < len(content):
        if at + 8 > len(content):
            raise ValueError("the file ends in the middle of an array")
        kind, size = tag.unpack_from(content, at)
        begin = at + 8
        if kind >> 16:  # up to four bytes stand in the tag itself
            kind, size, begin = kind & 0xFFFF, kind >> 16, at + 4
            at += 8
            if size > 4 or kind not in _PLAIN:
                raise ValueError(f"an element of type {kind} has {size} bytes in its tag")
        else:
            at = begin + size + (-size % 8 if padded else 0)
        if begin + size > len(content):
            raise ValueError(f"an element of type {kind} has fewer bytes than it says")
        yield kind, size, content[begin : begin + size]
