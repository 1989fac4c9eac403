"""Read a state space, matrices and names, from a .mat, .npz or .json file."""

from __future__ import annotations

import json
import math
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from impc.errors import ImpcError, InputError, brief
from impc.files.apart import matrices_apart
from impc.files.disk import require_readable

#: Endings of the files that hold a plant.
SAVED = (".mat", ".npz", ".json")

_MATRICES = ("A", "B", "C", "D")
_NAMES = ("states", "inputs", "outputs")
_NEEDED = ("A", "B", "C", "dt")
_REMEDY = "save A, B, C and dt in it, MATLAB: -v7"
# Bytes of a file and of its unpacked content: a plant of 1000 states has 8 MB.
_LARGEST = 50_000_000
# Largest entry: its fourth power must be finite for balancing and the Riccati equation.
_MOST = 1e70


def read_matrices(path: Path) -> dict[str, Any]:
    """Unchecked content by name of a .mat (up to v7), .npz or .json file; no pickles."""
    require_readable(path, _LARGEST, InputError)
    subject = f"plant {path}"
    read = {".json": _from_json, ".npz": _from_npz, ".mat": _from_mat}[path.suffix]
    try:
        found = read(path)
    except RecursionError:
        raise InputError(subject, "is nested too deep", _REMEDY) from None
    except ImpcError:
        raise
    except MemoryError:
        raise InputError(subject, "is too large once it is unpacked", _REMEDY) from None
    except Exception as error:  # zipfile, zlib, numpy and json raise a dozen kinds
        reason = " ".join(str(error).split())[:120] or type(error).__name__
        raise InputError(subject, f"cannot be read ({reason})", _REMEDY) from None
    if not isinstance(found, dict):
        raise InputError(subject, "has no named entries", "save A, B, C and dt in it")
    missing = [name for name in _NEEDED if name not in found]
    if missing:
        raise InputError(subject, f"lacks {', '.join(missing)}", "save A, B, C and dt in it")
    return found


def state_space(name: str, given: Mapping[str, Any]) -> Any:
    """`control.StateSpace` of the given matrices; `name` of the file, for messages."""
    import control  # noqa: PLC0415  # a second; it imports matplotlib

    subject = f"plant {name}"
    unknown = [key for key in given if key not in (*_MATRICES, "dt", *_NAMES, "units")]
    if unknown:
        raise InputError(
            subject,
            f"has an unknown entry {brief(unknown[0], 80)}",
            f"use A, B, C, D, dt, units and {list(_NAMES)}",
        )
    matrices = {key: _matrix(subject, key, given[key]) for key in _MATRICES if key in given}
    dt = _matrix(subject, "dt", given["dt"])
    if dt.size != 1 or not math.isfinite(dt.item()):
        raise InputError(subject, "has a dt that is not one number", "give dt in s, or 0")
    A, B, C = (matrices[key] for key in "ABC")
    sizes = {"states": len(A), "inputs": B.shape[1], "outputs": len(C)}
    D = matrices.get("D", np.zeros((sizes["outputs"], sizes["inputs"])))
    labels = {key: _labels(subject, key, given[key]) for key in _NAMES if key in given}
    for key, names in labels.items():
        if len(names) != sizes[key]:
            raise InputError(
                subject,
                f"names {len(names)} {key}, but has {sizes[key]}",
                f"give a name for each of the {key}, or none",
            )
    system = control.ss(A, B, C, D, dt.item(), **labels)
    system.units = given.get("units", {})
    return system


def _from_json(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


def _from_npz(path: Path) -> dict[str, Any]:
    with zipfile.ZipFile(path) as archive:
        if sum(member.file_size for member in archive.infolist()) > _LARGEST:
            raise MemoryError
    with np.load(path, allow_pickle=False) as arrays:
        return {name: arrays[name] for name in arrays.files}


def _from_mat(path: Path) -> dict[str, Any]:
    with path.open("rb") as file:
        head = file.read(128)
    version = int.from_bytes(head[124:126], "big" if head[126:128] == b"MI" else "little") >> 8
    if not head.startswith(b"MATLAB ") or version != 1:
        raise ValueError("no MATLAB file of version 5 to 7")
    return matrices_apart(path, _LARGEST)


def _matrix(subject: str, name: str, value: Any) -> Any:
    """Real matrix `value` called `name`."""
    try:
        array = np.atleast_2d(np.asarray(value))
    except ValueError:  # rows of unequal length
        array = np.array([[None]])
    if array.dtype.kind == "c":
        raise InputError(subject, f"has a complex matrix {name}", "save real numbers")
    if array.dtype.kind not in "fiu" or array.ndim != 2:
        problem = f"has a {name} that is not a matrix of numbers"
        raise InputError(subject, problem, "save real matrices")
    if array.size and np.abs(array.astype(np.float64)).max() > _MOST:
        problem = f"has entries beyond {_MOST:g} in {name}"
        raise InputError(subject, problem, "give the plant in other units")
    return array.astype(np.float64)


def _labels(subject: str, name: str, value: Any) -> list[str]:
    """Names from a text, a list or an array."""
    if isinstance(value, str):
        value = [value]
    found = [item.item() if isinstance(item, np.ndarray) else item for item in _flat(value)]
    if not found or not all(isinstance(item, str | int) and str(item).strip() for item in found):
        raise InputError(subject, f"has {name} that are not names", "save a list of texts")
    found = [str(item).strip() for item in found]
    repeated = next((item for item in found if found.count(item) > 1), None)
    if repeated is not None:
        raise InputError(subject, f"names two {name} {repeated!r}", "give each its own name")
    return found


def _flat(value: Any) -> list[Any]:
    if isinstance(value, np.ndarray):
        value = value.ravel().tolist()
    if not isinstance(value, list | tuple):
        return [value]
    return [
        inner for item in value for inner in (item if isinstance(item, list | tuple) else [item])
    ]
