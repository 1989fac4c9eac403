"""Every public name says what it takes, what it gives, how it fails and where it comes from.

Checked of what users import from `impc` and `plants`, of the public methods of its classes, and of
commands; what is not public has a plain line, and comments beside its fields:

- every parameter is described in `Parameters`, or named in the text above the sections; one whose
  type is a class of this project may do without, for that class describes it. Every field of a
  class is described in `Attributes`, every member of an enumeration is named;
- an array, taken, kept or returned, has a shape: lower-case sizes, numbers or N in parentheses,
  such as `(n, n)` or `(N + 1, n)`, or the words any, same or that shape; in the text within forty
  characters of its name;
- an error raised in the function, or in the private functions of the module that it calls, is in
  `Raises`, and what is in `Raises` exists;
- a number or an array named after a time, a rate or a quantity of mechanics has a unit, and a field
  with a unit in its metadata has that one;
- the docstring or its module's cites an equation, a table, a chapter, a page of this documentation
  or a paper by its year; a page exists, with its section. `PLUMBING` need not cite.

Not checked: that a shape, a unit or a citation is the right one; the units of states, inputs and
outputs, which are those of the plant; errors raised in other modules.
"""

from __future__ import annotations

import ast
import builtins
import enum
import importlib
import inspect
import pkgutil
import re
import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import click
import pytest
from numpydoc.docscrape import NumpyDocString

import impc.errors
import plants
from impc.arrays import Array

ROOT = Path(__file__).parents[2]

# Without an equation to cite: errors, files, commands, recordings, settings.
PLUMBING = ("impc.errors", "impc.files.", "impc.cli.", "impc.model.recordings", "impc.studies.fit.")

ARRAY = re.compile(r"\b(?:(?:Bool|Int|Complex)?Array|ArrayLike|NDArray|ndarray|Buffer)\b")
NUMBER = r"(?:\d+|N m|N|[a-z]\w*)"
SIZE = rf"(?:\.\.\.|{NUMBER}(?: ?[-+*/] ?{NUMBER})*)"
SHAPE = rf"(?:\({SIZE},\)|\({SIZE}(?:, {SIZE})+\)|\b(?:any|same|that) shape\b)"
PHYSICAL = re.compile(
    r"(?:^|_)(?:dt|(?:time|period|duration|delay|rate|mass|height|length|angle|torque|force)s?"
    r"|seconds|frequency|frequencies|stiffness|damping|gravity)(?:$|_)"
)
UNIT = re.compile(
    r"(?<![\w'.])(?:m?s|Hz|h|kg|[cm]?m|inches|rad|deg|degrees|Nm|seconds?|unit)(?![\w'])"
)
SOURCE = re.compile(
    r"\([0-9A-D]\.\d+\)|Table [0-9A-D]|[Ss]ections? [0-9A-D]|[Cc]hapters? [0-9A-D]"
    r"|Appendix [A-D]|docs/[\w/-]+\.md|[A-Z]\w+(?: et al\.)?[^.]{0,40}\b(?:19|20)\d\d\b"
)
PAGE = re.compile(r"(docs/[\w/-]+\.md)(?:,\s+section\s+(\d+))?")


def modules() -> Iterator[ModuleType]:
    for package in (impc, plants):
        for found in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            if not found.ispkg:
                yield importlib.import_module(found.name)


def public_names() -> Iterator[tuple[str, Any]]:
    """What users import, with the public methods of classes, and commands: by module:name."""
    given = [getattr(place, name) for place in (impc, plants) for name in place.__all__]
    for value in map(inspect.unwrap, given):
        if not (inspect.isclass(value) or inspect.isfunction(value)):
            continue  # a constant
        place = f"{value.__module__}:{value.__name__}"
        yield place, value
        for member, found in vars(value).items() if inspect.isclass(value) else ():
            method = getattr(found, "__func__", getattr(found, "fget", found))
            method = getattr(method, "func", method)  # of a cached property
            default = member in vars(value).get("__annotations__", {})  # of a field
            if inspect.isfunction(method) and not (default or member.startswith("_")):
                yield f"{place}.{member}", method
    for module in modules():
        if isinstance(value := getattr(module, "command", None), click.Command):
            yield f"{module.__name__}:command", value


NAMES = dict(public_names())
CLASSES = {name for each in modules() for name, one in vars(each).items() if inspect.isclass(one)}


def faults(key: str, value: Any) -> list[str]:
    """What the docstring of a public name lacks."""
    module = sys.modules[key.partition(":")[0]]
    if isinstance(value, click.Command):
        options = [each for each in value.params if isinstance(each, click.Option)]
        bare = [f"--{each.name}: no help" for each in options if not each.help]
        return bare if value.help else ["no help", *bare]
    text = vars(value).get("__doc__") if inspect.isclass(value) else value.__doc__
    if not text or text.startswith(f"{value.__name__}("):  # what a dataclass writes
        return ["no docstring"]
    doc = NumpyDocString(inspect.cleandoc(text))
    found = [*item_faults(value, doc), *source_faults(module, text)]
    if inspect.isfunction(value):
        found += [*return_faults(value, doc), *error_faults(value, doc)]
    elif issubclass(value, enum.Enum):
        found += [f"{each}: not named" for each in value.__members__ if each not in text]
    return found


def prose(doc: NumpyDocString) -> str:
    return " ".join([*doc["Summary"], *doc["Extended Summary"], *doc["Notes"]])


