"""Validation and conversion of arguments by their annotations.

`checked` reads the annotations of a function, `Value` those of a dataclass. Each annotation stands
for a kind in `_KINDS`, a function that returns the converted value or raises an error that names
the argument. Equivalent inputs are accepted: lists, tuples, arrays of any number type, series and
frames of pandas, scalars of numpy. Masked entries become NaN.

    @checked(gain="m n", horizon=1)
    def Controller.from_gain(plant: Plant, gain: ArrayLike, ..., horizon: int) -> Controller: ...

A rule is a shape in the sizes of the plant (n states, m inputs, d disturbances, p outputs; ``*``
any; a leading ``~`` allows infinite and missing entries), or the smallest value of a number, or
(smallest, largest). All values of a call must have the same sizes. Definiteness and signs are
checked by the functions themselves.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import math
import numbers
import os
import re
from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING, Any, ClassVar, ParamSpec, TypeVar, cast, overload

import numpy as np

from impc.arrays import Frozen, as_numbers, require_finite, with_shape
from impc.errors import DataError, InputError, PlantError, brief

if TYPE_CHECKING:
    from collections.abc import Callable, Hashable

    Kind = Callable[[str, Any], Any]
    Rule = str | float | tuple[float, float]

P = ParamSpec("P")
R = TypeVar("R")
_V = TypeVar("_V")

_SIZES = {"n": "states", "m": "inputs", "d": "disturbances", "p": "outputs"}
# Limit for counts (samples, evaluations): no array of the package has more entries.
_LARGEST_COUNT = 2**31 - 1


@overload
def checked(function: Callable[P, R], /) -> Callable[P, R]: ...
@overload
def checked(**rules: Rule) -> Callable[[Callable[P, R]], Callable[P, R]]: ...
def checked(function: Any = None, /, **rules: Rule) -> Any:
    """Check and convert every argument by annotation and rule before the function runs."""
    if function is None:
        return functools.partial(_checked, rules=rules)
    return _checked(function, {})


def _checked(function: Callable[P, R], rules: dict[str, Rule]) -> Callable[P, R]:
    signature = inspect.signature(function)
    kinds: dict[str, Kind] = {}
    for name, parameter in signature.parameters.items():
        if name not in ("self", "cls"):
            kinds[name] = _of_all(_kind(str(parameter.annotation)), parameter.kind)

    @functools.wraps(function)
    def at_the_door(*args: P.args, **kwargs: P.kwargs) -> R:
        try:
            bound = signature.bind(*args, **kwargs)
        except TypeError as error:
            name = function.__qualname__.removesuffix(".__init__")
            raise InputError(name, str(error), f"its arguments are {', '.join(kinds)}") from None
        sizes: dict[str, int] = {}
        for name in [name for name in kinds if name in bound.arguments]:
            found = kinds[name](name, bound.arguments[name])
            _require_sizes(name, found, sizes)
            bound.arguments[name] = found
        for name, rule in rules.items():
            if bound.arguments.get(name) is not None:
                bound.arguments[name] = _ruled(name, bound.arguments[name], rule, sizes)
        return function(*bound.args, **bound.kwargs)

    return at_the_door


def _of_all(kind: Kind, place: Any) -> Kind:
    """Apply `kind` to each item if the parameter is *args or **kwargs."""
    if place is inspect.Parameter.VAR_POSITIONAL:
        return lambda name, given: tuple(kind(f"{name}[{k}]", one) for k, one in enumerate(given))
    if place is inspect.Parameter.VAR_KEYWORD:
        return lambda _, given: {name: kind(name, one) for name, one in given.items()}
    return kind


class Value(Frozen):
    """Base of frozen dataclasses with checked fields and read-only arrays.

    Fields are checked by the constructor and by `replace`, according to `_rules`. A class whose
    constructor takes other arguments than its fields calls `_fill` at its end.
    """

    _rules: ClassVar[Mapping[str, Rule]] = {}

    def _fill(self, **fields: Any) -> None:
        """Set and check all fields."""
        for name, value in fields.items():
            object.__setattr__(self, name, value)
        self.__post_init__()

    def __post_init__(self) -> None:
        self._check(())

    def _check(self, known: Collection[str]) -> None:
        """Check the fields; of those `known` to be right, only that their sizes agree."""
        sizes: dict[str, int] = {}
        for name, kind in _field_kinds(cast("Hashable", type(self))):
            value = getattr(self, name)
            if name in known:
                _require_sizes(name, value, sizes)
                rule = self._rules.get(name)
                if isinstance(rule, str) and value is not None:
                    _require_shape(name, value, rule.lstrip("~").split(), sizes)
                continue
            found = kind(name, value)
            _require_sizes(name, found, sizes)
            if found is not None and name in self._rules:
                found = _ruled(name, found, self._rules[name], sizes)
            if isinstance(found, np.ndarray) and found.flags.writeable:
                found = found.copy()  # the array may belong to the caller
                found.flags.writeable = False
            if found is not value:
                object.__setattr__(self, name, found)


def replace(value: _V, **changes: Any) -> _V:
    """Return a copy of a value of this package with changed fields, checked like a new one.

    Parameters
    ----------
    value : Problem, Plant, Controller, ...
        Value to copy.
    **changes
        New values of fields, by name.

    Returns
    -------
    same type as `value`

    Raises
    ------
    InputError
        If a field does not exist or cannot have that value.

    Examples
    --------
    >>> import control
    >>> import impc
    >>> plant = impc.Plant(control.ss([[0.9]], [[1]], [[1]], 0, 1))
    >>> impc.replace(impc.Bounds(plant), u_max=[2.0]).u_max
    array([2.])
    """
    if not isinstance(value, Value):
        return dataclasses.replace(value, **changes)  # type: ignore[type-var]
    fields = vars(value)
    unknown = sorted(changes.keys() - fields.keys())
    if unknown:
        known = ", ".join(fields)
        raise InputError(
            type(value).__name__, f"has no field {', '.join(unknown)}", f"it has {known}"
        )
    made = object.__new__(type(value))
    for name, each in (fields | changes).items():
        object.__setattr__(made, name, each)
    made._check(fields.keys() - changes.keys())
    return made


def _require_sizes(name: str, value: Any, sizes: dict[str, int]) -> None:
    """Require equal numbers of states, inputs and so on in all values of a call."""
    for symbol, size in _sizes_of(value).items():
        if sizes.setdefault(symbol, size) != size:
            raise InputError(
                name,
                f"has {size} {_SIZES[symbol]}, but an earlier argument has {sizes[symbol]}",
                "use the same plant for all",
            )


def _sizes_of(value: Any) -> dict[str, int]:
    if isinstance(value, tuple):
        return _sizes_of(value[0]) if value else {}
    if not isinstance(value, Frozen):
        return {}
    sizes: dict[str, int] = {}
    for owner in ("fibre", "plant"):
        inner = getattr(value, owner, None)
        if isinstance(inner, Frozen):
            sizes |= _sizes_of(inner)
    for name, rule in value._rules.items() if isinstance(value, Value) else ():
        array = getattr(value, name)
        if isinstance(rule, str) and isinstance(array, np.ndarray):
            pairs = zip(rule.lstrip("~").split(), array.shape, strict=False)
            sizes |= {symbol: size for symbol, size in pairs if symbol in _SIZES}
    return sizes


def _ruled(name: str, value: Any, rule: Rule, sizes: dict[str, int]) -> Any:
    if not isinstance(rule, str):
        least, most = rule if isinstance(rule, tuple) else (rule, math.inf)
        if not least <= value <= most:
            what = "a whole number of " if isinstance(value, int) else ""
            end = f" and at most {most:g}" if most < math.inf else ""
            remedy = f"give {what}at least {least:g}{end}"
            raise InputError(name, f"got {_described(value)}", remedy)
        return value
    symbols = rule.lstrip("~").split()
    value = with_shape(name, value, tuple(_size(symbol, sizes) for symbol in symbols))
    if not rule.startswith("~"):
        require_finite(name, value)
    _require_shape(name, value, symbols, sizes)
    return value


def _require_shape(name: str, value: Any, symbols: list[str], sizes: dict[str, int]) -> None:
    """Require that an array has the sizes of its symbols; notes those that are new."""
    for symbol, size in zip(symbols, value.shape, strict=True):
        if symbol != "*" and sizes.setdefault(symbol, size) != size:
            raise DataError(name, f"has shape {value.shape}", f"give ({', '.join(symbols)})")


def _size(symbol: str, sizes: dict[str, int]) -> int | None:
    """Size of a symbol such as "n" or "n+m", if known."""
    parts = [sizes.get(part) for part in symbol.split("+")]
    return None if None in parts else sum(part for part in parts if part is not None)


@functools.cache
def _field_kinds(owner: Any) -> tuple[tuple[str, Kind], ...]:
    fields = dataclasses.fields(owner)
    return tuple((field.name, _kind(str(field.type))) for field in fields)


def _refused(name: str, value: Any, remedy: str) -> InputError:
    return InputError(name, f"got {_described(value)}", remedy)


def _array(name: str, value: Any) -> Any:
    plain = type(value) is np.ndarray and value.dtype == np.float64
    return value if plain else as_numbers(name, value)


def _whole(name: str, value: Any) -> int:
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, numbers.Integral):
        raise _refused(name, value, "give a whole number")
    if abs(int(value)) > _LARGEST_COUNT:
        raise InputError(name, f"is beyond {_LARGEST_COUNT}", "give a smaller whole number")
    return int(value)


def _number(name: str, value: Any) -> float:
    scalar = value[()] if isinstance(value, np.ndarray) and value.ndim == 0 else value
    if isinstance(scalar, (bool, np.bool_)) or not isinstance(scalar, numbers.Real):
        raise _refused(name, value, "give a number")
    try:
        found = float(scalar)
    except OverflowError:
        raise InputError(name, "is too large for a number", "give one below 1e308") from None
    if math.isnan(found):
        raise InputError(name, "is NaN", "give a number")
    return found


def _truth(name: str, value: Any) -> bool:
    if not isinstance(value, (bool, np.bool_)):
        raise _refused(name, value, "give True or False")
    return bool(value)


def _only(fits: Callable[[Any], bool], remedy: str) -> Kind:
    def check(name: str, value: Any) -> Any:
        if not fits(value):
            raise _refused(name, value, remedy)
        return value

    return check


def _as_it_is(_name: str, value: Any) -> Any:
    return value


def _maps(value: Any) -> bool:
    return hasattr(value, "keys") and hasattr(value, "__getitem__") and not hasattr(value, "dtypes")


_text = _only(lambda value: isinstance(value, str), "give a text")
_function = _only(callable, "give a function")
_mapping = _only(_maps, "give a dictionary")


def _mapping_of(kind: Kind) -> Kind:
    def check(name: str, value: Any) -> dict[str, Any]:
        items = _mapping(name, value).items()
        return {_text(f"{name}: a key", key): kind(f"{name}[{key!r}]", one) for key, one in items}

    return check


def _column(name: str, value: Any) -> Any:
    return with_shape(name, as_numbers(name, value), (None,))


def _columns(name: str, value: Any) -> Any:
    """A dictionary of columns (samples,); for a frame its columns."""
    given = dict(value.items()) if hasattr(value, "dtypes") else value
    return _mapping_of(_column)(name, given)


def _numbers_or_names(name: str, value: Any) -> Any:
    """Numbers, or a dictionary of numbers by signal name."""
    of = _mapping_of(_number) if isinstance(value, Mapping) else as_numbers
    return of(name, value)


def _instance(kind: str, remedy: str) -> Kind:
    """A class of the package, by name, so that its module need not be loaded."""

    def check(name: str, value: Any) -> Any:
        ours = (one.__name__ for one in type(value).__mro__ if one.__module__.startswith("impc."))
        if kind not in ours:
            raise InputError(name, f"expected a {kind}, got {_described(value)}", remedy)
        return value

    return check


def _estimate(name: str, value: Any) -> Any:
    """An estimate, also one of an optional subpackage that makes its own report."""
    return value if hasattr(value, "page") else _KINDS["Estimate"](name, value)


def _start(name: str, value: Any) -> Any:
    kind = "Weights" if type(value).__name__ == "Weights" else "Estimate"
    return _KINDS[kind](name, value)


def _path(name: str, value: Any) -> Any:
    """A possible file name; whether the file exists is checked where it is opened."""
    if not isinstance(value, (str, os.PathLike)):
        raise _refused(name, value, "give a path, as text or a Path")
    try:
        text = os.fsencode(value)
    except UnicodeEncodeError:
        raise InputError(name, f"got {brief(ascii(value))}", "give a name that is text") from None
    if b"\0" in text:
        raise InputError(name, f"has a zero byte: {brief(ascii(value))}", "remove it")
    return value


def _system(name: str, value: Any) -> Any:
    if not all(hasattr(value, part) for part in ("A", "B", "C", "dt")):
        problem = f"expected a control.StateSpace, got {_described(value)}"
        raise PlantError(name, problem, "pass control.ss(A, B, C, D, dt)")
    return value


def _pair(name: str, value: Any) -> Any:
    if not isinstance(value, (tuple, list)) or len(value) != 2:
        raise _refused(name, value, "give a pair of arrays")
    return _several(as_numbers)(name, value)


def _choice_of_set(name: str, value: Any) -> Any:
    """True, False, a terminal set, or its pair (H, h)."""
    if type(value).__name__ == "TerminalSet":
        return value
    return _pair(name, value) if isinstance(value, (tuple, list)) else _truth(name, value)


def _several(kind: Kind) -> Kind:
    """Tuple of the items of a sequence, except text, matrices and frames."""

    def check(name: str, values: Any) -> tuple[Any, ...]:
        single = isinstance(values, (str, bytes, set, frozenset, Mapping))
        if single or not isinstance(values, Collection) or getattr(values, "ndim", 1) != 1:
            raise _refused(name, values, "give a list")
        return tuple(kind(f"{name}[{index}]", value) for index, value in enumerate(values))

    return check


def _described(value: object) -> str:
    """A wrong value in a few words; an array by its shape."""
    kind, shape = type(value).__name__, getattr(value, "shape", ())
    if isinstance(shape, tuple) and shape:
        return f"{kind} of shape {shape}"
    if isinstance(value, (list, tuple, dict, set)):
        return f"{kind} of {len(value)}"
    if value is None or isinstance(value, (float, str, bytes)):
        return brief(repr(value))
    return brief(value) if isinstance(value, int) else kind


# Functions that make a value, for the remedy, if not its class.
_MAKERS = {
    "Body": "Plant(system, body=function)",
    "BoundRows": "bound_rows",
    "TerminalSet": "maximal_invariant_set",
    "Scenario": "scenario",
    "Simulation": "simulate",
    "Directions": "directions",
    "PlantFamily": "plant_family",
    "Table": "read_table or make_table",
    "Configuration": "read_configuration",
    "PlantSource": "plant_source",
    "LqrSolution": "solve_lqr",
    "FiniteHorizonLqr": "Controller(..., terminal_weight=P)",
    "GainFibre": "gain_fibre",
    "EquivalentWeights": "least_condition_weights",
    "WeightsSet": "weights_set",
    "MpcSolver": "build_mpc",
    "Estimate": "fit(problem)",
    "Rows": "build_rows",
}
_CLASSES = (
    *("Plant", "Bounds", "Weights", "Recording", "Label", "Controller", "Structure", "Problem"),
    *("FitSettings", "FitProgress"),
)

_KINDS: dict[str, Kind] = {
    "Estimate | OwnPage": _estimate,
    "Estimate | Weights": _start,
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
    "Path": _path,
    "Any": _as_it_is,
    "tuple[tuple[str, str], ...]": _as_it_is,
    "tuple[tuple[str, float], ...]": _as_it_is,
    "Mapping[str, Any]": _mapping,
    "Mapping[str, ArrayLike]": _columns,
    "Mapping[str, str]": _mapping_of(_text),
    "Mapping[str, Sequence[str]]": _mapping_of(_several(_text)),
    "Mapping[str, float]": _mapping,
    "Mapping[int, IntArray]": _mapping,
    "System": _system,
    "tuple[Array, Array]": _pair,
    "bool | TerminalSet | tuple[ArrayLike, ArrayLike]": _choice_of_set,
}


def add_value(kind: str, maker: str) -> None:
    """Register a further class, for example of an optional subpackage."""
    _KINDS[kind] = _instance(kind, f"make it with {maker}")


for _name in (*_CLASSES, *_MAKERS):
    add_value(_name, _MAKERS.get(_name, f"{_name}(...)"))


def _kind(annotation: str) -> Kind:
    name = annotation.removesuffix(" | None")
    several = re.fullmatch(r"Sequence\[(.*)\]|tuple\[(.*), \.\.\.\]", name)
    if name.startswith("Callable["):
        kind = _function
    elif name in _KINDS:
        kind = _KINDS[name]
    elif several:
        kind = _several(_kind(several[1] or several[2]))
    else:
        raise TypeError(f"{annotation} is not in the table of impc.checking")
    if name == annotation:
        return kind
    return lambda name, value: None if value is None else kind(name, value)
