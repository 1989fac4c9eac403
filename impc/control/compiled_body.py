"""Compiled code: one sample of a nonlinear body, with its derivative.

The body's machine code (`body_steps`) writes the next state and its derivatives by state, input and
disturbance; those along p directions follow by the chain rule (docs/howto/nonlinear.md). A division
by zero gives infinity, and the loop then diverges.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic

from impc.arrays import Buffer
from impc.control.compiled_kernel import copy
from impc.control.compiled_values import BodyTape
from impc.jit import inner, njit


@inner()
def move_body(
    body: BodyTape,
    x: Buffer,
    u: Buffer,
    disturbance: Buffer,
    dx: Buffer,
    du: Buffer,
    ahead: Buffer,
    dahead: Buffer,
) -> None:
    """Compute x+ = f(x, u, d) and its derivative.

    `x` (n,); `u` (m,); `disturbance` (d,); `dx` (n, p); `du` (m, p); `ahead` (n,); `dahead`
    (n, p).
    """
    n, p = len(x), dx.shape[1]
    _find(body, x, u, disturbance)
    for i in range(n):
        ahead[i] = body.found[i]
        for c in range(p):
            dahead[i, c] = 0.0
    # Row by row: a sum over j would wait for its previous term each time.
    for j in range(n):
        for i in range(n):
            slope = body.slopes[i, j]
            if slope != 0.0:  # a delay has one per row
                for c in range(p):
                    dahead[i, c] += slope * dx[j, c]
    for j in range(len(u)):
        for i in range(n):
            slope = body.slopes[i, n + j]
            for c in range(p):
                dahead[i, c] += slope * du[j, c]


@njit()
def states_along(body: BodyTape, x: Buffer, u: Buffer, disturbance: Buffer, ahead: Buffer) -> None:
    """Compute the next state at every sample of a trajectory.

    `x` (steps, n); `u` (steps, m); `disturbance` (steps, d); `ahead` (steps, n).
    """
    for t in range(len(ahead)):
        _find(body, x[t], u[t], disturbance[t])
        copy(body.found, ahead[t])


@njit()
def states_from(body: BodyTape, u: Buffer, disturbance: Buffer, x: Buffer) -> None:
    """Compute a trajectory `x` (steps + 1, n) from its first state.

    `u` (steps, m); `disturbance` (steps, d).
    """
    for t in range(len(u)):
        _find(body, x[t], u[t], disturbance[t])
        copy(body.found, x[t + 1])


@njit()
def move_along(body: BodyTape, x: Buffer, u: Buffer, disturbance: Buffer, slopes: Buffer) -> None:
    """Compute the derivatives of the next state at every sample of a trajectory.

    `x` (steps, n); `u` (steps, m); `disturbance` (steps, d); `slopes` (steps, n, n + m + d).
    """
    for t in range(len(slopes)):
        _find(body, x[t], u[t], disturbance[t])
        for i in range(x.shape[1]):
            copy(body.slopes[i], slopes[t, i])


@inner()
def _find(body: BodyTape, x: Buffer, u: Buffer, disturbance: Buffer) -> None:
    n, m = len(x), len(u)
    for i in range(n):
        body.given[i] = x[i]
    for i in range(m):
        body.given[n + i] = u[i]
    for i in range(len(disturbance)):
        body.given[n + m + i] = disturbance[i]
    if body.beside.shape[1] > 0:  # also clears entries that the code does not write
        body.slopes[:] = 0.0
    _call(body.address, body.constants, body.given, body.found)
    for j in range(body.beside.shape[1]):
        for i in range(n):
            body.found[i] += body.beside[i, j] * body.given[j]
            body.slopes[i, j] += body.beside[i, j]


def _called(context: Any, address: Any, constants: Any, given: Any, found: Any) -> Any:
    """Call the function at `address` with pointers to three arrays."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        arrays = zip(signature.args[1:], values[1:], strict=True)
        pointers = [
            context.make_array(kind)(context, builder, value).data for kind, value in arrays
        ]
        kind = ir.FunctionType(ir.VoidType(), [pointer.type for pointer in pointers])
        builder.call(builder.inttoptr(values[0], kind.as_pointer()), pointers)
        return context.get_dummy_value()

    return types.void(address, constants, given, found), generate


_call: Callable[[int, Buffer, Buffer, Buffer], None] = cast("Any", intrinsic(_called))
