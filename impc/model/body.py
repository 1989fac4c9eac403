"""The body that moves, where it is not linear: x_{k+1} = f(x_k, u_k, d_k) as CasADi keeps it.

A plant may offer its own equations beside the matrices by which its controller predicts them
(docs/nonlinear.md, "A body that is not linear"). They come as a `casadi.Function` and are kept as
the text that CasADi writes down of it, of one vector of all that is given: a value, which can be
compared, kept and sent.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from impc.checking import Value
from impc.errors import PlantError

if TYPE_CHECKING:
    from collections.abc import Sequence


@dataclass(frozen=True)
class Body(Value):
    """One sample of a body: (states, inputs and disturbances) -> next states."""

    function: str  # As `casadi.Function.serialize` has it


def read_body(function: Any, order: Sequence[int], n: int) -> Body:
    """The body of a function (state, input) -> next state."""
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
    body = Body(ca.Function("body", [given], [ahead], {"cse": True}).serialize())
    try:
        function_of(body, moving=False)
    except RuntimeError:
        raise PlantError("plant.body", "calls Python", "write it as an expression") from None
    return body


@functools.lru_cache(maxsize=64)
def function_of(body: Body, *, moving: bool) -> Any:
    """given (g,) -> the next state (n,) and, if `moving`, its derivatives (n, g), row by row."""
    import casadi as ca  # noqa: PLC0415  # as above

    alone = ca.Function.deserialize(body.function)
    if not moving:
        return alone
    given, listed = ca.SX.sym("given", alone.numel_in(0)), []
    ahead = alone(given)
    for reverse in (0, 1):  # of the seat's 1511 operations the other way has 2331
        slopes = ca.jacobian(ahead, given, {"helper_options": {"ad_weight": reverse}})
        found = [ahead, ca.densify(slopes).T]
        listed.append(ca.Function("body", [given], found, {"cse": True}))
    return min(listed, key=lambda each: each.n_instructions())