def item_faults(value: Any, doc: NumpyDocString) -> Iterator[str]:
    """Parameters and fields: described, with shape and unit."""
    fields = vars(value).get("__annotations__", {}) if inspect.isclass(value) else {}
    items = {name: str(kind) for name, kind in fields.items() if not name.startswith("_")}
    made = "__init__" in vars(value) and not getattr(value, "_is_protocol", False)
    if inspect.isfunction(value) or (made and not fields):
        given = list(inspect.signature(value).parameters.values())
        items = {
            each.name: str(each.annotation) for each in given if each.name not in ("self", "cls")
        }
    told = {}
    for each in doc["Attributes" if fields else "Parameters"]:
        for name in each.name.split(","):
            told[name.strip(" *")] = " ".join([each.type, "-", *each.desc])
    yield from (f"{name}: there is none" for name in told if name not in items)
    for name, kind in items.items():
        known = CLASSES.intersection(re.findall(r"\w+", kind))
        words = told.get(name, prose(doc))
        if name not in told and (fields or not (known or re.search(rf"\b{name}\b", words))):
            yield f"{name}: not described"
        elif not known and words.endswith("-"):
            yield f"{name}: only its type is told"
        shape = SHAPE if name in told else rf"\b{name}\b[^.]{{0,40}}?{SHAPE}"
        if ARRAY.search(kind) and not re.search(shape, words):
            yield f"{name}: no shape"
        physical = PHYSICAL.search(name) and re.search("float|Array", kind)
        if physical and not UNIT.search(re.sub(SHAPE, "", words)):
            yield f"{name}: no unit"
    for name, field in getattr(value, "__dataclass_fields__", {}).items():
        if field.metadata.get("unit", "") not in told.get(name, ""):
            yield f"{name}: not in {field.metadata['unit']}"


def return_faults(function: Any, doc: NumpyDocString) -> Iterator[str]:
    """Each array of `Returns` has a shape; without it the text has one for each array."""
    kind = str(inspect.signature(function).return_annotation)
    told = [each for each in doc["Returns"] if ARRAY.search(each.type)]
    lacking = [each for each in told if not re.search(SHAPE, " ".join([each.type, *each.desc]))]
    text = prose(doc)
    for each in inspect.signature(function).parameters.values():  # theirs are not counted
        if ARRAY.search(str(each.annotation)):
            text = re.sub(rf"\b{each.name}\b[^.]{{0,40}}?{SHAPE}", "", text)
    arrays = len(ARRAY.findall(kind.split("Callable", maxsplit=1)[0]))
    if lacking or (not told and len(re.findall(SHAPE, text)) < arrays):
        yield f"returns {kind}: no shape"


def error_faults(function: Any, doc: NumpyDocString) -> Iterator[str]:
    """Errors that are raised and not told, or told and unknown."""
    told = ",".join(each.name or each.type for each in doc["Raises"])
    listed = [name.strip() for name in told.split(",") if name]
    for name in raised(function, set()).difference(listed):
        yield f"{name}: raised, not in Raises"
    for name in listed:
        places = (sys.modules[function.__module__], impc.errors, builtins)
        error = next((vars(place)[name] for place in places if name in vars(place)), None)
        if not (inspect.isclass(error) and issubclass(error, BaseException)):
            yield f"{name}: in Raises, does not exist"


def raised(function: Any, seen: set[Any]) -> set[str]:
    """Names of the errors raised in a function and in the private ones that it calls."""
    seen.add(function)
    names = vars(sys.modules[function.__module__])
    found: set[str] = set()
    for node in inside(ast.parse(textwrap.dedent(inspect.getsource(function))).body[0]):
        if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call):
            name = ast.unparse(node.exc.func)
            maker = names.get(name)  # an error, or a function that makes one
            made = inspect.signature(maker).return_annotation if inspect.isfunction(maker) else name
            found |= {str(made)} if made in names or made in vars(builtins) else set()
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            called = inspect.unwrap(names.get(node.func.id, len))
            if inspect.isfunction(called) and node.func.id.startswith("_") and called not in seen:
                found |= raised(called, seen)
    return found


def inside(node: ast.AST) -> Iterator[ast.AST]:
    """All nodes below but those of functions within."""
    for child in ast.iter_child_nodes(node):
        if not isinstance(child, ast.FunctionDef | ast.Lambda):
            yield child
            yield from inside(child)


def source_faults(module: ModuleType, text: str) -> Iterator[str]:
    whole = f"{text}\n{module.__doc__}"
    if not (SOURCE.search(whole) or module.__name__.startswith(PLUMBING)):
        yield "no source"
    for page, section in PAGE.findall(whole):
        there = (ROOT / page).read_text(encoding="utf-8") if (ROOT / page).exists() else ""
        if not re.search(rf"^## {section}\." if section else ".", there, re.MULTILINE):
            yield f"{page} {section}: does not exist"


@pytest.mark.parametrize("key", NAMES)
def test_the_docstring_says_it_all(key: str) -> None:
    assert faults(key, NAMES[key]) == []


def poor(gain: Array, sample_time: float, count: int) -> Array:
    """Return something (docs/theory.md, section 99)."""
    return _scaled(gain, sample_time)


def rich(gain: Array, sample_time: float, count: int) -> Array:
    """(3.3) as an array (m, n), `count` times."""
    return _scaled(gain, sample_time)


def _scaled(gain: Array, sample_time: float) -> Array:
    if sample_time == 0:
        raise ValueError("sample_time")
    return gain / sample_time


def test_a_poor_docstring_is_found_and_a_rich_one_passes() -> None:
    assert faults(f"{__name__}:rich", rich) == []
    assert sorted(faults(f"{__name__}:poor", poor)) == [
        "NoSuchError: in Raises, does not exist",
        "ValueError: raised, not in Raises",
        "count: not described",
        "docs/theory.md 99: does not exist",
        "gain: no shape",
        "other: there is none",
        "returns Array: no shape",
        "sample_time: no unit",
    ]
