"""Compiled code: one sample of a body that is not linear, with its derivative.

The operations of a `impc.model.body.Body` are run one after the other; each has its value and its
derivative along p directions, by the chain rule, so that the derivative is exact and costs p
multiplications an operand that moves (docs/nonlinear.md). A division by zero is infinite here, and
the loop then diverges.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from impc.arrays import Buffer
from impc.jit import njit
from impc.model.body import OPERATIONS

__all__ = ["BodyTape", "move_along", "move_body", "states_along"]

(
    _OUTPUT,
    _MUL,
    _ADD,
    _SUB,
    _DIV,
    _NEG,
    _SQ,
    _TWICE,
    _SIN,
    _COS,
    _TAN,
    _SQRT,
    _INV,
    _EXP,
    _LOG,
    _POW,
    _CONSTPOW,
    _FABS,
    _SIGN,
    _TANH,
    _SINH,
    _COSH,
    _ASIN,
    _ACOS,
    _ATAN,
    _ATAN2,
    _FMIN,
    _FMAX,
    _LT,
    _LE,
    _EQ,
    _NE,
    _NOT,
    _AND,
    _OR,
    _IF_ELSE_ZERO,
    _ASSIGN,
    _HYPOT,
    _LOG1P,
    _EXPM1,
) = range(len(OPERATIONS))


class BodyTape(NamedTuple):
    """A `Body`, and its slots: what was computed last and the derivatives along p directions.

    Attributes
    ----------
    code : Buffer
        (k, 4); no rows where the linear plant moves.
    given : int
        Slot of the first state; those before it hold the constants, without derivatives.
    values, slopes : Buffer
        (slots,) and (slots, p).
    """

    code: Buffer
    given: int
    values: Buffer
    slopes: Buffer


@njit(cache=True)
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
    """x+ = f(x, u, d) and its derivative, operation by operation.

    Parameters
    ----------
    body : BodyTape
        With the constants in their slots.
    x, u, disturbance : Buffer
        (n,), (m,) and (d,).
    dx, du : Buffer
        Their derivatives (n, p) and (m, p); the disturbance has none.
    ahead, dahead : Buffer
        Written: the next state (n,) and its derivative (n, p).
    """
    values, slopes, first = body.values, body.slopes, body.given
    n, m = len(x), len(u)
    values[first : first + n], slopes[first : first + n] = x, dx
    values[first + n : first + n + m], slopes[first + n : first + n + m] = u, du
    values[first + n + m : first + n + m + len(disturbance)] = disturbance
    # Without a sign: where an index might be negative numba asks at every use.
    p, moving = dx.shape[1], np.uintp(first)
    for k in range(len(body.code)):
        operation, to = body.code[k, 0], np.uintp(body.code[k, 1])
        a, b = np.uintp(body.code[k, 2]), np.uintp(body.code[k, 3])
        if operation == _OUTPUT:
            ahead[to] = values[a]
            for c in range(p):
                dahead[to, c] = slopes[a, c]
            continue
        value, by_a, by_b = _operation(operation, values[a], values[b])
        values[to] = value
        # Half of the operations have one operand that moves; a sum over both reads twice as much.
        if b < moving or by_b == 0.0:
            for c in range(p):
                slopes[to, c] = by_a * slopes[a, c]
        elif a < moving:
            for c in range(p):
                slopes[to, c] = by_b * slopes[b, c]
        else:
            for c in range(p):
                slopes[to, c] = by_a * slopes[a, c] + by_b * slopes[b, c]


@njit(cache=True)
def states_along(body: BodyTape, x: Buffer, u: Buffer, disturbance: Buffer, ahead: Buffer) -> None:
    """The next state at every sample of a trajectory.

    Parameters
    ----------
    body : BodyTape
        Without directions.
    x, u, disturbance : Buffer
        (steps, n), (steps, m) and (steps, d).
    ahead : Buffer
        Written: (steps, n).
    """
    still, at = np.empty((x.shape[1], 0)), np.empty((u.shape[1], 0))
    for t in range(len(ahead)):
        move_body(body, x[t], u[t], disturbance[t], still, at, ahead[t], still)


@njit(cache=True)
def move_along(body: BodyTape, x: Buffer, u: Buffer, disturbance: Buffer, slopes: Buffer) -> None:
    """Derivatives of one sample by all that is given, at every sample of a trajectory.

    Parameters
    ----------
    body : BodyTape
        With the identity in the slopes of the states, inputs and disturbances.
    x, u, disturbance : Buffer
        (steps, n), (steps, m) and (steps, d).
    slopes : Buffer
        Written: (steps, n, n + m + d).
    """
    n, m = x.shape[1], u.shape[1]
    unit = body.slopes[body.given : body.given + n + m].copy()
    ahead = np.empty(n)
    for t in range(len(slopes)):
        at, to = unit[:n], unit[n:]
        move_body(body, x[t], u[t], disturbance[t], at, to, ahead, slopes[t])


@njit(cache=True, error_model="numpy")
def _operation(operation: int, a: float, b: float) -> tuple[float, float, float]:
    """An operation and its two slopes; that by b is zero where there is one operand."""
    if operation == _MUL:
        return a * b, b, a
    if operation == _ADD:
        return a + b, 1.0, 1.0
    if operation == _SUB:
        return a - b, 1.0, -1.0
    if operation == _DIV:
        return a / b, 1 / b, -a / (b * b)
    if operation == _NEG:
        return -a, -1.0, 0.0
    if operation == _SQ:
        return a * a, 2 * a, 0.0
    if operation == _TWICE:
        return 2 * a, 2.0, 0.0
    if operation == _SIN:
        return np.sin(a), np.cos(a), 0.0
    if operation == _COS:
        return np.cos(a), -np.sin(a), 0.0
    return _rarer(operation, a, b)


@njit(cache=True, error_model="numpy")
def _rarer(operation: int, a: float, b: float) -> tuple[float, float, float]:
    """The other smooth operations of one operand, and what is left."""
    if operation == _TAN:
        return np.tan(a), 1 + np.tan(a) ** 2, 0.0
    if operation == _SQRT:
        return np.sqrt(a), 0.5 / np.sqrt(a), 0.0
    if operation == _INV:
        return 1 / a, -1 / (a * a), 0.0
    if operation == _EXP:
        return np.exp(a), np.exp(a), 0.0
    if operation == _LOG:
        return np.log(a), 1 / a, 0.0
    if operation == _TANH:
        return np.tanh(a), 1 - np.tanh(a) ** 2, 0.0
    if operation == _SINH:
        return np.sinh(a), np.cosh(a), 0.0
    if operation == _COSH:
        return np.cosh(a), np.sinh(a), 0.0
    if operation == _ASIN:
        return np.arcsin(a), 1 / np.sqrt(1 - a * a), 0.0
    if operation == _ACOS:
        return np.arccos(a), -1 / np.sqrt(1 - a * a), 0.0
    if operation == _ATAN:
        return np.arctan(a), 1 / (1 + a * a), 0.0
    if operation == _LOG1P:
        return np.log1p(a), 1 / (1 + a), 0.0
    if operation == _EXPM1:
        return np.expm1(a), np.exp(a), 0.0
    return _of_two(operation, a, b)


@njit(cache=True, error_model="numpy")
def _of_two(operation: int, a: float, b: float) -> tuple[float, float, float]:
    """Powers, angles and sizes of two operands."""
    if operation == _POW:
        by_b = a**b * np.log(a) if a > 0 else 0.0
        return a**b, b * a ** (b - 1), by_b
    if operation == _CONSTPOW:
        return a**b, b * a ** (b - 1), 0.0
    if operation == _ATAN2:
        square = a * a + b * b
        return np.arctan2(a, b), b / square, -a / square
    if operation == _HYPOT:
        size = np.hypot(a, b)
        return size, a / size, b / size
    if operation == _FMIN:
        return (a, 1.0, 0.0) if a <= b else (b, 0.0, 1.0)
    if operation == _FMAX:
        return (a, 1.0, 0.0) if a >= b else (b, 0.0, 1.0)
    if operation == _FABS:
        return abs(a), np.sign(a), 0.0
    if operation == _ASSIGN:
        return a, 1.0, 0.0
    if operation == _IF_ELSE_ZERO:
        return (b, 0.0, 1.0) if a != 0 else (0.0, 0.0, 0.0)
    if operation == _SIGN:
        return np.sign(a), 0.0, 0.0
    return (1.0 if _holds(operation, a, b) else 0.0), 0.0, 0.0


@njit(cache=True)
def _holds(operation: int, a: float, b: float) -> bool:
    """Whether a comparison holds."""
    if operation == _LT:
        return a < b
    if operation == _LE:
        return a <= b
    if operation == _EQ:
        return a == b
    if operation == _NE:
        return a != b
    if operation == _NOT:
        return a == 0
    if operation == _AND:
        return a != 0 and b != 0
    return a != 0 or b != 0  # OR
