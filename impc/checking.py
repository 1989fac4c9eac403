"""The door: what comes in from outside is checked here, once, by one table.

`checked` reads the annotations of a public function, and `Value` those of a dataclass: each stands
for a kind in `_KINDS`, a function that returns the value as the inside takes it or raises in one
line that names the argument. What means the same is let in: lists, tuples, arrays of any number
type, pandas' series and frames, numpy's scalars. The samples that a masked array masks are missing:
NaN, whatever stands below the mask.

    @checked(gain="m n", horizon=1)
    def Controller.from_gain(plant: Plant, gain: ArrayLike, ..., horizon: int) -> Controller: ...

A rule is a shape in the sizes of the plant (n states, m inputs, d disturbances, p outputs; ``*``
any; ``~`` before it lets infinite and missing entries in), or the least value of a number, or
least and largest. The values of one call must have the same sizes. Definiteness and signs are for
the function.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import math
import numbers
import os
import re
import sys
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar, ParamSpec, TypeVar, cast, overload

import numpy as np

from impc.arrays import Frozen, as_numbers, require_finite, with_shape
from impc.errors import DataError, InputError, PlantError, brief

if TYPE_CHECKING:
    from collections.abc import Callable, Container, Hashable

    Kind = Callable[[str, Any], Any]
    Rule = str | float | tuple[float, float]

P = ParamSpec("P")
R = TypeVar("R")
_V = TypeVar("_V")

_SIZES = {"n": "states", "m": "inputs", "d": "disturbances", "p": "outputs"}
# No array of the package can have more entries, and no count (samples, evaluations) means more.
_LARGEST_COUNT = 2**31 - 1


@overload
def checked(function: Callable[P, R], /) -> Callable[P, R]: ...
@overload
def checked(**rules: Rule) -> Callable[[Callable[P, R]], Callable[P, R]]: ...
def checked(function: Any = None, /, **rules: Rule) -> Any:
    """Check and convert every argument by its annotation and its rule, before the function runs."""
    if function is None:
        return functools.partial(_checked, rules=rules)
    return _checked(function, {})


def _checked(function: Callable[P, R], rules: dict[str, Rule]) -> Callable[P, R]:
    kinds: dict[str, Kind] = {}
    names: list[str] = []  # of those that can be given by position
    rest: dict[Any, tuple[str, Kind]] = {}  # of *args and **kwargs
    signature = inspect.signature(function)
    for name, parameter in signature.parameters.items():
        if parameter.kind in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD):
            rest[parameter.kind] = name, _kind(str(parameter.annotation))
        elif name not in ("self", "cls"):
            kinds[name] = _kind(str(parameter.annotation))
        if parameter.kind is parameter.POSITIONAL_OR_KEYWORD:
            names.append(name)
    needed = {
        name
        for name, parameter in signature.parameters.items()
        if parameter.default is parameter.empty and (name in kinds or name in names)
    }
    more = rest.get(inspect.Parameter.VAR_POSITIONAL)
    others = rest.get(inspect.Parameter.VAR_KEYWORD)

    @functools.wraps(function)
    def at_the_door(*args: P.args, **kwargs: P.kwargs) -> R:
        sizes: dict[str, int] = {}
        named = dict(zip(names, args, strict=False)) | kwargs
        extra: Any = args[len(names) :]
        if not needed <= named.keys() or (extra and more is None):
            raise _wrong_call(function, signature, args, kwargs)
        for name, value in named.items():
            if name in kinds:
                found = kinds[name](name, value)
                _require_sizes(name, found, sizes)
                named[name] = found
            elif name not in names and others is None:
                raise _wrong_call(function, signature, args, kwargs)
            elif name not in names and others is not None:
                named[name] = others[1](name, value)
        if more is not None:
            extra = (more[1](f"{more[0]}[{k}]", value) for k, value in enumerate(extra))
        for name, rule in rules.items():
            if named.get(name) is not None:
                named[name] = _ruled(name, named[name], rule, sizes)
        given = [named.pop(name) for name in names[: len(args)]]
        return function(*given, *extra, **named)  # type: ignore[arg-type]

    return at_the_door


def _wrong_call(
    function: Callable[..., Any], signature: inspect.Signature, args: Any, kwargs: Any
) -> InputError:
    """What Python would say of arguments that are missing or too many, and how to call it."""
    name = function.__qualname__.removesuffix(".__init__")
    try:
        signature.bind(*args, **kwargs)
        said = "has wrong arguments"
    except TypeError as error:
        said = str(error)
    known = [
        f"*{item.name}" if item.kind is item.VAR_POSITIONAL else item.name
        for item in signature.parameters.values()
        if item.name not in ("self", "cls") and item.kind is not item.VAR_KEYWORD
    ]
    return InputError(name, said, f"its arguments are {', '.join(known)}")


class Value(Frozen):
    """Base of frozen dataclasses: fields are checked by the same table, arrays made read-only.

    So whenever one is made, by its constructor or by `replace`; copies and what comes out of a
    pickle were checked, and stay read-only too. `_rules` are the rules of the fields. A class whose
    constructor takes other things than its fields ends it with `_fill`.
    """

    _rules: ClassVar[Mapping[str, Rule]] = {}

    def _fill(self, **fields: Any) -> None:
        """Take the fields, all of them, and check them."""
        for name, value in fields.items():
            object.__setattr__(self, name, value)
        self._check(fields)

    def __post_init__(self) -> None:
        self._check({field.name for field in dataclasses.fields(self)})  # type: ignore[arg-type]

    def _check(self, changed: Container[str]) -> None:
        """Check the changed fields, the others having been checked when they were given."""
        sizes: dict[str, int] = {}
        for name, kind in _field_kinds(cast("Hashable", type(self))):
            value = getattr(self, name)
            if name not in changed:
                _require_sizes(name, value, sizes)
                _take_sizes(value, self._rules.get(name), sizes)
                continue
            found = kind(name, value)
            _require_sizes(name, found, sizes)
            rule = self._rules.get(name)
            if rule is not None and found is not None:
                found = _ruled(name, found, rule, sizes)
            found = _sealed(found)
            if found is not value:
                object.__setattr__(self, name, found)


def replace(value: _V, **changes: Any) -> _V:
    """Return a dataclass with other fields, checked as when it was made.

    `dataclasses.replace` would call the constructor, which in a `Value` may take other things.
    """
    if not isinstance(value, Value):
        return dataclasses.replace(value, **changes)  # type: ignore[type-var]
    fields = vars(value)
    unknown = sorted(changes.keys() - fields.keys())
    if unknown:
        raise TypeError(f"{type(value).__name__} has no field {', '.join(unknown)}")
    made = object.__new__(type(value))
    for name, given in (fields | changes).items():
        object.__setattr__(made, name, given)
    made._check(changes)
    return made


def _require_sizes(name: str, value: Any, sizes: dict[str, int]) -> None:
    """Numbers of states, inputs and so on: the same in all values of a call."""
    for symbol, size in _sizes_of(value).items():
        if sizes.setdefault(symbol, size) != size:
            raise InputError(
                name,
                f"has {size} {_SIZES[symbol]}, what stands before it {sizes[symbol]}",
                "give values of one plant",
            )


def _sizes_of(value: Any) -> dict[str, int]:
    if isinstance(value, tuple):
        return _sizes_of(value[0]) if value else {}
    sizes: dict[str, int] = {}
    for owner in ("fibre", "plant"):
        inner = getattr(value, owner, None)
        if isinstance(inner, Frozen):
            sizes |= _sizes_of(inner)
    if isinstance(value, Value):
        for name, rule in value._rules.items():
            shape = getattr(value, name)
            if isinstance(rule, str) and isinstance(shape, np.ndarray):
                pairs = zip(rule.lstrip("~").split(), shape.shape, strict=False)
                sizes |= {symbol: size for symbol, size in pairs if symbol in _SIZES}
    return sizes


def _take_sizes(value: Any, rule: Rule | None, sizes: dict[str, int]) -> None:
    if isinstance(rule, str) and isinstance(value, np.ndarray):
        for symbol, size in zip(rule.lstrip("~").split(), value.shape, strict=True):
            if symbol in _SIZES:
                sizes.setdefault(symbol, size)


def _ruled(name: str, value: Any, rule: Rule, sizes: dict[str, int]) -> Any:
    if not isinstance(rule, str):
        least, most = rule if isinstance(rule, tuple) else (rule, math.inf)
        if not least <= value <= most:
            what = "a whole number of " if isinstance(value, int) else ""
            wanted = f"{what}at least {least:g}" + (
                f" and at most {most:g}" if most < math.inf else ""
            )
            raise InputError(name, f"got {_described(value)}", f"give {wanted}")
        return value
    symbols = rule.lstrip("~").split()
    expected = tuple(_size(symbol, sizes) for symbol in symbols)
    value = with_shape(name, value, expected)
    if not rule.startswith("~"):
        require_finite(name, value)
    for symbol, size in zip(symbols, value.shape, strict=True):
        if symbol != "*" and sizes.setdefault(symbol, size) != size:
            raise DataError(name, f"has shape {value.shape}", f"give ({', '.join(symbols)})")
    return value


def _size(symbol: str, sizes: dict[str, int]) -> int | None:
    """A size if it is known: of "n", or of "n+m"."""
    parts = [sizes.get(part) for part in symbol.split("+")]
    return None if None in parts else sum(part for part in parts if part is not None)


def _sealed(value: Any) -> Any:
    """An array that cannot be written: itself, or a copy, for it may be the caller's."""
    if isinstance(value, np.ndarray) and value.flags.writeable:
        value = value.copy()
        value.flags.writeable = False
    return value


