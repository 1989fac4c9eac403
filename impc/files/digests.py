"""SHA-256 digests of everything a result depends on: recordings, plant, settings, versions.

Stored results carry the digest of all their inputs, and result.json lists it (`Inputs`). A file
that a plant's own code opens is included only if its name is an argument of the plant
(docs/ref/security.md).
"""

from __future__ import annotations

import ast
import functools
import hashlib
import importlib.metadata
import os
import platform
import sys
import sysconfig
import threading
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath
from types import ModuleType
from typing import Any

import msgspec
import numpy as np

from impc.errors import DataError
from impc.files.disk import require_ordinary

# This package's own modules; `versions` covers them.
_OURS = ("impc", "plants")
# Packages that compute: another version of any of them may give other digits.
_PACKAGES = ("casadi", "clarabel", "control", "cvxpy", "numba", "numpy", "scipy")
_PLANT_FILES = (".mat", ".npz", ".json")
# In Python 3.11 two threads that parse at the same time occasionally fail.
_PARSING = threading.Lock()


def digest(*parts: object) -> str:
    """SHA-256, hexadecimal, of plain values, arrays, paths, and containers or structs of them."""
    text = msgspec.msgpack.encode(parts, enc_hook=_written, order="deterministic")
    return hashlib.sha256(text).hexdigest()


def _written(value: Any) -> Any:
    """Encode a `value` of a type that msgspec does not know."""
    if isinstance(value, np.ndarray) and value.dtype.kind in "biufc":
        return value.dtype.str, value.shape, value.tobytes()
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, PurePath):
        return os.fsencode(value)
    if isinstance(value, Mapping):
        return dict(value)
    raise TypeError(f"no digest of a {type(value).__name__}")


def content_digest(path: Path) -> str:
    """SHA-256 of the file at `path`, hexadecimal."""
    try:
        require_ordinary(path)
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise DataError(
            f"file {path.name}", f"cannot be opened ({reason})", "check the path"
        ) from None


@functools.cache
def versions() -> dict[str, str]:
    """Versions of Python and of the packages that compute; digest of this package's source."""
    found = {"python": platform.python_version()}
    for name in _PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "not installed"
    here = Path(__file__).resolve().parents[1]
    sources = sorted(path for name in _OURS for path in (here.parent / name).rglob("*.py"))
    found["impc"] = digest(
        [(path.relative_to(here.parent).as_posix(), path.read_bytes()) for path in sources]
    )
    return found


def source_digest(name: str, arguments: Mapping[str, Any] | None = None) -> str:
    """Digest of plant or model `name`: a file's content, or the user's code that defines it.

    The code is the named module (already imported) and the modules in its folder and below that it
    imports. Of `arguments` that name a file, the content counts.
    """
    given = {
        key: (value, content_digest(Path(value)) if _names_a_file(value) else None)
        for key, value in (arguments or {}).items()
    }
    if Path(name).suffix in _PLANT_FILES:
        return digest(name, given, content_digest(Path(name)))
    module = sys.modules.get(name.partition(":")[0])
    return digest(name, given, "" if module is None else _source(module))


def _names_a_file(value: object) -> bool:
    try:
        return isinstance(value, str) and Path(value).is_file()
    except (OSError, ValueError):  # too long, or contains NUL
        return False


@functools.cache  # once a process: Python does not reload modules either
def _source(module: ModuleType) -> str:
    file = Path(getattr(module, "__file__", None) or "")
    found: dict[str, bytes] = {}
    if file.is_file() and not _is_installed(file):
        depth = module.__name__.count(".") + (file.name == "__init__.py")
        _gather(file, file.parents[depth], found)
    return digest(found)


def _is_installed(file: Path) -> bool:
    """Whether the `file` of a module belongs to Python or was installed."""
    path = file.resolve()
    if {"site-packages", "dist-packages"} & set(path.parts):
        return True
    libraries = (Path(sysconfig.get_path(key)).resolve() for key in ("stdlib", "platstdlib"))
    return any(path.is_relative_to(library) for library in libraries)


def _gather(file: Path, root: Path, found: dict[str, bytes]) -> None:
    """Add a user's `file`, and recursively the files in folder `root` that it imports."""
    key = os.path.relpath(file, root)
    if key in found or Path(key).parts[0] in _OURS:
        return
    found[key] = file.read_bytes()
    for base, name in _imports(file, root) if file.suffix == ".py" else ():
        parts = name.split(".")
        for count in range(1, len(parts) + 1):  # a package's __init__ runs too
            place = base.joinpath(*parts[:count])
            for other in (place.with_suffix(".py"), place / "__init__.py"):
                if other.is_file():
                    _gather(other, root, found)


def _imports(file: Path, root: Path) -> Iterator[tuple[Path, str]]:
    """Folder and name of every module that a `file` may import."""
    try:
        with _PARSING:
            tree = ast.parse(file.read_bytes())
    except (SyntaxError, ValueError):  # the file cannot be imported
        return
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((root, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            up = [".."] * (node.level - 1)
            base = file.parent.joinpath(*up) if node.level else root
            yield from (
                (base, f"{node.module or ''}.{alias.name}".strip(".")) for alias in node.names
            )


@dataclass(frozen=True)
class Inputs:
    """SHA-256 of the inputs of a result."""

    # of each file, in the order given; of a study, by analysis unit
    recordings: tuple[str, ...] | Mapping[str, tuple[str, ...]]
    configuration: str  # of the configuration or study file
    code: str  # of code or file of the plant or model, and its arguments
    versions: str  # of Python, of the packages that compute, and of this package's source
    kind: str = "plant"  # what `code` describes: "plant" or "model"

    @property
    def digest(self) -> str:
        """Digest of all of them."""
        return digest(self)

    def plain(self) -> Mapping[str, Any]:
        """Mapping as written to result.json."""
        return {
            "recordings": self.recordings,
            "configuration": self.configuration,
            self.kind: self.code,
            "versions": self.versions,
            "all": self.digest,
        }


def gather_inputs(
    recordings: Sequence[Path] | Mapping[str, Sequence[Path]],
    configuration: Path,
    name: str,
    arguments: Mapping[str, Any],
    kind: str = "plant",
) -> Inputs:
    """Compute the digests of `recordings`, `configuration` and plant or model.

    `recordings` are files, or files by analysis unit. `name` is the plant's file or import path
    (already imported), with its `arguments`; `kind` is "plant" or "model".
    """
    contents: tuple[str, ...] | Mapping[str, tuple[str, ...]]
    if isinstance(recordings, Mapping):
        contents = {unit: tuple(map(content_digest, files)) for unit, files in recordings.items()}
    else:
        contents = tuple(map(content_digest, recordings))
    code = digest(source_digest(name, arguments), dict(arguments))
    return Inputs(contents, content_digest(configuration), code, digest(versions()), kind)
