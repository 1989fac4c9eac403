"""Closed loops of an optimal control problem, simulated and recorded.

The first input of a new plan acts at every sample:

    u_t = first input of the plan from x_t,      x_{t+1} = f(x_t, u_t, d_t; theta)
    dx_{t+1} = f_x dx_t + f_u du_t + f_theta dtheta,      du_t = U_theta dtheta + U_x dx_t

where U are the exact derivatives of each plan. The controller assumes zero disturbance. A recording
is of a closed loop or of one plan; NaN: not measured.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from impc.arrays import Array, Frozen, as_numbers, finite_array, frozen, with_shape
from impc.errors import DataError, SolverError
from impc.nonlinear.expressions import Stages
from impc.nonlinear.plan import Plan, nearby_plan, solved_plan


@dataclass(frozen=True, eq=False)
class ClosedLoop(Frozen):
    """A simulation of T samples and its derivatives with respect to theta and x_0."""

    x: Array  # (steps + 1, n), states
    u: Array  # (steps, m), inputs
    dx: Array  # (steps + 1, n, p + n), derivative of x
    du: Array  # (steps, m, p + n), derivative of u
    plans: tuple[Plan, ...]  # one per sample


def closed_loop_from(
    first: Plan,
    theta: Array,
    x0: Array,
    d: Array,
    mu: float,
    before: ClosedLoop | None = None,
) -> ClosedLoop:
    """Simulate, each plan from the last one or those `before`; SolverError without a plan."""
    problem, steps, p = first.problem, len(d), len(theta)
    x, u = np.zeros((steps + 1, problem.n)), np.zeros((steps, problem.m))
    dx = np.zeros((steps + 1, problem.n, p + problem.n))
    du = np.zeros((steps, problem.m, p + problem.n))
    x[0], dx[0, :, p:] = x0, np.eye(problem.n)
    plans: list[Plan] = []
    for t in range(steps):
        last = plans[-1] if plans else first
        near = [last] if before is None else [before.plans[t], last]
        found = (nearby_plan(one, theta, x[t], mu) for one in near)
        plan = next((one for one in found if one is not None), None)
        if plan is None:  # start from the last plan, shifted by one sample
            ahead = np.vstack([x[t], last.x[2:], last.x[-1:]])
            later = np.vstack([last.u[1:], last.u[-1:]])
            plan = solved_plan(problem, theta, first.d, ahead, later, "ipopt", mu)
        if plan is None:
            raise SolverError(
                f"sample {t}", "no plan was found from the state reached",
                "soften the constraints, or give other parameters",
            )  # fmt: skip
        u[t] = plan.u[0]
        du[t] = plan.du[0] @ np.vstack([np.eye(p, p + problem.n), dx[t]])
        ahead, slope = (item.full() for item in _slopes(problem)(x[t], u[t], d[t], theta))
        x[t + 1] = ahead.ravel()
        dx[t + 1] = slope @ np.vstack([dx[t], du[t], np.eye(p, p + problem.n)])
        plans.append(plan)
    return ClosedLoop(x, u, dx, du, tuple(plans))


@functools.lru_cache(maxsize=16)
def _slopes(problem: Stages) -> Any:
    """The next state, and its derivative by (x, u, theta)."""
    f = problem.functions[0]
    x, u, d, theta = (ca.SX.sym("s", f.numel_in(index)) for index in range(4))
    following = f(x, u, d, theta)
    slope = ca.jacobian(following, ca.vertcat(x, u, theta))
    return ca.Function("slopes", [x, u, d, theta], [following, slope])


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
    """Checked recording of x (steps + 1, n), u (steps, m), d (steps, d), and x0 (n,)."""
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
