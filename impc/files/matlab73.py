"""MATLAB .mat files of version 7.3: HDF5 behind a block of 512 bytes, by h5py."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from impc.errors import DataError
from impc.files.matlab import AS_STRUCT, array_columns
from impc.files.table import make_table

if TYPE_CHECKING:
    from pathlib import Path

    from impc.arrays import Array
    from impc.files.table import Table

#: First bytes of an HDF5 file.
HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"
_DEPTH = 8
_MOST = 10_000  # names in a file
_MOST_IDENTIFIED = 256  # bytes of an attribute of MATLAB's: it has one word
_NUMERIC = {"double", "single", "logical"} | {
    f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)
}


@dataclass
class _Found:
    """What a file holds, while it is read."""

    source: str
    left: int  # bytes that may still be read
    names: int = 0
    seen: set[tuple[int, int]] = field(default_factory=set)  # places of objects in the file
    columns: dict[str, Array] = field(default_factory=dict)
    skipped: dict[str, str] = field(default_factory=dict)


def read_matlab73(path: Path, largest: int) -> Table:
    """Read the .mat file of version 7.3 at `path`; unpacked it takes `largest` bytes at most."""
    import h5py  # noqa: PLC0415  # a fifth of a second, for who reads text only

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
            raise DataError(found.source, f"{full} points elsewhere", "save the signals themselves")
        item = group[name]
        if _seen(found, item):  # a link to what was read: a file may hold any number, and cycles
            found.skipped[full] = "is another name of what stands before it"
            continue
        kind = _class_of(item)
        if isinstance(item, h5py.Group):
            if "MATLAB_object_decode" in item.attrs or kind not in ("struct", ""):
                found.skipped[full] = f"is a MATLAB {kind}; {AS_STRUCT}, or writetable"
            elif depth >= _DEPTH:
                raise DataError(found.source, f"{full} is nested too deep", "save plain vectors")
            else:
                _collect(found, f"{full}.", item, depth + 1)
        elif isinstance(item, h5py.Dataset):
            _add(found, full, item, kind)


def _add(found: _Found, name: str, dataset: Any, kind: str) -> None:
    """Read one dataset, when it is numeric."""
    if dataset.external or dataset.is_virtual:
        raise DataError(found.source, f"{name} lies in another file", "save the signals themselves")
    reason = _unreadable(dataset, kind)
    if reason:
        found.skipped[name] = reason
        return
    # HDF5 takes the memory of a whole chunk, however little of it is filled.
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
    """Why a dataset has no column, from what the file says of it; empty when it may have one."""
    if "MATLAB_object_decode" in dataset.attrs or kind not in (*_NUMERIC, ""):
        reasons = {"char": "is text", "cell": f"is a cell array; {AS_STRUCT}, or cell2mat"}
        return reasons.get(kind, f"is a MATLAB {kind}; {AS_STRUCT}, or writetable")
    if not dataset.size or _attribute(dataset, "MATLAB_empty"):
        return "is empty"
    if dataset.dtype.names is not None:
        return "is complex"
    if dataset.dtype.kind not in "fiub":
        return "is not numeric"
    if dataset.ndim > 2:
        return f"has {dataset.ndim} dimensions"
    return "" if dataset.id.get_storage_size() else "has no values, only one to fill it with"


def _seen(found: _Found, item: Any) -> bool:
    """Whether the object was met before; it is from now on."""
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
    """An attribute of one word or number; None where there is none."""
    if name not in item.attrs:
        return None
    attribute = item.attrs.get_id(name)
    if attribute.shape != () or attribute.get_storage_size() > _MOST_IDENTIFIED:
        raise ValueError(f"the attribute {name} is too long")
    return item.attrs[name]
