"""Whose code a module is: Python's, installed, or the user's own; and who may have it run.

A study file that names a plant `module:function` asks for that module to be imported and that
function to be called. Somebody else may have written the file: such a name needs the consent of
whoever types the command. The plants of this package, and saved matrices, need none
(docs/security.md).
"""

from __future__ import annotations

import sysconfig
from pathlib import Path

from impc.errors import InputError

#: This package's own modules; they are known by their version.
OURS = ("impc", "plants")
_DATA = (".mat", ".npz", ".json")


def consented_name(
    where: str, named: str, given: str | None, allowed: bool, option: str, known: tuple[str, ...]
) -> str:
    """The plant or model that may be run, when the place `where` in a file has `named` one.

    What the command line has `given` replaces it; `allowed` says whether it allows what the file
    names. `option` is "plant" or "model", and `known` are short names of this package's own.
    """
    name = given or named
    if not name:
        raise InputError(where, "is missing", f'write {option} = "module:function"')
    module = name.partition(":")[0]
    data = option == "plant" and Path(name).suffix in _DATA  # a model is never a file
    if name in known or data or module == "plants" or ":" not in name:
        return name  # the last: no name of code at all, and told so by who looks for it
    if given is None and not allowed:
        raise InputError(
            where, f"names code that would be run, {name!a}",
            f"look at it, then say --{option} {name}, or --allow-{option}",
        )  # fmt: skip
    return name


def is_installed(file: Path) -> bool:
    """Whether the `file` of a module belongs to Python or was installed."""
    path = file.resolve()
    if {"site-packages", "dist-packages"} & set(path.parts):
        return True
    libraries = (Path(sysconfig.get_path(key)).resolve() for key in ("stdlib", "platstdlib"))
    return any(path.is_relative_to(library) for library in libraries)
