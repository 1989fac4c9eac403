"""The closed loop of a problem: at every sample its plan's first input is applied.

    u_t = first input of the plan from x_t,      x_{t+1} = f(x_t, u_t, d_t; theta)

    dx_{t+1} = f_x dx_t + f_u du_t + f_theta dtheta,      du_t = U_theta dtheta + U_x dx_t

with U from the exact derivatives of each plan (docs/nonlinear.md). The controller reckons with no
disturbance.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Array, Frozen
from impc.errors import SolverError
from impc.nonlinear.plan import Plan, nearby_plan, solve_plan, solved_plan
from impc.nonlinear.problem import slopes

if TYPE_CHECKING:
    from impc.nonlinear.problem import OptimalControlProblem


@dataclass(frozen=True, eq=False)
class ClosedLoop(Frozen):
    """A simulation of T samples and its derivatives with respect to theta and x_0."""

    x: Array  # States (steps + 1, n)
    u: Array  # Inputs (steps, m)
    dx: Array  # Derivative of x (steps + 1, n, p + n)
    du: Array  # Derivative of u (steps, m, p + n)
    plans: tuple[Plan, ...]  # T of them


def simulate_receding(
    problem: OptimalControlProblem,
    theta: Array,
    x0: Array,
    d: Array,
    *,
    solver: str = "ipopt",
    mu: float = 1e-10,
) -> ClosedLoop:
    """Simulate from nothing, at theta (p,), from x0 (n,), disturbed by d of shape (steps, d).

    `solver` and `mu` are those of `impc.nonlinear.plan.solve_plan`.
    """
    first = solve_plan(problem, theta, x0, solver=solver, mu=mu)
    found = closed_loop_from(first, theta, x0, d, mu)
    if isinstance(found, int):
        raise SolverError(
            f"sample {found}", "no plan was found from the state reached",
            "soften the constraints, or give other parameters",
        )  # fmt: skip
    return found


def closed_loop_from(
    first: Plan,
    theta: Array,
    x0: Array,
    d: Array,
    mu: float,
    before: ClosedLoop | None = None,
) -> ClosedLoop | int:
    """Simulate, beginning at a plan near the first, and near those of a simulation before.

    `theta` (p,); `x0` (n,); `d` (steps, d). The sample where no plan is found instead.
    """
    problem, steps, p = first.problem, len(d), len(theta)
    x, u = np.zeros((steps + 1, problem.n)), np.zeros((steps, problem.m))
    dx = np.zeros((steps + 1, problem.n, p + problem.n))
    du = np.zeros((steps, problem.m, p + problem.n))
    x[0], dx[0, :, p:] = x0, np.eye(problem.n)
    plans: list[Plan] = []
    for t in range(steps):
        near = [] if before is None else [before.plans[t]]
        near += [plans[-1] if plans else first]
        found = (nearby_plan(one, theta, x[t], mu) for one in near)
        plan = next((one for one in found if one is not None), None)
        if plan is None:  # from the last sample's plan, a sample later
            last = plans[-1] if plans else first
            ahead = np.vstack([x[t], last.x[2:], last.x[-1:]])
            later = np.vstack([last.u[1:], last.u[-1:]])
            plan = solved_plan(problem, theta, first.d, ahead, later, "ipopt", mu)
        if plan is None:
            return t
        u[t] = plan.u[0]
        own = np.vstack([np.hstack([np.eye(p), np.zeros((p, problem.n))]), dx[t]])
        du[t] = plan.du[0] @ own
        x[t + 1], f_w, f_theta = slopes(problem, x[t], u[t], d[t], theta)
        dx[t + 1] = f_w @ np.concatenate([dx[t], du[t]])
        dx[t + 1, :, :p] += f_theta
        plans.append(plan)
    return ClosedLoop(x, u, dx, du, tuple(plans))
