"""Every public name says what it takes and gives: what users import, its methods, and commands."""

from __future__ import annotations

import builtins
import inspect
import re
from collections.abc import Iterator
from typing import Any

import click
from numpydoc.docscrape import NumpyDocString

import impc.errors
import plants
from impc.arrays import Array
from impc.cli.main import main

ARRAY = re.compile(r"\b(?:(?:Bool|Int|Complex)?Array|ArrayLike|NDArray|ndarray|Buffer)\b")
NUMBER = r"(?:\d+|N m|N|[a-z]\w*)"
SIZE = rf"(?:\.\.\.|{NUMBER}(?: ?[-+*/] ?{NUMBER})*)"
SHAPE = rf"(?:\({SIZE},\)|\({SIZE}(?:, {SIZE})+\)|\b(?:any|same|that) shape\b)"


def public_names() -> Iterator[tuple[str, Any]]:
    """By module:name; constants have no docstring."""
    given = [getattr(place, name) for place in (impc, plants) for name in place.__all__]
    for value in map(inspect.unwrap, given):
        if not (inspect.isclass(value) or inspect.isfunction(value)):
            continue
        place = f"{value.__module__}:{value.__name__}"
        yield place, value
        for member in vars(value) if inspect.isclass(value) else ():
            found = getattr(value, member)
            method = getattr(found, "__func__", getattr(found, "fget", found))
            method = getattr(method, "func", method)  # of a cached property
            default = member in vars(value).get("__annotations__", {})  # of a field
            if inspect.isfunction(method) and not (default or member.startswith("_")):
                yield f"{place}.{member}", method


def faults(value: Any) -> list[str]:
    """What is wrong with the docstring of a class or a function."""
    text = vars(value).get("__doc__") if inspect.isclass(value) else value.__doc__
    if not text or text.startswith(f"{value.__name__}("):  # what a dataclass writes
        return ["no docstring"]
    doc = NumpyDocString(inspect.cleandoc(text))
    prose = " ".join([*doc["Summary"], *doc["Extended Summary"], *doc["Notes"]])
    found = [*item_faults(value, doc, prose)]
    if inspect.isfunction(value):
        listed = [each.name or each.type for each in doc["Raises"]]
        errors = [name.strip() for each in listed for name in each.split(",") if name]
        known = {**vars(builtins), **vars(impc.errors)}
        found += [f"{name}: in Raises, does not exist" for name in errors if name not in known]
        kinds = [each for each in doc["Returns"] if ARRAY.search(each.type)]
        found += [
            f"returns {each.type}: no shape"
            for each in kinds
            if not re.search(SHAPE, " ".join([each.type, *each.desc]))
        ]
    return found


def item_faults(value: Any, doc: NumpyDocString, prose: str) -> Iterator[str]:
    """Parameters and fields: described, arrays with their shape."""
    fields = vars(value).get("__annotations__", {}) if inspect.isclass(value) else {}
    items = {name: str(kind) for name, kind in fields.items() if not name.startswith("_")}
    if inspect.isfunction(value):
        given = inspect.signature(value).parameters
        items = {name: str(one.annotation) for name, one in given.items()}
    identified = {
        name.strip(" *"): " ".join([each.type, "-", *each.desc])
        for each in doc["Attributes" if fields else "Parameters"]
        for name in each.name.split(",")
    }
    if inspect.isfunction(value) or fields:
        yield from (f"{name}: there is none" for name in identified if name not in items)
    for name, kind in items.items():
        if name in ("self", "cls"):
            continue
        # A class of the package describes itself.
        known = re.search(r"\b[A-Z]\w+", kind) and not ARRAY.search(kind)
        if name not in identified and (fields or not (known or re.search(rf"\b{name}\b", prose))):
            yield f"{name}: not described"
        shape = SHAPE if name in identified else rf"\b{name}\b[^.]{{0,40}}?{SHAPE}"
        if ARRAY.search(kind) and not re.search(shape, identified.get(name, prose)):
            yield f"{name}: no shape"


def test_public_docstrings_say_it_all() -> None:
    names = dict(public_names())
    assert len(names) > 60
    assert {name: found for name, value in names.items() if (found := faults(value))} == {}


def test_every_option_of_a_command_has_its_help() -> None:
    assert len(main.commands) > 10
    for name, command in main.commands.items():
        options = [one for one in command.params if isinstance(one, click.Option)]
        assert command.help
        assert [one.name for one in options if not one.help] == [], name


def test_a_poor_docstring_is_found() -> None:
    def poor(gain: Array, count: int) -> Array:
        """Return something.

        Parameters
        ----------
        gain : Array
            Of the regulator.
        other : int

        Raises
        ------
        NoSuchError
            Never.
        """
        return gain * count

    said = ["NoSuchError: in Raises, does not exist", "count: not described", "gain: no shape"]
    assert sorted(faults(poor)) == [*said, "other: there is none"]
