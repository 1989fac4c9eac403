"""A proof that no inputs within their bounds keep the state bounds, in a hundred digits.

Multipliers y >= 0 of the rows E x_k <= b of the states and H x_N <= h of the terminal set prove it
when even the best inputs leave their sum above zero, which no plan that keeps the rows does:

    min over the inputs of  sum_k y_k'(E x_k - b) + y_N'(H x_N - h)  >  0.

Along x_{k+1} = A x_k + B u_k the sum is p_0'x_0 + sum_k (B'p_{k+1})'u_k less the bounds, with
p_k = A'p_{k+1} + E'y_k, so each input stands at the bound that its sign asks for. Where y comes
from does not matter. The Farkas combination of the rows in v = u + Kx is a proof in exact numbers
only; here the multipliers of its input rows are not used (docs/theory.md, section 4).
"""

from __future__ import annotations

from decimal import Decimal, localcontext
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.optimize import linprog

from impc.model.bounds import bound_rows

if TYPE_CHECKING:
    from impc.arrays import Array
    from impc.control.constraint_rows import Rows
    from impc.control.controller import Controller

__all__ = ["excluded_row", "proves_infeasible"]

# Enough for numbers that grow by 2^60, and 60 digits left.
_DIGITS = 100
# The sum must be positive by this share of its largest terms: far above the rounding of a hundred
# digits, and far below that of the double precision in which y was found.
_MARGIN = Decimal("1e-30")
# An input without a bound is taken to have one: this often what the gain asks for.
_REACH = Decimal(10**9)


def excluded_row(controller: Controller, rows: Rows, x: Array) -> int:
    """A hard row that, it is proved, no input sequence keeps beside the others; -1 if none is.

    The multipliers are those of the least share t of their bounds by which all rows are exceeded,
    T x + M v <= (1 + t) b, by HiGHS; the row is the one that weighs most in the proof.

    `x` (n,).
    """
    hard = np.isinf(rows.limit)
    width, b = rows.M.shape[1], rows.b[hard]
    answer: Any = linprog(
        np.r_[np.zeros(width), 1.0],
        A_ub=np.column_stack([rows.M[hard] / b[:, None], -np.ones(len(b))]),
        b_ub=1 - rows.T[hard] @ x / b,
        bounds=[*[(None, None)] * width, (-1.0, None)],
        method="highs",
    )
    if answer.status != 0:
        return -1
    y = np.zeros(len(hard))
    y[hard] = np.maximum(-answer.ineqlin.marginals, 0.0) / b
    return int(np.argmax(y * rows.b)) if proves_infeasible(controller, rows, y, x) else -1


def proves_infeasible(controller: Controller, rows: Rows, y: Array, x: Array) -> bool:
    """Whether multipliers prove that a state has no input sequence that keeps the hard rows.

    `y` (r,); `x` (n,).
    """
    plant, horizon = controller.plant, controller.horizon
    bounds = bound_rows(controller.bounds, plant)
    ahead = rows.stage >= horizon
    used = (bounds.on_state[rows.family] | ahead) & (y > 0) & np.isinf(rows.limit)
    if not np.any(used) or not np.all(np.isfinite(y)):
        return False
    with localcontext() as context:
        context.prec = _DIGITS
        A, B, state, weights = (_exact(part) for part in (plant.A, plant.B, x, y))
        asked = _REACH * (abs(_exact(controller.K)) @ abs(state))
        low, high = (
            np.where(np.isfinite(side), _exact(side), sign * asked)
            for side, sign in ((controller.bounds.u_min, -1), (controller.bounds.u_max, 1))
        )
        bound = _exact(rows.b[used]) @ weights[used]
        p = _exact(np.zeros(plant.n))
        if controller.terminal is not None:
            p = _exact(controller.terminal.H.T) @ (used * weights)[ahead]
        total, largest = -bound, abs(bound)
        for k in range(horizon - 1, -1, -1):
            pull = p @ B
            pushed = np.where(pull > 0, pull * low, pull * high)
            total, largest = total + pushed.sum(), largest + abs(pushed).sum()
            p = p @ A
            for row in np.flatnonzero(used & (rows.stage == k)):
                p = p + weights[row] * _exact(bounds.E[rows.family[row]])
        total, largest = total + p @ state, largest + abs(p) @ abs(state)
        return bool(total > _MARGIN * largest)


def _exact(values: Array) -> Any:
    """The same numbers as decimals, in an array of objects."""
    return np.vectorize(Decimal, otypes=[object])(values)
