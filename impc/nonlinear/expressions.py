"""Expressions and symbols of CasADi that a user gives, checked, and made functions.

Every function is one of (x, u, d, theta), in SX where CasADi can: a scalar form is evaluated
fastest (docs/nonlinear.md).
"""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from impc.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from impc.arrays import Array


_COMPARISONS = (ca.OP_LT, ca.OP_LE, ca.OP_EQ, ca.OP_NE, ca.OP_NOT, ca.OP_AND, ca.OP_OR)


def with_values(function: Any, free: list[int], values: Array) -> Any:
    """A function of (x, u, d, theta) as one of the free entries of theta.

    `values` (any,).
    """
    given = [ca.MX.sym(letter, function.numel_in(k)) for k, letter in enumerate("xud")]
    left = ca.MX.sym("p", len(free))
    whole = ca.MX(ca.DM(values))
    whole[free] = left
    return _expanded(ca.Function(function.name(), [*given, left], [function(*given, whole)]))


def symbols_of(subject: str, given: Any) -> list[Any]:
    """Symbols of SX or MX; SX are taken apart, so that each has its name."""
    items = given if isinstance(given, list | tuple) else [given]
    found: list[Any] = []
    for item in items:
        if not isinstance(item, ca.SX | ca.MX) or not item.is_valid_input():
            raise InputError(
                subject, f"got {type(item).__name__}, not symbols", "make them with casadi's sym"
            )
        found += ca.vertsplit(ca.vec(item)) if isinstance(item, ca.SX) else [ca.vec(item)]
    return found


def scalar(name: str, symbol: Any) -> Any:
    """The symbol of a parameter."""
    if len(found := symbols_of(f"parameter {name}", symbol)) != 1 or found[0].numel() != 1:
        raise InputError(f"parameter {name}", "is not a scalar symbol", "give one symbol a name")
    return found[0]


def names_of(symbols: Iterable[Any]) -> tuple[str, ...]:
    """Of scalar `symbols` their own; of the entries of MX, the vector's with a number."""
    return tuple(
        name
        for item in symbols
        for name in (
            [item.name()]
            if item.numel() == 1
            else [f"{item.name()}[{k}]" for k in range(item.numel())]
        )
    )


def stacked(given: Mapping[str, Any]) -> tuple[Any, tuple[str, ...]]:
    """The expressions of `given` below each other, by name, and a name for each row."""
    parts: list[Any] = []
    names: list[str] = []
    for name, expression in given.items():
        items = expression.elements() if isinstance(expression, ca.SX) else [expression]
        if any(isinstance(item, ca.SX | ca.MX) and _compares(item) for item in items):
            remedy = "write what must not exceed 0: u - 1 for u <= 1"
            raise InputError(f"constraint {name}", "is a comparison", remedy)
        part = ca.vec(expression) if isinstance(expression, ca.SX | ca.MX) else ca.DM(expression)
        parts.append(part)
        size = part.numel()
        names += [name] if size == 1 else [f"{name}[{row}]" for row in range(size)]
    return (ca.vertcat(*parts) if parts else ca.DM.zeros(0, 1)), tuple(names)


def _compares(item: Any) -> bool:
    return any(item.is_op(kind) for kind in _COMPARISONS)


def function_of(
    name: str, expression: Any, symbols: Sequence[list[Any]], size: tuple[int], alone: bool = False
) -> Any:
    """A function of (x, u, d, theta) in SX where CasADi can."""
    flat = [item for group in symbols for item in group]
    kind: Any = ca.SX if isinstance(flat[0], ca.SX) else ca.MX
    if any(not isinstance(item, kind) for item in flat):
        raise InputError("symbols", "are of SX and of MX", "make all of them with one of the two")
    try:
        vector = ca.densify(kind(expression))
        raw = ca.Function(name, flat, [vector], {"allow_free": True})
    except (NotImplementedError, TypeError, RuntimeError):
        raise InputError(
            name, f"got {type(expression).__name__}", f"give an expression of {kind.__name__}"
        ) from None
    if vector.shape != (size[0], 1) and not (size[0] == 0 and vector.numel() == 0):
        raise InputError(name, f"has shape {vector.shape}", f"give ({size[0]}, 1)")
    if raw.has_free():
        raise InputError(
            name, f"has the symbol {', '.join(raw.get_free())}",
            "which is neither a state, an input, a disturbance nor a parameter: give it a value",
        )  # fmt: skip
    outer = [ca.MX.sym(letter, sum(i.numel() for i in group))
             for letter, group in zip("xudp", symbols, strict=True)]  # fmt: skip
    parts: list[Any] = []
    for whole, group in zip(outer, symbols, strict=True):
        ends = np.cumsum([0, *(item.numel() for item in group)])
        parts += [whole[int(a) : int(b)] for a, b in itertools.pairwise(ends)]
    made = ca.Function(name, outer, [raw(*parts)])
    if alone and any(made.jac_sparsity(0, index).nnz() for index in (1, 2)):
        raise InputError(name, "depends on an input or a disturbance", "give it of the last state")
    return _expanded(made)


def _expanded(made: Any) -> Any:
    try:
        return made.expand()
    except RuntimeError:  # it calls what has no scalar form, such as an integrator
        return made


def require_influence(names: Sequence[str], functions: Sequence[Any]) -> None:
    """Every parameter is in an expression."""
    seen = np.zeros(len(names), dtype=bool)
    for function in functions:
        if function.numel_out(0):
            seen |= np.array(ca.DM(function.jac_sparsity(0, 3), 1).full()).any(axis=0)
    for name, there in zip(names, seen, strict=True):
        if not there:
            raise InputError(f"parameter {name}", "is in no expression", "take it out")
