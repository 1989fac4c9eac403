"""Closed loop of an optimal control problem: the first input of a new plan at every sample.

    u_t = first input of the plan from x_t,      x_{t+1} = f(x_t, u_t, d_t; theta)
    dx_{t+1} = f_x dx_t + f_u du_t + f_theta dtheta,      du_t = U_theta dtheta + U_x dx_t

where U are the exact derivatives of each plan. The controller assumes zero disturbance.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from impc.arrays import Array, Frozen
from impc.errors import SolverError
from impc.nonlinear.plan import Plan, nearby_plan, solved_plan

if TYPE_CHECKING:
    from impc.nonlinear.expressions import Stages


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
    """Simulate, starting each plan near the previous one, or near those of an earlier simulation.

    `theta` (p,); `x0` (n,); `d` (steps, d). Raises SolverError at a sample without a plan.
    """
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