@functools.cache
def _field_kinds(owner: Any) -> tuple[tuple[str, Kind], ...]:
    fields = dataclasses.fields(owner)
    return tuple((field.name, _kind(str(field.type))) for field in fields)


def _array(name: str, value: Any) -> Any:
    plain = type(value) is np.ndarray and value.dtype == np.float64
    return value if plain else as_numbers(name, value)


def _whole(name: str, value: Any) -> int:
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, numbers.Integral):
        raise InputError(name, f"got {_described(value)}", "give a whole number")
    if abs(int(value)) > _LARGEST_COUNT:
        raise InputError(name, f"is beyond {_LARGEST_COUNT}", "give a smaller whole number")
    return int(value)


def _number(name: str, value: Any) -> float:
    scalar = value[()] if isinstance(value, np.ndarray) and value.ndim == 0 else value
    if isinstance(scalar, (bool, np.bool_)) or not isinstance(scalar, numbers.Real):
        raise InputError(name, f"got {_described(value)}", "give a number")
    try:
        found = float(scalar)
    except OverflowError:
        raise InputError(name, "is too large for a number", "give one below 1e308") from None
    if math.isnan(found):
        raise InputError(name, "is NaN", "give a number")
    return found


def _truth(name: str, value: Any) -> bool:
    if not isinstance(value, (bool, np.bool_)):
        raise InputError(name, f"got {_described(value)}", "give True or False")
    return bool(value)


