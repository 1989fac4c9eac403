"""Read and write MATLAB .mat files: to version 7 (v5 in the header) by scipy, 7.3 by h5py.

A flipped bit can crash either: files are read in a separate process (`impc.files.apart`). Version
7.3 is HDF5 behind a block of 512 bytes, which may hold links, other files and cycles.
Vectors become columns of their name, columns of a matrix `name_1`, `name_2`, ..., numeric fields of
a struct `s.field`. The longer side of a matrix is time.
"""

from __future__ import annotations

import io
import math
import re
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from impc.arrays import Array
from impc.errors import DataError, OutputError
from impc.files.table import Table, make_table

#: First bytes of an HDF5 file.
HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"
_DEPTH = 8
_MOST = 10_000  # names in a file of version 7.3
_MOST_IDENTIFIED = 256  # bytes of a MATLAB attribute, which holds one word
_NUMERIC = {"double", "single", "logical"} | {
    f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)
}
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


@dataclass
class _Found:
    """State of reading a file."""

    source: str
    left: int  # bytes that may still be read
    names: int = 0
    seen: set[tuple[int, int]] = field(default_factory=set)  # addresses of objects in the file
    columns: dict[str, Array] = field(default_factory=dict)
    skipped: dict[str, str] = field(default_factory=dict)

    def add(self, name: str, value: Any) -> None:
        """Add the columns of an array, or the reason why there are none."""
        found = value if isinstance(value, str) else array_columns(name, value)
        if isinstance(found, str):
            self.skipped[name] = found
        else:
            self.columns.update(found)

    def table(self) -> Table:
        """Table of the columns."""
        return make_table(self.source, self.columns, None, None, self.skipped)


def read_matlab(path: Path, largest: int) -> Table:
    """Read a .mat file of version 5 to 7 (the process limits the memory)."""
    found = _Found(str(path), largest)
    for name, value in _variables(path).items():
        _collect(found, name, value, 0)
    return found.table()


def read_matlab73(path: Path, largest: int) -> Table:
    """Read a .mat file of version 7.3; unpacked it may take `largest` bytes."""
    import h5py  # noqa: PLC0415  # takes 0.2 s; not needed for text files

    found = _Found(str(path), largest)
    with h5py.File(path, "r") as file:
        _collect_group(found, "", file, 0)
    return found.table()


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


def _collect(found: _Found, name: str, value: Any, depth: int) -> None:
    """Add the columns of a variable, or the reason why it has none."""
    reason = _unreadable(value)
    if reason or not value.dtype.names:
        found.add(name, reason or value)
    elif value.size != 1 or depth >= _DEPTH:
        found.add(name, f"is an array of {value.size} structs; save one of them: s = {name}(1)")
    else:
        for part in value.dtype.names:
            _collect(found, f"{name}.{part}", value.flat[0][part], depth + 1)


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


def _collect_group(found: _Found, prefix: str, group: Any, depth: int) -> None:
    import h5py  # noqa: PLC0415

    for name in group:
        if not prefix and name in ("#refs#", "#subsystem#"):
            continue
        full = f"{prefix}{name}"
        found.names += 1
        if found.names > _MOST:
            raise DataError(found.source, f"holds more than {_MOST} names", "save fewer of them")
        if not isinstance(group.get(name, getlink=True), h5py.HardLink):
            raise DataError(found.source, f"{full} is a link", "save the signals themselves")
        item = group[name]
        if _seen(found, item):  # hard links can form cycles
            found.add(full, "is a link to an earlier variable")
            continue
        kind = _class_of(item)
        if isinstance(item, h5py.Group):
            if "MATLAB_object_decode" in item.attrs or kind not in ("struct", ""):
                found.add(full, unread(kind))
            elif depth >= _DEPTH:
                raise DataError(found.source, f"{full} is nested too deep", "save plain vectors")
            else:
                _collect_group(found, f"{full}.", item, depth + 1)
        elif isinstance(item, h5py.Dataset):
            _add(found, full, item, kind)


def _add(found: _Found, name: str, dataset: Any, kind: str) -> None:
    """Read a dataset if it is numeric."""
    if dataset.external or dataset.is_virtual:
        raise DataError(found.source, f"{name} lies in another file", "save the signals themselves")
    if reason := _unreadable73(dataset, kind):
        found.add(name, reason)
        return
    # HDF5 allocates whole chunks, however little of them is filled.
    chunk = math.prod(dataset.chunks or (0,)) * dataset.dtype.itemsize
    found.left -= max(8, dataset.dtype.itemsize) * dataset.size
    if found.left < chunk:
        raise DataError(
            found.source,
            f"is too large once it is unpacked (at {name})",
            "save only the signals that are needed",
        )
    found.add(name, np.asarray(dataset[()]).T)


def _unreadable73(dataset: Any, kind: str) -> str:
    """Reason why a dataset has no column, from its metadata; empty if it may have one."""
    if "MATLAB_object_decode" in dataset.attrs or kind not in (*_NUMERIC, ""):
        return "is text" if kind == "char" else unread(kind)
    if not dataset.size or _attribute(dataset, "MATLAB_empty"):
        return "is empty"
    if dataset.dtype.names is not None:
        return "is complex"
    if dataset.dtype.kind not in "fiub":
        structs = "ref" in (dataset.dtype.metadata or {})
        return "is an array of structs; save one of them" if structs else "is not numeric"
    return "" if dataset.id.get_storage_size() else "has no stored values, only a fill value"


def _seen(found: _Found, item: Any) -> bool:
    """Whether the object occurred before; records it."""
    import h5py  # noqa: PLC0415

    place = h5py.h5o.get_info(item.id)
    key = (place.fileno, place.addr)
    if key in found.seen:
        return True
    found.seen.add(key)
    return False


def _class_of(item: Any) -> str:
    kind = _attribute(item, "MATLAB_class")
    return kind.decode("ascii", "replace") if isinstance(kind, bytes) else str(kind or "")[:63]


def _attribute(item: Any, name: str) -> Any:
    """Attribute that is one word or number; None if there is none."""
    if name not in item.attrs:
        return None
    attribute = item.attrs.get_id(name)
    if attribute.shape != () or attribute.get_storage_size() > _MOST_IDENTIFIED:
        raise ValueError(f"the attribute {name} is too long")
    return item.attrs[name]
