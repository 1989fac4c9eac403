"""Read MATLAB .mat files of version 7.3 (HDF5 behind a block of 512 bytes) with h5py."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from impc.errors import DataError
from impc.files.matlab import array_columns, unread
from impc.files.table import make_table

if TYPE_CHECKING:
    from pathlib import Path

    from impc.arrays import Array
    from impc.files.table import Table

#: First bytes of an HDF5 file.
HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"
_DEPTH = 8
_MOST = 10_000  # names in a file
_MOST_IDENTIFIED = 256  # bytes of a MATLAB attribute, which holds one word
_NUMERIC = {"double", "single", "logical"} | {
    f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)
}


@dataclass
class _Found:
    """State of reading a file."""

    source: str
    left: int  # bytes that may still be read
    names: int = 0
    seen: set[tuple[int, int]] = field(default_factory=set)  # addresses of objects in the file
    columns: dict[str, Array] = field(default_factory=dict)
    skipped: dict[str, str] = field(default_factory=dict)


def read_matlab73(path: Path, largest: int) -> Table:
    """Read a .mat file of version 7.3; unpacked it may take `largest` bytes."""
    import h5py  # noqa: PLC0415  # takes 0.2 s; not needed for text files

    found = _Found(str(path), largest)
    with h5py.File(path, "r") as file:
        _collect(found, "", file, 0)
    return make_table(found.source, found.columns, None, None, found.skipped)


def _collect(found: _Found, prefix: str, group: Any, depth: int) -> None:
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
            found.skipped[full] = "is a link to an earlier variable"
            continue
        kind = _class_of(item)
        if isinstance(item, h5py.Group):
            if "MATLAB_object_decode" in item.attrs or kind not in ("struct", ""):
                found.skipped[full] = unread(kind)
            elif depth >= _DEPTH:
                raise DataError(found.source, f"{full} is nested too deep", "save plain vectors")
            else:
                _collect(found, f"{full}.", item, depth + 1)
        elif isinstance(item, h5py.Dataset):
            _add(found, full, item, kind)


def _add(found: _Found, name: str, dataset: Any, kind: str) -> None:
    """Read a dataset if it is numeric."""
    if dataset.external or dataset.is_virtual:
        raise DataError(found.source, f"{name} lies in another file", "save the signals themselves")
    reason = _unreadable(dataset, kind)
    if reason:
        found.skipped[name] = reason
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
    columns = array_columns(name, np.asarray(dataset[()]).T)
    if isinstance(columns, str):
        found.skipped[name] = columns
    else:
        found.columns.update(columns)


def _unreadable(dataset: Any, kind: str) -> str:
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
