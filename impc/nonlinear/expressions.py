"""Validate CasADi expressions and symbols of the user and convert them to functions.

Every function has the arguments (x, u, d, theta) and is expanded to SX, which evaluates fastest.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from impc.arrays import BoolArray, Frozen
from impc.checking import asked
from impc.errors import InputError


@dataclass(frozen=True, init=False, eq=False)
class Stages(Frozen):
    """Functions and names of a problem, as plans and loops use them (`OptimalControlProblem`)."""

    horizon: int
    state_names: tuple[str, ...]
    input_names: tuple[str, ...]
    disturbance_names: tuple[str, ...]
    parameter_names: tuple[str, ...]
    rows: tuple[str, ...]
    terminal_rows: tuple[str, ...]
    positive: BoolArray
    units: dict[str, str]
    dt: float | None
    functions: tuple[Any, ...]

    @property
    def n(self) -> int:
        """Number of states."""
        return len(self.state_names)

    @property
    def m(self) -> int:
        """Number of inputs."""
        return len(self.input_names)

    @property
    def disturbance_count(self) -> int:
        """Number of disturbances."""
        return len(self.disturbance_names)


_COMPARISONS = (ca.OP_LT, ca.OP_LE, ca.OP_EQ, ca.OP_NE, ca.OP_NOT, ca.OP_AND, ca.OP_OR)


def symbols_of(subject: str, given: Any) -> list[Any]:
    """Symbols of SX or MX; vectors of SX are split, so that each entry has its name."""
    found: list[Any] = []
    for item in given if type(given) in (list, tuple) else [given]:
        if not issubclass(type(item), ca.SX | ca.MX) or not item.is_valid_input():
            raise InputError(
                subject, f"got {type(item).__name__}, not symbols", "make them with casadi's sym"
            )
        found += ca.vertsplit(ca.vec(item)) if isinstance(item, ca.SX) else [ca.vec(item)]
    return found


def names_of(symbols: Iterable[Any]) -> tuple[str, ...]:
    """Names of scalar `symbols`; for vectors of MX the name with an index."""
    return tuple(name for item in symbols for name in _entries(item.name(), item.numel()))


def _entries(name: str, size: int) -> list[str]:
    return [name] if size == 1 else [f"{name}[{k}]" for k in range(size)]


def stacked(given: Mapping[str, Any]) -> tuple[Any, tuple[str, ...]]:
    """Stack the expressions of `given`; name each row."""
    parts: list[Any] = []
    names: list[str] = []
    for name, each in given.items():
        expression = ca.vertcat(*each) if isinstance(each, list) else each
        symbolic = isinstance(expression, ca.SX | ca.MX)
        items: list[Any] = expression.elements() if isinstance(expression, ca.SX) else [expression]
        if symbolic and any(item.is_op(kind) for item in items for kind in _COMPARISONS):
            remedy = "write the expression that must be <= 0: u - 1 for u <= 1"
            raise InputError(f"constraint {name}", "is a comparison", remedy)
        subject = f"constraint {name}"
        parts.append(ca.vec(expression) if symbolic else asked(subject, ca.DM, expression))
        names += _entries(name, parts[-1].numel())
    return (ca.vertcat(*parts) if parts else ca.DM.zeros(0, 1)), tuple(names)


def function_of(
    name: str, expression: Any, symbols: Sequence[list[Any]], size: int, alone: bool = False
) -> Any:
    """Function of (x, u, d, theta) in SX; if `alone`, it may depend on x and theta only."""
    flat = [item for group in symbols for item in group]
    kind: Any = type(flat[0])
    if any(not isinstance(item, kind) for item in flat):
        raise InputError("symbols", "mix SX and MX", "make all of them with one of the two")
    try:
        vector = ca.densify(kind(expression))
        raw = ca.Function(name, flat, [vector], {"allow_free": True})
    except (NotImplementedError, SystemError, TypeError, RuntimeError):
        raise InputError(
            name, f"got {type(expression).__name__}", f"give an expression of {kind.__name__}"
        ) from None
    if vector.shape != (size, 1) and not (size == 0 and vector.numel() == 0):
        raise InputError(name, f"has shape {vector.shape}", f"give ({size}, 1)")
    if raw.has_free():
        raise InputError(
            name, f"has the unknown symbol {', '.join(raw.get_free())}",
            "make it a state, input, disturbance or parameter, or give it a value",
        )  # fmt: skip
    parts = [[ca.SX.sym(letter, item.numel()) for item in group]
             for letter, group in zip("xudp", symbols, strict=True)]  # fmt: skip
    value = raw(*(item for group in parts for item in group))
    made = ca.Function(name, [ca.vertcat(ca.SX(0, 1), *group) for group in parts], [value])
    if alone and any(made.jac_sparsity(0, index).nnz() for index in (1, 2)):
        raise InputError(name, "depends on an input or a disturbance", "use the last state only")
    return made


def require_influence(names: Sequence[str], functions: Sequence[Any]) -> None:
    """Require that every parameter occurs in an expression."""
    seen = sum(np.array(ca.DM(one.jac_sparsity(0, 3), 1)).sum(axis=0) for one in functions)
    for name, count in zip(names, seen, strict=True):
        if not count:
            raise InputError(f"parameter {name}", "occurs in no expression", "remove it")
