"""A map that is linearised by itself as a `casadi.Function`, with forward and reverse derivatives.

CasADi asks for the value, for directions of the outputs that belong to directions of the inputs
(forward), and for weights of the inputs that belong to weights of the outputs (in reverse), each as
a function of its own that stands beside the others (`casadi.Callback`; docs/casadi.md). All of them
share one map, which is evaluated and linearised once at each point. Directions are the first axis
of an array here, and stand beside each other in CasADi.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, Protocol

import casadi as ca
import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from impc.arrays import Array

_Kind = Literal["value", "forward", "reverse"]
# CasADi's graphs do not keep alive what they call in Python: a function that is made stays.
_alive: list[Any] = []


@dataclass(frozen=True)
class Signature:
    """Names and shapes of what goes in and comes out."""

    inputs: dict[str, tuple[int, int]]  # Rows and columns of each
    outputs: dict[str, tuple[int, int]]


class Linear(Protocol):
    """A linear map of changes."""

    def forward(self, seeds: list[Array]) -> list[Array]:
        """Directions of the outputs, (k, rows, columns) of each.

        `seeds` (k, rows, columns).
        """

    def reverse(self, seeds: list[Array]) -> list[Array]:
        """Weights of the inputs, (k, rows, columns) of each.

        `seeds` (k, rows, columns).
        """


class Map(Protocol):
    """What `differentiable` makes a function of; NaN where there is no value."""

    signature: Signature

    def value(self, point: list[Array]) -> list[Array]:
        """The outputs, (rows, columns) of each as in the signature.

        `point` (rows, columns).
        """

    def linearised(self, point: list[Array]) -> Linear:
        """The linear map of changes.

        `point` (rows, columns).
        """


class Matrix:
    """A linear map that is a `matrix` (outputs, inputs) of all entries, row by row."""

    def __init__(self, matrix: Array, signature: Signature) -> None:
        self._matrix, self._signature = matrix, signature

    def forward(self, seeds: list[Array]) -> list[Array]:
        """As in `Linear`.

        `seeds` (k, rows, columns); returns (k, rows, columns).
        """
        return _parts(_flat(seeds) @ self._matrix.T, self._signature.outputs)

    def reverse(self, seeds: list[Array]) -> list[Array]:
        """As in `Linear`.

        `seeds` (k, rows, columns); returns (k, rows, columns).
        """
        return _parts(_flat(seeds) @ self._matrix, self._signature.inputs)


def differentiable(name: str, inner: Map) -> ca.Function:
    """A map as a function of CasADi by that `name`."""
    return _Callback(name, _Remembered(inner), "value", 0)


class _Callback(ca.Callback):
    """The value of a map, or with `count` seeds its derivatives, as CasADi calls them."""

    def __init__(self, name: str, inner: _Remembered, kind: _Kind, count: int) -> None:
        ca.Callback.__init__(self)
        self._inner, self._kind, self._count = inner, kind, count
        ins, outs = inner.map.signature.inputs, inner.map.signature.outputs
        known = {} if kind == "value" else {f"out_{key}": shape for key, shape in outs.items()}
        self._given = {**ins, **known}
        self._seeds = {"value": {}, "forward": ins, "reverse": outs}[kind]
        self._found = {"value": outs, "forward": outs, "reverse": ins}[kind]
        _alive.append(self)
        self.construct(name, {})

    def get_n_in(self) -> int:
        return len(self._given) + len(self._seeds)

    def get_n_out(self) -> int:
        return len(self._found)

    def get_name_in(self, index: int) -> str:
        return [*self._given, *(f"{self._kind}_{name}" for name in self._seeds)][index]

    def get_name_out(self, index: int) -> str:
        name = list(self._found)[index]
        return name if self._kind == "value" else f"{self._kind}_{name}"

    def get_sparsity_in(self, index: int) -> ca.Sparsity:
        shapes = list(self._given.values())
        if index < len(shapes):
            return ca.Sparsity.dense(*shapes[index])
        rows, columns = list(self._seeds.values())[index - len(shapes)]
        return ca.Sparsity.dense(rows, columns * self._count)

    def get_sparsity_out(self, index: int) -> ca.Sparsity:
        rows, columns = list(self._found.values())[index]
        return ca.Sparsity.dense(rows, columns * (1 if self._kind == "value" else self._count))

    def has_forward(self, count: int) -> bool:
        return self._kind == "value"

    def has_reverse(self, count: int) -> bool:
        return self._kind == "value"

    def get_forward(self, count: int, name: str, *_: Any) -> ca.Function:
        return _Callback(name, self._inner, "forward", count)

    def get_reverse(self, count: int, name: str, *_: Any) -> ca.Function:
        return _Callback(name, self._inner, "reverse", count)

    def eval(self, given: Sequence[ca.DM]) -> list[Any]:
        arrays: list[Array] = [np.asarray(part.full()) for part in given]
        point = arrays[: len(self._inner.map.signature.inputs)]
        if self._kind == "value":
            return self._inner.value(point)
        linear = self._inner.linearised(point)
        seeds: list[Array] = [
            np.moveaxis(part.reshape(len(part), self._count, -1), 1, 0)
            for part in arrays[len(self._given) :]
        ]
        moved = linear.forward(seeds) if self._kind == "forward" else linear.reverse(seeds)
        return [np.hstack(list(part)) for part in moved]


class _Remembered:
    """A map with what it was at the last point."""

    def __init__(self, inner: Map) -> None:
        self.map = inner
        self._known: dict[str, tuple[list[Array], Any]] = {}

    def value(self, point: list[Array]) -> list[Array]:
        return self._at("value", point, self.map.value)  # type: ignore[no-any-return]

    def linearised(self, point: list[Array]) -> Linear:
        return self._at("linearised", point, self.map.linearised)  # type: ignore[no-any-return]

    def _at(self, what: str, point: list[Array], compute: Callable[[list[Array]], Any]) -> Any:
        known = self._known.get(what)
        if known is None or not all(map(np.array_equal, known[0], point)):
            known = self._known[what] = (point, compute(point))
        return known[1]


def _flat(parts: list[Array]) -> Array:
    return np.column_stack([part.reshape(len(part), -1) for part in parts])


def _parts(flat: Array, shapes: dict[str, tuple[int, int]]) -> list[Array]:
    ends = np.cumsum([rows * columns for rows, columns in shapes.values()])[:-1]
    return [
        part.reshape(len(part), *shape)
        for part, shape in zip(np.split(flat, ends, axis=1), shapes.values(), strict=True)
    ]