def _text(name: str, value: Any) -> str:
    if not isinstance(value, str):
        raise InputError(name, f"got {_described(value)}", "give a text")
    return value


def _as_it_is(_name: str, value: Any) -> Any:
    return value


def _function(name: str, value: Any) -> Any:
    if not callable(value):
        raise InputError(name, f"got {_described(value)}", "give a function")
    return value


def _mapping(name: str, value: Any) -> Any:
    if not hasattr(value, "keys") or not hasattr(value, "__getitem__") or hasattr(value, "dtypes"):
        raise InputError(name, f"got {_described(value)}", "give a dictionary")
    return value


def _numbers_or_names(name: str, value: Any) -> Any:
    """Numbers, or a dictionary of them by the names of signals."""
    if not isinstance(value, Mapping):
        return as_numbers(name, value)
    return {_text(name, key): _number(f"{name}[{key!r}]", item) for key, item in value.items()}


def _instance(module: str, kind: str) -> Kind:
    """A value of the package. Its module is loaded if there is one."""

    def check(name: str, value: Any) -> Any:
        known = getattr(sys.modules.get(module), kind, None)
        if known is None or not isinstance(value, known):
            raise InputError(name, f"expected a {kind}, got {_described(value)}", _MADE_BY[kind])
        return value

    return check


