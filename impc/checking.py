"""Validation and conversion of arguments by annotation and rule.

`checked` reads the annotations of a function, `Value` those of a dataclass: `impc.kinds` says what
they accept. An object that raises while it is read is an error of that argument.

    @checked(gain="m n", horizon=1)
    def Controller.from_gain(plant: Plant, gain: ArrayLike, ..., horizon: int) -> Controller: ...

A rule is a shape, or the smallest value of a number, or (smallest, largest). The symbols of a shape
are sizes of the plant (n states, m inputs, d disturbances, p outputs) or attributes of the object
whose method is called; ``*`` is any size, a leading ``~`` allows infinite and missing entries. All
values of a call must have the same sizes. Definiteness and signs are checked by the functions.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import math
from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING, Any, ClassVar, ParamSpec, TypeVar, overload

import numpy as np

from impc.arrays import Frozen, require_finite, with_shape
from impc.errors import DataError, ImpcError, InputError, brief
from impc.kinds import described, kind_of

if TYPE_CHECKING:
    from collections.abc import Callable

    from impc.kinds import Kind

    Rule = str | float | tuple[float, float]

P = ParamSpec("P")
R = TypeVar("R")
_V = TypeVar("_V")

_SIZES = {"n": "states", "m": "inputs", "d": "disturbances", "p": "outputs"}


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
            kinds[name] = _of_all(kind_of(str(parameter.annotation)), parameter.kind)

    @functools.wraps(function)
    def at_the_door(*args: P.args, **kwargs: P.kwargs) -> R:
        try:
            bound = signature.bind(*args, **kwargs)
        except TypeError as error:
            name = function.__qualname__.removesuffix(".__init__")
            raise InputError(name, str(error), f"its arguments are {', '.join(kinds)}") from None
        owner, sizes = bound.arguments.get("self"), dict[str, int]()
        if function.__name__ != "__init__":
            _require_sizes("self", owner, sizes)
        for name in [name for name in kinds if name in bound.arguments]:
            found = asked(name, kinds[name], name, bound.arguments[name])
            _require_sizes(name, found, sizes)
            bound.arguments[name] = found
        for name, rule in rules.items():
            if bound.arguments.get(name) is not None:
                bound.arguments[name] = _ruled(name, bound.arguments[name], rule, sizes, owner)
        return function(*bound.args, **bound.kwargs)

    return at_the_door


def _of_all(kind: Kind, place: Any) -> Kind:
    """Apply `kind` to each item if the parameter is *args or **kwargs."""
    if place is inspect.Parameter.VAR_POSITIONAL:
        return lambda name, given: tuple(kind(f"{name}[{k}]", one) for k, one in enumerate(given))
    if place is inspect.Parameter.VAR_KEYWORD:
        return lambda _, given: {name: kind(name, one) for name, one in given.items()}
    return kind


def asked(name: str, function: Callable[..., Any], *given: Any) -> Any:
    """Result of a function that runs code of the caller; what that raises is an InputError."""
    try:
        return function(*given)
    except ImpcError:
        raise
    except Exception as error:
        problem = f"cannot be read: {type(error).__name__}: {brief(error)}"
        raise InputError(name, problem, "give a plain value") from None


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
        for field in dataclasses.fields(self):  # type: ignore[arg-type]  # a dataclass
            name, value = field.name, getattr(self, field.name)
            found = value if name in known else asked(name, kind_of(str(field.type)), name, value)
            _require_sizes(name, found, sizes)
            rule = self._rules.get(name)
            if found is not None and rule is not None:
                if name not in known:
                    found = _ruled(name, found, rule, sizes)
                elif isinstance(rule, str):
                    _require_shape(name, found, rule.lstrip("~").split(), sizes)
            if name not in known and isinstance(found, np.ndarray) and found.flags.writeable:
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
    kind = type(value)
    if not hasattr(kind, "__dataclass_fields__"):
        raise InputError("value", f"got {described(value)}", "give a value of impc, as a Problem")
    known = [field.name for field in dataclasses.fields(kind)]  # type: ignore[arg-type]
    unknown = ", ".join(sorted(changes.keys() - set(known)))
    if unknown:
        raise InputError(kind.__name__, f"has no field {unknown}", f"it has {', '.join(known)}")
    if not isinstance(value, Value):
        return dataclasses.replace(value, **changes)  # type: ignore[type-var]
    made: Any = object.__new__(kind)
    for name, each in (vars(value) | changes).items():
        object.__setattr__(made, name, each)
    made._check(vars(value).keys() - changes.keys())
    return made  # type: ignore[no-any-return]


def _require_sizes(name: str, value: Any, sizes: dict[str, int]) -> None:
    """Require equal numbers of states, inputs and so on in all values of a call."""
    for one in value if type(value) is tuple else (value,):
        for symbol, size in _sizes_of(one).items():
            if sizes.setdefault(symbol, size) != size:
                other = f"has {size} {_SIZES[symbol]}, but an earlier argument has {sizes[symbol]}"
                raise InputError(name, other, "use the same plant for all")


def _sizes_of(value: Any) -> dict[str, int]:
    sizes: dict[str, int] = {}
    if not issubclass(type(value), Frozen):
        return sizes
    for owner in ("fibre", "problem", "plant"):
        inner = vars(value).get(owner)
        if isinstance(inner, Frozen):
            sizes |= _sizes_of(inner)
    for name, rule in value._rules.items() if isinstance(value, Value) else ():
        array = getattr(value, name)
        if isinstance(rule, str) and isinstance(array, np.ndarray):
            pairs = zip(rule.lstrip("~").split(), array.shape, strict=False)
            sizes |= {symbol: size for symbol, size in pairs if symbol in _SIZES}
    return sizes


def _ruled(name: str, value: Any, rule: Rule, sizes: dict[str, int], owner: Any = None) -> Any:
    if not isinstance(rule, str):
        least, most = rule if isinstance(rule, tuple) else (rule, math.inf)
        if not least <= value <= most:
            what = "a whole number of " if isinstance(value, int) else ""
            end = f" and at most {most:g}" if most < math.inf else ""
            remedy = f"give {what}at least {least:g}{end}"
            raise InputError(name, f"got {described(value)}", remedy)
        return value
    symbols = rule.lstrip("~").split()
    value = with_shape(name, value, tuple(_size(symbol, sizes, owner) for symbol in symbols))
    if not rule.startswith("~"):
        require_finite(name, value)
    _require_shape(name, value, symbols, sizes)
    return value


def _require_shape(name: str, value: Any, symbols: list[str], sizes: dict[str, int]) -> None:
    """Require that an array has the sizes of its symbols; notes those that are new."""
    for symbol, size in zip(symbols, value.shape, strict=True):
        if symbol != "*" and sizes.setdefault(symbol, size) != size:
            raise DataError(name, f"has shape {value.shape}", f"give ({', '.join(symbols)})")


def _size(symbol: str, sizes: dict[str, int], owner: Any) -> int | None:
    """Size of a symbol such as "n" or "n+m", or number or length of the owner's attribute."""
    held = getattr(owner, symbol, None)
    if symbol not in sizes and held is not None:
        return held if isinstance(held, int) else len(held)
    parts = [sizes.get(part) for part in symbol.split("+")]
    return None if None in parts else sum(part for part in parts if part is not None)
