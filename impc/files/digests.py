"""What a result depends on, as one number: recordings, plant, settings and versions, all of them.

A result that is kept carries the digest of everything that went into it. `digest` takes values,
`content_digest` a file from its first byte to its last, `source_digest` the code or the file of a
plant or model, and `versions` what computes. A file that a plant's own code opens is known when its
name is an argument of the plant, and not otherwise (docs/security.md).
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import importlib.metadata
import numbers
import platform
import sys
from collections.abc import Mapping, Sequence, Set
from datetime import date, datetime
from datetime import time as time_of_day
from modulefinder import ModuleFinder
from pathlib import Path, PurePath
from types import CodeType
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from impc.errors import DataError
from impc.files.user_code import OURS, is_installed, module_file

if TYPE_CHECKING:
    from collections.abc import Iterator
    from types import ModuleType

# What computes: another version of any of them may give other digits.
_PACKAGES = ("casadi", "clarabel", "control", "cvxpy", "numba", "numpy", "scipy")
_PLANT_FILES = (".mat", ".npz", ".json")
# Digest of a module's source, taken once a process: Python does not read a module again either.
_SOURCES: dict[ModuleType, str] = {}


def digest(*parts: object) -> str:
    """SHA-256 of the `parts`, hexadecimal: of their kinds, sizes and contents.

    None, numbers, text, bytes, paths, dates, arrays of numbers, and mappings, sequences, sets,
    dataclasses and msgspec structs of such.
    """
    text = hashlib.sha256()
    for piece in _pieces(parts):
        # With its length, so that ("ab", "c") is not ("a", "bc").
        text.update(f"{len(piece)}:".encode())
        text.update(piece)
    return text.hexdigest()


def _pieces(value: Any) -> Iterator[bytes]:
    kind = type(value).__name__.encode()
    if value is None or isinstance(value, (bool, str, PurePath, numbers.Number, date, datetime)):
        number = value.item() if isinstance(value, np.generic) else value
        yield (
            type(number).__name__.encode() + b" " + repr(number).encode("utf-8", "backslashreplace")
        )
    elif isinstance(value, time_of_day):
        yield kind + repr(value).encode()
    elif isinstance(value, bytes):
        yield b"bytes " + value
    elif isinstance(value, np.ndarray) and value.dtype.kind in "biufc":
        yield f"array {value.dtype.str} {value.shape}".encode()
        yield np.ascontiguousarray(value).tobytes()
    elif isinstance(value, Mapping):
        yield f"mapping {len(value)}".encode()
        for key in sorted(value, key=repr):
            yield from _pieces(key)
            yield from _pieces(value[key])
    elif isinstance(value, Set):
        yield from _pieces(sorted(value, key=repr))
    elif isinstance(value, Sequence):
        yield f"sequence {len(value)}".encode()
        for item in value:
            yield from _pieces(item)
    else:
        yield kind
        yield from _pieces(_fields(value))


def _fields(value: Any) -> dict[str, Any]:
    if isinstance(value, msgspec.Struct):
        return {name: getattr(value, name) for name in value.__struct_fields__}
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {item.name: getattr(value, item.name) for item in dataclasses.fields(value)}
    raise TypeError(f"no digest of a {type(value).__name__}")


def content_digest(path: Path) -> str:
    """SHA-256 of the whole file at `path`, hexadecimal; 0.4 to 2 GB a second."""
    try:
        if path.exists() and not path.is_file():
            raise DataError(f"file {path.name}", "is no ordinary file", "name a file")
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise DataError(
            f"file {path.name}", f"cannot be opened ({reason})", "check the path"
        ) from None


@functools.cache
def versions() -> dict[str, str]:
    """Of Python, of the packages that compute, and the digest of this package's own source."""
    found = {"python": platform.python_version()}
    for name in _PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "not installed"
    here = Path(__file__).resolve().parents[1]
    sources = sorted(path for name in OURS for path in (here.parent / name).rglob("*.py"))
    found["impc"] = digest(
        [(path.relative_to(here.parent).as_posix(), path.read_bytes()) for path in sources]
    )
    return found


def source_digest(name: str, arguments: Mapping[str, Any] | None = None) -> str:
    """Of the plant or model `name`: a file's content, or the user's code that it is made of.

    The code is the module that is named and all modules that it imports, as long as they are no
    part of Python, of this package or of what is installed: those are told by `versions`. The
    module has to be imported already. Of `arguments` that name a file its content counts.
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
    except (OSError, ValueError):  # too long, or with a NUL: the name of no file
        return False


def _source(module: ModuleType) -> str:
    if module not in _SOURCES:
        found: dict[str, bytes] = {}
        _gather(module.__name__, module_file(module.__name__, None), found)
        _SOURCES[module] = digest(found)
    return _SOURCES[module]


def _gather(name: str, file: Path | None, found: dict[str, bytes]) -> None:
    """Add the source of a module of the user's, and of those of the user's that it imports."""
    if name in found or name.partition(".")[0] in OURS or file is None or is_installed(file):
        return
    found[name] = file.read_bytes()
    if file.suffix == ".py":
        package = name if file.name == "__init__.py" else name.rpartition(".")[0]
        for other in sorted(_imports(found[name], package)):
            _gather(other, module_file(other, file.parent), found)


def _imports(source: bytes, package: str) -> set[str]:
    """Names of all modules that a source may import, anywhere in it.

    From its code and not from its syntax tree: `ast.parse` fails now and then in Python 3.11 when
    another thread parses at the same time.
    """
    try:
        code = compile(source, package, "exec", dont_inherit=True)
    except (SyntaxError, ValueError):  # of a file that cannot be imported
        return set()
    # A package's own __init__ runs too when a module in it is imported.
    return {part for name in _imported(code, package) for part in _with_parents(name)}


def _imported(code: CodeType, package: str) -> Iterator[str]:
    for kind, found in ModuleFinder().scan_opcodes(code):
        if kind == "absolute_import":
            level, (names, base) = 0, found
        elif kind == "relative_import":
            level, names, base = found
        else:
            continue
        base = _absolute(base, level, package)
        yield base
        yield from (f"{base}.{name}" for name in names or ())
    for inner in code.co_consts:
        if isinstance(inner, CodeType):
            yield from _imported(inner, package)


def _absolute(name: str, level: int, package: str) -> str:
    """What `from ..name import` imports from, its leading dots resolved."""
    if not level:
        return name
    parts = package.split(".")
    return ".".join([*parts[: len(parts) - level + 1], *([name] if name else [])])


def _with_parents(name: str) -> list[str]:
    parts = name.split(".")
    return [".".join(parts[: count + 1]) for count in range(len(parts))]