def _estimate(name: str, value: Any) -> Any:
    """An estimate, also one of an optional subpackage, which makes its page itself."""
    known = _instance("impc.inverse.estimates", "Estimate")
    return value if hasattr(value, "page") else known(name, value)


def _path(name: str, value: Any) -> Any:
    """What may be the name of a file; whether there is one is for who opens it."""
    if not isinstance(value, (str, os.PathLike)):
        raise InputError(name, f"got {_described(value)}", "give a path, as text or a Path")
    try:
        text = os.fsencode(value)
    except UnicodeEncodeError:
        raise InputError(name, f"got {brief(ascii(value))}", "give a name that is text") from None
    if b"\0" in text:
        raise InputError(name, f"has a zero byte: {brief(ascii(value))}", "give a path without")
    return value


def _vectors(name: str, value: Any) -> Any:
    """A dictionary of columns, each of numbers along one axis; of a frame its columns."""
    columns = value if hasattr(value, "dtypes") else _mapping(name, value)
    return {
        _text(f"{name}: the name of a column", key): with_shape(
            f"{name}[{key!r}]", as_numbers(f"{name}[{key!r}]", column), (None,)
        )
        for key, column in columns.items()
    }


def _system(name: str, value: Any) -> Any:
    if not all(hasattr(value, part) for part in ("A", "B", "C", "dt")):
        problem = f"expected a control.StateSpace, got {_described(value)}"
        raise PlantError(name, problem, "pass control.ss(A, B, C, D, dt)")
    return value


def _pair(name: str, value: Any) -> Any:
    if not isinstance(value, (tuple, list)) or len(value) != 2:
        raise InputError(name, f"got {_described(value)}", "give a pair (K, S) of arrays")
    return tuple(as_numbers(f"{name}[{index}]", part) for index, part in enumerate(value))


def _texts(name: str, value: Any) -> Any:
    given = _mapping(name, value)
    return {
        _text(f"{name}: a key", key): _text(f"{name}[{key!r}]", item) for key, item in given.items()
    }


def _several(kind: Kind, what: str) -> Kind:
    """A tuple of the items of any sequence but a text, an array or a frame of several columns."""

    def check(name: str, values: Any) -> tuple[Any, ...]:
        one_axis = getattr(values, "ndim", 1) == 1 and not hasattr(values, "keys")
        listed = hasattr(values, "__len__") and hasattr(values, "__iter__") and one_axis
        if not listed and type(values).__name__ == "Series":
            listed = True
        if isinstance(values, (str, bytes, set, frozenset)) or not listed:
            raise InputError(name, f"got {_described(values)}", f"give a list of {what}")
        return tuple(kind(f"{name}[{index}]", value) for index, value in enumerate(values))

    return check


def _described(value: object) -> str:
    """A wrong value in a few words: of an array its shape."""
    if value is None or isinstance(value, (bool, float, str, bytes)):
        return brief(repr(value))
    shape = getattr(value, "shape", None)
    kind = type(value).__name__
    if isinstance(shape, tuple) and shape:
        return f"{kind} of shape {shape}"
    if isinstance(value, int):
        return brief(value)
    if isinstance(value, (list, tuple, dict, set)):
        return f"{kind} of {len(value)}"
    return kind


