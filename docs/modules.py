"""A page for each module, and tables of them by package, written when the site is built.

The pages are orphans: a theme lists every page of the tree beside every other page, which for some
hundred and sixty modules took longer than all else. `api.md` shows the tables.
"""

from __future__ import annotations

import importlib
import inspect
import pkgutil
import shutil
from collections import defaultdict
from pathlib import Path

_PAGE = """\
:orphan:

{name}
{line}

.. automodule:: {name}
{names}"""
_TABLE = """\
{package}
{line}

.. autosummary::
   :nosignatures:

{names}

"""


def write_modules(folder: Path, packages: tuple[str, ...]) -> None:
    """Write the page of every module of some packages, and `tables.txt`.

    Parameters
    ----------
    folder : Path
        Emptied first.
    packages : tuple of str
        Their import names.
    """
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    rooms = defaultdict(list)
    for package in packages:
        for name in [package, *_inside(package)]:
            (folder / f"{name}.rst").write_text(_page(name), encoding="utf-8")
            rooms[_room(name)].append(name)
    tables = (
        _TABLE.format(package=room, line="-" * len(room), names=_indented(names))
        for room, names in rooms.items()
    )
    (folder / "tables.txt").write_text("".join(tables), encoding="utf-8")


def _inside(package: str) -> list[str]:
    found = importlib.import_module(package)
    return [item.name for item in pkgutil.walk_packages(found.__path__, f"{package}.")]


def _room(name: str) -> str:
    """The package that a module is in; a package is in itself."""
    module = importlib.import_module(name)
    return module.__package__ or name


def _page(name: str) -> str:
    module = importlib.import_module(name)
    public = [
        item
        for item, thing in vars(module).items()
        if not item.startswith("_")
        and _identified(thing)
        and inspect.unwrap(thing).__module__ == name
    ]
    names = (
        f"\n   .. autosummary::\n      :nosignatures:\n\n{_indented(public, 6)}\n" if public else ""
    )
    return _PAGE.format(name=name, line="=" * len(name), names=names)


def _identified(thing: object) -> bool:
    """Classes and functions: of anything else autosummary would show its type's docstring."""
    plain = inspect.unwrap(thing) if callable(thing) else thing
    return inspect.isclass(plain) or inspect.isroutine(plain)


def _indented(names: list[str], by: int = 3) -> str:
    return "\n".join(" " * by + name for name in names)
