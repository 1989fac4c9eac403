"""Conversions of arguments: what each annotation accepts, and what it becomes.

A kind is a function that returns the converted value or raises an error that names the argument.
Arrays, sequences, texts and numbers become those of numpy and Python, whatever was given (lists,
series and frames of pandas, scalars of numpy). Masked entries become NaN.
"""

from __future__ import annotations

import ast
import functools
import math
import numbers
import os
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from impc.arrays import as_numbers
from impc.errors import ImpcError, InputError, PlantError, brief

Kind = Callable[[str, Any], Any]

# Limit for counts (samples, evaluations): no array of the package has more entries.
_LARGEST_COUNT = 2**31 - 1
# What makes a value of a class that has no constructor of its own for users.
_MAKERS = {
    "Body": "Plant(system, body=function)",
    "TerminalSet": "maximal_invariant_set",
    "Scenario": "scenario",
    "Simulation": "Controller.simulate",
    "Directions": "directions",
    "Table": "read_table or make_table",
    "Configuration": "read_configuration",
    "GainFibre": "gain_fibre",
    "Estimate": "fit(problem)",
    "OptimalRecording": "recorded_plan or recorded_loop of the problem",
}


def _refused(name: str, value: Any, remedy: str) -> InputError:
    return InputError(name, f"got {described(value)}", remedy)


def described(value: object) -> str:
    """A wrong value in a few words; an array by its shape."""
    kind = type(value).__name__
    try:
        shape = getattr(value, "shape", ())
        if isinstance(shape, tuple) and shape:
            return f"{kind} of shape {shape}"
        if isinstance(value, (list, tuple, dict, set)):
            return f"{kind} of {len(value)}"
        if value is None or isinstance(value, (float, str, bytes)):
            return brief(repr(value))
        return brief(value) if isinstance(value, int) else kind
    except Exception:  # a class that cannot say what it is
        return kind


def _array_of(dtype: type, remedy: str) -> Kind:
    """Array of truth values or whole numbers, which may be given as floats."""

    def check(name: str, value: Any) -> Any:
        found = np.asarray(value)
        if found.dtype == dtype:
            return found
        if dtype is np.int64 and found.dtype.kind in "iuf" and np.all(np.abs(found) < 2**53):
            whole = found.astype(np.int64)
            if np.all(whole == found):
                return whole
        raise _refused(name, value, remedy)

    return check


def _scalar(kind: type, abstract: Any, remedy: str) -> Kind:
    """Number or truth value, also as a scalar of numpy."""

    def check(name: str, value: Any) -> Any:
        plain = value[()] if isinstance(value, np.ndarray) and value.ndim == 0 else value
        truth = isinstance(plain, (bool, np.bool_))
        if truth != (kind is bool) or not (truth or isinstance(plain, abstract)):
            raise _refused(name, value, remedy)
        if kind is int and abs(int(plain)) > _LARGEST_COUNT:
            raise InputError(name, f"is beyond {_LARGEST_COUNT}", "give a smaller whole number")
        found = kind(plain)
        if math.isnan(found):
            raise InputError(name, "is NaN", "give a number")
        return found

    return check


def _text(name: str, value: Any) -> str:
    if not isinstance(value, str):
        raise _refused(name, value, "give a text")
    return str.__str__(value)


def _only(fits: Callable[[Any], bool], remedy: str) -> Kind:
    def check(name: str, value: Any) -> Any:
        if not fits(value):
            raise _refused(name, value, remedy)
        return value

    return check


def _path(name: str, value: Any) -> str | Path:
    """A possible file name; whether the file exists is checked where it is opened."""
    if not isinstance(value, (str, os.PathLike)):
        raise _refused(name, value, "give a path, as text or a Path")
    text = _text(name, os.fspath(value))
    try:
        zero = b"\0" in os.fsencode(text)
    except UnicodeEncodeError:
        raise InputError(name, f"got {brief(ascii(text))}", "give a name that is text") from None
    if zero:
        raise InputError(name, f"has a zero byte: {brief(ascii(text))}", "remove it")
    return text if isinstance(value, str) else Path(text)


def _system(name: str, value: Any) -> Any:
    if not all(hasattr(value, part) for part in ("A", "B", "C", "dt")):
        problem = f"expected a control.StateSpace, got {described(value)}"
        raise PlantError(name, problem, "pass control.ss(A, B, C, D, dt)")
    return value