# Who makes a value, for the remedy; and where its class is.
_VALUES = {
    "Plant": ("impc.model.plant", "make it with Plant(system)"),
    "Body": ("impc.model.body", "make it with Plant(system, body=function)"),
    "Bounds": ("impc.model.bounds", "make it with Bounds(plant, ...)"),
    "BoundRows": ("impc.model.bounds", "make it with bound_rows"),
    "Weights": ("impc.model.weights", "make it with Weights(Q, R)"),
    "Recording": ("impc.model.recordings", "make it with Recording(plant, ...)"),
    "Label": ("impc.model.recordings", "make it with Label"),
    "Controller": ("impc.control.controller", "make it with Controller(plant, ...)"),
    "TerminalSet": ("impc.control.terminal_set", "make it with maximal_invariant_set"),
    "Scenario": ("impc.control.simulation", "make it with scenario"),
    "Simulation": ("impc.control.simulation", "make it with simulate"),
    "Directions": ("impc.control.constraint_rows", "make it with directions"),
    "Structure": ("impc.model.structure", "make it with Structure(plant, ...)"),
    "Problem": ("impc.inverse.problem", "make it with Problem(plant, ...)"),
    "PlantFamily": ("impc.model.plant_family", "make it with plant_family"),
    "Table": ("impc.files.table", "make it with read_table or make_table"),
    "Configuration": ("impc.files.configuration", "make it with read_configuration"),
    "PlantSource": ("impc.files.plant_sources", "make it with plant_source"),
    "LqrSolution": ("impc.model.riccati", "make it with solve_lqr"),
    "GainFibre": ("impc.inverse.solution_set", "make it with gain_fibre"),
    "EquivalentWeights": (
        "impc.inverse.equivalent_weights",
        "make it with least_condition_weights",
    ),
    "WeightsSet": ("impc.assess.bounded_weights", "make it with weights_set"),
    "MpcSolver": ("impc.control.casadi_controller", "make it with build_mpc"),
    "FitSettings": ("impc.studies.fit.settings", "make it with FitSettings"),
    "FitProgress": ("impc.studies.fit.subject", "make it with FitProgress, or leave it out"),
    "Estimate": ("impc.inverse.estimates", "make it with estimate(problem)"),
    "Rows": ("impc.control.constraint_rows", "make it with build_rows"),
}
_MADE_BY = {kind: remedy for kind, (_, remedy) in _VALUES.items()}


def add_value(kind: str, module: str, remedy: str) -> None:
    """Have values of an optional subpackage checked too: where the class is, and who makes it."""
    _KINDS[kind], _MADE_BY[kind] = _instance(module, kind), remedy


_KINDS: dict[str, Kind] = {
    **{kind: _instance(module, kind) for kind, (module, _) in _VALUES.items()},
    "Estimate | OwnPage": _estimate,
    "ArrayLike": as_numbers,
    "ArrayLike | Mapping[str, float]": _numbers_or_names,
    "Array": _array,
    "IntArray": _as_it_is,
    "BoolArray": _as_it_is,
    "float": _number,
    "int": _whole,
    "bool": _truth,
    "str": _text,
    "str | Path": _path,
    "Path | str": _path,
    "Sequence[Path]": _several(_path, "paths"),
    "Any": _as_it_is,
    "Sequence[str]": _several(_text, "names"),
    "tuple[str, ...]": _several(_text, "names"),
    "tuple[tuple[str, str], ...]": _as_it_is,
    "Sequence[int]": _several(_whole, "whole numbers"),
    "Sequence[float]": _several(_number, "numbers"),
    "tuple[Recording, ...]": _several(
        _instance("impc.model.recordings", "Recording"), "recordings"
    ),
    "Sequence[Recording]": _several(_instance("impc.model.recordings", "Recording"), "recordings"),
    "Mapping[str, Any]": _mapping,
    "Mapping[str, ArrayLike]": _vectors,
    "Mapping[str, str]": _texts,
    "Mapping[str, float]": _mapping,
    "System": _system,
    "tuple[Array, Array]": _pair,
    "Mapping[int, IntArray]": _mapping,
}


def register(module: str, kind: str, remedy: str) -> None:
    """Add a value of an optional subpackage to the table, by itself and in a sequence."""
    _MADE_BY[kind] = remedy
    _KINDS[kind] = _instance(module, kind)
    _KINDS[f"Sequence[{kind}]"] = _several(_KINDS[kind], "recordings")


def _kind(annotation: str) -> Kind:
    optional = annotation.endswith(" | None")
    name = re.sub(r" \| None$", "", annotation)
    kind = _function if name.startswith("Callable[") else _KINDS.get(name)
    if kind is None:
        raise TypeError(f"{annotation} is not in the table of impc.checking")
    chosen = kind
    if not optional:
        return chosen
    return lambda name, value: None if value is None else chosen(name, value)
