"""The closed loop of a problem: at every sample its plan's first input is applied.

    u_t = first input of the plan from x_t,      x_{t+1} = f(x_t, u_t, d_t; theta)

    dx_{t+1} = f_x dx_t + f_u du_t + f_theta dtheta,      du_t = U_theta dtheta + U_x dx_t

with U from the exact derivatives of each plan (docs/nonlinear.md). The controller reckons with no
disturbance.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from impc.arrays import Array, Frozen
from impc.checking import replace
from impc.errors import SolverError
from impc.nonlinear.derivatives import differentiate_plan
from impc.nonlinear.plan import Plan, nearby_plan, solve_plan

if TYPE_CHECKING:
    from impc.nonlinear.derivatives import PlanDerivatives
    from impc.nonlinear.problem import OptimalControlProblem


@dataclass(frozen=True, eq=False)
class ClosedLoop(Frozen):
    """A simulation of T samples and its derivatives with respect to theta and x_0."""

    x: Array  # States (steps + 1, n)
    u: Array  # Inputs (steps, m)
    dx: Array  # Derivative of x (steps + 1, n, p + n)
    du: Array  # Derivative of u (steps, m, p + n)
    plans: tuple[Plan, ...]  # T of them
    # Of each plan, with respect to theta and its own first state
    slopes: tuple[PlanDerivatives, ...]


@functools.lru_cache(maxsize=16)
def _step(problem: OptimalControlProblem) -> Any:
    """f with its derivatives by x, u and theta."""
    f = problem.functions[0]
    kind: Any = ca.SX if f.is_a("SXFunction") else ca.MX
    given = [kind.sym(letter, f.numel_in(index)) for index, letter in enumerate("xudt")]
    following = f(*given)
    slopes = [ca.densify(ca.jacobian(following, given[index])) for index in (0, 1, 3)]
    return ca.Function("step", given, [following, *slopes])


def shifted(plan: Plan) -> Plan:
    """The plan a sample later: the guess for the next sample; its last stage is repeated."""
    point = plan.point

    def later(values: Array) -> Array:
        return np.concatenate([values[1:], values[-1:]])

    lam, s = later(point.lam), later(point.s)
    lam[0], s[0] = np.where(plan.problem.movable, (lam[0], s[0]), ((0.0,), (1.0,)))
    moved = replace(point, x=later(point.x), u=later(point.u), nu=later(point.nu), lam=lam, s=s)
    return replace(plan, point=moved)


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
    found = closed_loop_from(first, theta, x0, d, mu, solver)
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
    solver: str,
    before: ClosedLoop | None = None,
) -> ClosedLoop | int:
    """Simulate, beginning at a plan near the first, and near those of a simulation before.

    `theta` (p,); `x0` (n,); `d` (steps, d).
    """
    problem, steps, p = first.problem, len(d), len(theta)
    x, u = np.zeros((steps + 1, problem.n)), np.zeros((steps, problem.m))
    dx = np.zeros((steps + 1, problem.n, p + problem.n))
    du = np.zeros((steps, problem.m, p + problem.n))
    x[0], dx[0, :, p:] = x0, np.eye(problem.n)
    plans: list[Plan] = []
    slopes: list[PlanDerivatives] = []
    for t in range(steps):
        plan = _next(first, plans, theta, x[t], mu, solver, before)
        if plan is None:
            return t
        slope = differentiate_plan(plan)
        u[t] = plan.u[0]
        own = np.vstack([np.hstack([np.eye(p), np.zeros((p, problem.n))]), dx[t]])
        du[t] = slope.u[0] @ own
        next_x, f_x, f_u, f_theta = (
            item.full() for item in _step(problem)(x[t], u[t], d[t], theta)
        )
        x[t + 1] = next_x.ravel()
        dx[t + 1] = f_x @ dx[t] + f_u @ du[t]
        dx[t + 1, :, :p] += f_theta
        plans.append(plan)
        slopes.append(slope)
    return ClosedLoop(x, u, dx, du, tuple(plans), tuple(slopes))


def _next(
    first: Plan,
    plans: list[Plan],
    theta: Array,
    x: Array,
    mu: float,
    solver: str,
    before: ClosedLoop | None,
) -> Plan | None:
    t = len(plans)
    if before is not None:
        old = before.plans[t]
        change = np.concatenate([theta - old.theta, x - old.x[0]])
        found = nearby_plan(old, theta, x, mu, (before.slopes[t].step(change),), solver)
        if found is not None:
            return found
    return nearby_plan(shifted(plans[-1]) if plans else first, theta, x, mu, (), solver)