def _expression(name: str, value: Any) -> Any:
    """An object of CasADi, a list of them, or numbers."""
    if isinstance(value, (list, tuple)):
        return [_expression(name, item) for item in value]
    ours = type(value).__module__.partition(".")[0] == "casadi"
    return value if ours else as_numbers(name, value)


_NAMED: dict[str, Kind] = {
    "Any": lambda _, value: value,
    "Array": as_numbers,
    "ArrayLike": as_numbers,
    "BoolArray": _array_of(np.bool_, "give an array of True and False"),
    "Expression": _expression,
    "IntArray": _array_of(np.int64, "give whole numbers"),
    "OwnPage": _only(lambda value: hasattr(type(value), "page"), "call fit_optimal_control"),
    "Path": _path,
    "System": _system,
    "bool": _scalar(bool, bool, "give True or False"),
    "float": _scalar(float, numbers.Real, "give a number"),
    "int": _scalar(int, numbers.Integral, "give a whole number"),
    "str": _text,
}


@functools.cache
def kind_of(annotation: str) -> Kind:
    """The conversion that an annotation stands for."""
    return _parsed(ast.parse(annotation, mode="eval").body)


def _parsed(node: ast.expr) -> Kind:
    match node:
        case ast.BinOp():
            return _one_of(_alternatives(node))
        case ast.Name(id=name) if name in _NAMED or name[0].isupper():
            return _NAMED.get(name) or _instance(name)
        case ast.Subscript(value=ast.Name(id=outer), slice=inner):
            inside = inner.elts if isinstance(inner, ast.Tuple) else [inner]
            if outer == "Callable":
                return _only(callable, "give a function")
            if outer == "Mapping":
                return _mapping(_parsed(inside[0]), _parsed(inside[1]))
            if outer == "Sequence" or ast.unparse(inside[-1]) == "...":
                return _several([_parsed(inside[0])], None)
            if outer == "tuple":
                return _several([_parsed(each) for each in inside], len(inside))
    raise TypeError(f"{ast.unparse(node)} is not known to impc.kinds")


def _alternatives(node: ast.expr) -> list[str]:
    if isinstance(node, ast.BinOp):
        return _alternatives(node.left) + _alternatives(node.right)
    return [ast.unparse(node)]


def _one_of(names: list[str]) -> Kind:
    """The first of several kinds that takes the value; a Path may always be text."""
    optional = "None" in names
    left_out = {"None", "str"} if "Path" in names else {"None"}
    kinds = [kind_of(name) for name in names if name not in left_out]

    def check(name: str, value: Any) -> Any:
        if value is None and optional:
            return None
        errors = []
        for kind in kinds:
            try:
                return kind(name, value)
            except ImpcError as error:
                errors.append(error)
        inside = [error for error in errors if error.subject != name]
        if not inside:
            remedy = ", or ".join(error.remedy for error in errors)
            raise type(errors[0])(name, errors[0].problem, remedy)
        raise inside[0]

    return check


def _instance(kind: str) -> Kind:
    """A class of the package, by name, so that its module need not be loaded."""
    remedy = f"make it with {_MAKERS.get(kind, f'{kind}(...)')}"

    def check(name: str, value: Any) -> Any:
        ours = (one.__name__ for one in type(value).__mro__ if one.__module__.startswith("impc."))
        if kind not in ours:
            raise InputError(name, f"expected a {kind}, got {described(value)}", remedy)
        return value

    return check


def _mapping(key: Kind, kind: Kind) -> Kind:
    def check(name: str, value: Any) -> dict[Any, Any]:
        if not (hasattr(value, "items") and hasattr(value, "__getitem__")):
            raise _refused(name, value, "give a dictionary")
        items = [(key(f"{name}: a key", each), one) for each, one in value.items()]
        return {each: kind(f"{name}[{each!r}]", one) for each, one in items}

    return check


def _several(kinds: list[Kind], count: int | None) -> Kind:
    """Tuple of the items of a sequence, except text, matrices and frames."""

    def check(name: str, values: Any) -> tuple[Any, ...]:
        single = isinstance(values, (str, bytes, set, frozenset, Mapping))
        if single or not isinstance(values, Collection) or getattr(values, "ndim", 1) != 1:
            raise _refused(name, values, "give a list")
        items = tuple(values)
        if count is not None and len(items) != count:
            raise _refused(name, values, f"give {count} values")
        each = kinds if count is not None else kinds * len(items)
        return tuple(
            kind(f"{name}[{place}]", one)
            for place, (kind, one) in enumerate(zip(each, items, strict=True))
        )

    return check
