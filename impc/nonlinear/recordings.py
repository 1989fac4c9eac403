"""Recordings of an optimal control problem, of one plan or a closed loop; NaN: not measured."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from impc.arrays import Array, Frozen, as_numbers, finite_array, frozen, with_shape
from impc.errors import DataError

if TYPE_CHECKING:
    from impc.nonlinear.expressions import Stages


@dataclass(frozen=True, eq=False)
class OptimalRecording(Frozen):
    """States and inputs over T samples; NaN where they are not measured."""

    problem: Stages
    x: Array  # (steps + 1, n), states
    u: Array  # (steps, m), inputs
    d: Array  # (steps, d), disturbances
    x0: Array  # (n,), initial state, or a guess if it is unknown
    closed_loop: bool  # whether every input is the first of its own plan
    unknown_start: bool  # whether the initial state is estimated


def optimal_recording(
    problem: Stages,
    x: Any,
    u: Any,
    d: Any,
    x0: Any,
    unknown_start: bool | None,
    *,
    closed_loop: bool,
) -> OptimalRecording:
    """Make a checked recording.

    `x` (steps + 1, n); `u` (steps, m); `d` (steps, d); `x0` (n,).
    """
    states = _table("states", x, None, problem.n)
    T = len(states) - 1
    if T < 1 or (not closed_loop and problem.horizon != T):
        wanted = "at least 2" if closed_loop else str(problem.horizon + 1)
        raise DataError("states", f"has {T + 1} samples", f"give {wanted}")
    inputs = _table("inputs", np.full((T, problem.m), np.nan) if u is None else u, T, problem.m)
    shape = (T, problem.disturbance_count)
    known = finite_array("disturbances", np.zeros(shape) if d is None else d, shape)
    start = finite_array("x0", states[0] if x0 is None else x0, (problem.n,))
    if not np.any(np.isfinite(states[1:])) and not np.any(np.isfinite(inputs)):
        raise DataError("recording", "has missing values only", "give states or inputs")
    return OptimalRecording(
        problem, frozen(states), frozen(inputs), frozen(known), frozen(start), closed_loop,
        x0 is None if unknown_start is None else unknown_start,
    )  # fmt: skip


def _table(name: str, values: Any, samples: int | None, columns: int) -> Array:
    table = as_numbers(name, values)
    table = with_shape(name, table[:, None] if table.ndim == columns == 1 else table,
                       (samples, columns))  # fmt: skip
    if np.any(np.isinf(table)):
        raise DataError(name, "has infinite entries", "use NaN for missing values")
    return table
