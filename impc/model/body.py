"""The body that moves, where it is not linear: x_{k+1} = f(x_k, u_k, d_k) as a list of operations.

A plant may offer its own equations beside the matrices by which its controller predicts them
(docs/nonlinear.md, "A body that is not linear"). They come as a `casadi.Function` and are kept as
the list of its scalar operations and of those of its derivatives: arrays, which can be compared,
kept and sent, and which `native_body` makes machine code of. Parameters are among the constants of
the list.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from impc.arrays import Array, IntArray, frozen
from impc.checking import Value, replace
from impc.errors import PlantError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

#: Names of the operations in CasADi, without ``OP_``; a list of operations has their places.
OPERATIONS = (
    *("OUTPUT", "MUL", "ADD", "SUB", "DIV", "NEG", "SQ", "TWICE", "SIN", "COS", "TAN", "SQRT"),
    *("INV", "EXP", "LOG", "POW", "CONSTPOW", "FABS", "SIGN", "TANH", "SINH", "COSH", "ASIN"),
    *("ACOS", "ATAN", "ATAN2", "FMIN", "FMAX", "LT", "LE", "EQ", "NE", "NOT", "AND", "OR"),
    *("IF_ELSE_ZERO", "ASSIGN", "HYPOT", "LOG1P", "EXPM1"),
)


@dataclass(frozen=True)
class Body(Value):
    """The operations of one sample of a body, and of its derivatives.

    A value has a slot. The first slots hold the constants, those behind them the g states, inputs
    and disturbances that are given, the rest what is computed.
    """

    _rules: ClassVar[Mapping[str, Any]] = {"constants": "*", "beside": "* *"}

    # (k, 4): operation, by its place in `OPERATIONS`; slot of the answer; slots of its two
    # operands, of which one may not be used. The answer of an OUTPUT is a place among the n next
    # states and, behind them and row by row, their n x g derivatives by what is given. A derivative
    # that is zero wherever the body is has none.
    code: IntArray
    constants: Array  # (c,)
    # What is added to it in proportion to what is given (n, g), or nothing (n, 0)
    beside: Array = field(default_factory=lambda: frozen(np.zeros((0, 0))))

    def moved(self, A: Array, B: Array, E: Array) -> Body:
        """The body with A x + B u + E d added to its next state."""
        more = np.hstack([A, B, E])
        return replace(self, beside=frozen(more + self.beside if self.beside.size else more))


def read_body(function: Any, order: Sequence[int], n: int) -> Body:
    """The operations of a function (state, input) -> next state."""
    import casadi as ca  # noqa: PLC0415  # a third of a second, and most plants have no body

    if not isinstance(function, ca.Function):
        kind = type(function).__name__
        raise PlantError("plant.body", f"expected a casadi.Function, got {kind}", "see docs")
    sizes = [function.size_in(i) for i in range(function.n_in())]
    wanted = [(n, 1), (len(order), 1)]
    if sizes != wanted or function.n_out() != 1 or function.size_out(0) != (n, 1):
        raise PlantError(
            "plant.body",
            f"takes {sizes} and gives {function.n_out()} of {function.size_out(0)}",
            f"make it (states {wanted[0]}, inputs {wanted[1]}) -> next states",
        )
    given = ca.SX.sym("given", n + len(order))
    inputs = ca.vertcat(*(given[n + list(order).index(k)] for k in range(len(order))))
    ahead = ca.densify(function.expand()(given[:n], inputs))
    listed = []
    for reverse in (0, 1):  # of the seat's 1511 operations the other way has 2331
        slopes = ca.jacobian(ahead, given, {"helper_options": {"ad_weight": reverse}})
        listed.append(ca.Function("body", [given], [ahead, slopes], {"cse": True}))
    return _listed(min(listed, key=lambda each: each.n_instructions()))


def _listed(function: Any) -> Body:
    """The operations of a function of one vector, of SX expressions, and of its derivatives."""
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
            raise PlantError("plant.body", f"has the operation {name}", "write it without")
    table = np.array(code, dtype=np.int64).reshape(-1, 4)
    table.flags.writeable = False
    return Body(table, frozen(constants))


@functools.cache
def _names() -> dict[int, str]:
    """CasADi's numbers of operations with their names."""
    import casadi as ca  # noqa: PLC0415  # as above

    found = {getattr(ca, f"OP_{name}"): name for name in (*OPERATIONS, "CONST", "INPUT")}
    others = {getattr(ca, name): name[3:] for name in dir(ca) if name.startswith("OP_")}
    return {**others, **found}
