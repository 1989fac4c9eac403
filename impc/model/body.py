"""Nonlinear body x_{k+1} = f(x_k, u_k, d_k) as a list of scalar operations with derivatives.

A plant may offer its own equations in addition to the matrices with which its controller predicts
(docs/howto/nonlinear.md). They come as a `casadi.Function` and are stored as arrays of operations,
which can be compared, saved and sent, and which `native_body` compiles to machine code. Parameters
are constants of the list.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice
from typing import Any, ClassVar

import numpy as np

from impc.arrays import Array, IntArray, finite_array, frozen
from impc.checking import Value, replace
from impc.errors import PlantError, one_line

_MOST = 200  # points of a drawing
#: Names of the operations in CasADi, without ``OP_``; code refers to them by index.
OPERATIONS = (
    *("OUTPUT", "MUL", "ADD", "SUB", "DIV", "NEG", "SQ", "TWICE", "SIN", "COS", "TAN", "SQRT"),
    *("INV", "EXP", "LOG", "POW", "CONSTPOW", "FABS", "SIGN", "TANH", "SINH", "COSH", "ASIN"),
    *("ACOS", "ATAN", "ATAN2", "FMIN", "FMAX", "LT", "LE", "EQ", "NE", "NOT", "AND", "OR"),
    *("IF_ELSE_ZERO", "ASSIGN", "HYPOT", "LOG1P", "EXPM1"),
)


@dataclass(frozen=True)
class Body(Value):
    """Operations of one sample of a body, and of its derivatives.

    Every value has a slot: first the c constants, then the g given states, inputs and disturbances,
    then computed values.
    """

    _rules: ClassVar[Mapping[str, Any]] = {"constants": "*", "beside": "* *"}

    # (k, 4): index of the operation in `OPERATIONS`; slot of the result; slots of the two operands
    # (the second may be unused). The result of an OUTPUT is an index into the n next states
    # followed by their n x g derivatives, row by row. Derivatives that are always zero are absent.
    code: IntArray
    constants: Array  # (c,)
    # linear map (n, g) of the given values that is added to the next state; or (n, 0)
    beside: Array = field(default_factory=lambda: frozen(np.zeros((0, 0))))

    def moved(self, A: Array, B: Array, E: Array) -> Body:
        """Body with A x + B u + E d added to its next state."""
        more = np.hstack([A, B, E])
        return replace(self, beside=frozen(more + self.beside if self.beside.size else more))


def read_body(function: Any, order: Sequence[int], n: int) -> Body:
    """Convert a function (state, input) -> next state to a `Body`."""
    import casadi as ca  # noqa: PLC0415  # takes 0.3 s; most plants have no body

    if not issubclass(type(function), ca.Function):
        kind = type(function).__name__
        raise PlantError(
            "plant.body", f"expected a casadi.Function, got {kind}", "see docs/howto/nonlinear.md"
        )
    sizes = [function.size_in(i) for i in range(function.n_in())]
    wanted = [(n, 1), (len(order), 1)]
    if sizes != wanted or function.n_out() != 1 or function.size_out(0) != (n, 1):
        raise PlantError(
            "plant.body",
            f"maps {sizes} to {function.n_out()} outputs, the first {function.size_out(0)}",
            f"make it (states {wanted[0]}, inputs {wanted[1]}) -> next states",
        )
    given = ca.SX.sym("given", n + len(order))
    inputs = ca.vertcat(*(given[n + list(order).index(k)] for k in range(len(order))))
    ahead = ca.densify(function.expand()(given[:n], inputs))
    listed = []
    for reverse in (0, 1):  # for the seat, 1511 operations one way and 2331 the other
        slopes = ca.jacobian(ahead, given, {"helper_options": {"ad_weight": reverse}})
        listed.append(ca.Function("body", [given], [ahead, slopes], {"cse": True}))
    return _listed(min(listed, key=lambda each: each.n_instructions()))


def _listed(function: Any) -> Body:
    """Operations of a function of one vector, and of its derivatives."""
    names = _names()
    n, given = function.size_out(1)
    at, by = (np.array(places) for places in function.sparsity_out(1).get_triplet())
    places = (np.arange(n), n + at * given + by)
    code: list[tuple[int, int, int, int]] = []
    count = function.n_instructions()
    kinds = [function.instruction_id(k) for k in range(count)]
    called = [names.get(kind, str(kind)) for kind in kinds]
    constants = [function.instruction_constant(k) for k in range(count) if called[k] == "CONST"]
    first, met = len(constants) + given, 0
    where: dict[int, int] = {}  # slot of each register of the function
    for k, name in enumerate(called):
        to = function.instruction_output(k)
        if name == "CONST":
            where[to[0]] = met
            met += 1
        elif name == "INPUT":
            where[to[0]] = len(constants) + function.instruction_input(k)[1]
        elif name in OPERATIONS:
            read = [where[register] for register in function.instruction_input(k)]
            if name != "OUTPUT":
                where[to[0]] = first + to[0]
            slot = places[to[0]][to[1]] if name == "OUTPUT" else where[to[0]]
            code.append((OPERATIONS.index(name), slot, read[0], read[-1]))
        else:
            raise PlantError("plant.body", f"uses the unknown operation {name}", "do not use it")
    table = np.array(code, dtype=np.int64).reshape(-1, 4)
    table.flags.writeable = False
    return Body(table, frozen(constants))


@functools.cache
def _names() -> dict[int, str]:
    """Names of CasADi's operation numbers."""
    import casadi as ca  # noqa: PLC0415  # as above

    found = {getattr(ca, f"OP_{name}"): name for name in (*OPERATIONS, "CONST", "INPUT")}
    others = {getattr(ca, name): name[3:] for name in dir(ca) if name.startswith("OP_")}
    return {**others, **found}


def lines_at(draw: Callable[[Array], Any], states: Array) -> tuple[Array, ...]:
    """Lines (samples, points, 2) of a user's function at `states` (samples, n), checked."""
    try:
        each = [
            [finite_array("a line", one, (None, 2)) for one in islice(draw(state), _MOST + 1)]
            for state in states
        ]
        lines = tuple(map(np.stack, zip(*each, strict=True)))
        if not 0 < sum(line.shape[1] for line in lines) <= _MOST:
            raise ValueError(f"it needs 1 to {_MOST} points")
    except Exception as error:  # the function may raise anything
        remedy = "return lines (points, 2), the same points in every state"
        raise PlantError("plant.drawing", f"fails: {one_line(error)}", remedy) from None
    return lines
