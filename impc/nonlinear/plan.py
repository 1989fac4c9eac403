"""The optimal plan of a problem, by Newton's method on the relaxed conditions.

    grad L = 0,    f(x_k, u_k) = x_{k+1},    h + s = 0,    s lam = mu,    s, lam > 0

A plan near another one (the next theta of a search, the next sample of a closed loop, the next mu)
takes a few steps of Newton's method from it. Where there is none near, or where it does not end, a
solver by name makes the start (`impc.nonlinear.solvers`). Either way the answer is what the same
test of the conditions and of the second order says, so it does not depend on the solver.
docs/nonlinear.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Array, Frozen
from impc.checking import replace
from impc.errors import InfeasibleError, InputError, SolverError
from impc.nonlinear.conditions import (
    Point,
    Residuals,
    conditions,
    residuals,
    solve_conditions,
    system,
    wanted_rows,
)
from impc.nonlinear.solvers import require_solver, start_of, worst_row

if TYPE_CHECKING:
    from impc.nonlinear.conditions import Conditions, System
    from impc.nonlinear.problem import OptimalControlProblem

# Of the conditions, relative to the largest multiplier (gradient) or as they are (dynamics, rows).
# Newton's method ends at 1e-13 to 1e-15 on the four systems of docs/nonlinear.md.
_TOLERANCE = 1e-10
_PRODUCT = 1e-3  # of s lam - mu, relative to mu
_CENTRAL = 1e-2
_STEPS = 40
_SHORTEST = 1e-3  # a second step in a row that is shorter leads nowhere
_TO_BOUNDARY = 0.995
_EXCESS = 1e-6  # of a row, above which a problem without a plan is called infeasible


@dataclass(frozen=True, eq=False)
class Plan(Frozen):
    """A solution of the relaxed conditions, with a positive reduced second derivative."""

    problem: OptimalControlProblem
    theta: Array  # Parameters (p,)
    d: Array  # Disturbances that the plan reckons with (N, d)
    point: Point  # States, inputs, multipliers, slacks
    mu: float  # Product of slack and multiplier of every row
    cost: float  # Without the relaxation
    residual: float  # Largest of the conditions, relative as the test takes them

    @property
    def x(self) -> Array:
        """States (N + 1, n)."""
        return self.point.x

    @property
    def u(self) -> Array:
        """Inputs (N, m)."""
        return self.point.u


def solve_plan(
    problem: OptimalControlProblem,
    theta: Array,
    x0: Array,
    *,
    d: Array | None = None,
    solver: str = "ipopt",
    mu: float = 1e-10,
    guesses: tuple[tuple[Array, Array], ...] = (),
) -> Plan:
    """Solve from nothing.

    `theta` (p,); `x0` (n,); `d` (N, d).
    """
    solver = require_solver(solver)
    if not 1e-12 <= mu <= 1e6:
        raise InputError("mu", f"got {mu:g}", "give 1e-12 to 1e6")
    N = problem.horizon
    held = np.repeat(x0[None], N + 1, axis=0)
    nothing, still = np.zeros_like(held), np.zeros((N, problem.m))
    known = np.zeros((N, problem.disturbance_count)) if d is None else d
    trials = [*guesses, (held, still), (nothing, still)]
    _require_finite_start(problem, theta, known, *trials[0])
    reasons = []
    for x, u in trials:
        found = solved_plan(problem, theta, known, np.vstack([x0, x[1:]]), u, solver, mu)
        if isinstance(found, Plan):
            return found
        reasons.append(found)
    first = np.vstack([x0, trials[0][0][1:]])
    raise _no_plan(problem, theta, known, first, trials[0][1], max(reasons, key=len))


def nearby_plan(
    plan: Plan, theta: Array, x0: Array, mu: float, steps: tuple[Point, ...], solver: str
) -> Plan | None:
    """The plan at other parameters theta (p,), another state x0 (n,) or mu; None if there is none.

    Newton's method begins at the plan, moved by each of `steps` in turn and then as it is; where
    none of these ends, the solver by its name begins at the plan, if there is a name.
    """
    problem, d = plan.problem, plan.d
    for guess in (*(moved(plan.point, step) for step in steps), plan.point):
        begun = replace(guess, x=np.vstack([x0, guess.x[1:]]))
        # From a larger mu where a multiplier must come off: at 1e-10 its slack holds it there.
        for first in dict.fromkeys([plan.mu, max(mu, _CENTRAL)]):
            if isinstance(found := _follow(problem, theta, d, begun, first, mu), Plan):
                return found
    if not solver:
        return None
    found = solved_plan(problem, theta, d, np.vstack([x0, plan.x[1:]]), plan.u, solver, mu)
    return found if isinstance(found, Plan) else None


def solved_plan(
    problem: OptimalControlProblem,
    theta: Array,
    d: Array,
    x: Array,
    u: Array,
    solver: str,
    mu: float,
) -> Plan | str:
    """By a solver from a guess x (N + 1, n), u (N, m); a reason, or nothing, where it ends without.

    At theta (p,) and d (N, d). It is tried at a large mu too: far from every bound the program is
    easier.
    """
    found: Plan | str = ""
    for first in sorted({mu, max(mu, 1e-1)}):
        point = start_of(problem, solver, theta, d, x, u, first)
        if np.all(np.isfinite(point.x)):
            found = _follow(problem, theta, d, point, first, mu)
            if isinstance(found, Plan):
                break
    return found


def _require_finite_start(
    problem: OptimalControlProblem, theta: Array, d: Array, x: Array, u: Array
) -> None:
    """Require that every function is finite along a guess x (N + 1, n), u (N, m).

    At theta (p,) and d (N, d).
    """
    for function in problem.functions:
        for k in range(problem.horizon + 1):
            at_end = k == problem.horizon
            if at_end != (function.name() in ("terminal_cost", "terminal_constraints")):
                continue
            found = function(
                x[k],
                np.zeros(problem.m) if at_end else u[k],
                np.zeros(problem.disturbance_count) if at_end else d[k],
                theta,
            )
            if not np.all(np.isfinite(found.full())):
                raise InputError(
                    function.name(), f"is not finite at sample {k} of the start",
                    "check the expression, the first parameters and the initial state",
                )  # fmt: skip


def _follow(
    problem: OptimalControlProblem, theta: Array, d: Array, point: Point, start: float, mu: float
) -> Plan | str:
    """From a point at one mu to the plan at another, by at most a hundredth at a time."""
    current = min(max(start, mu), max(mu, 1e-1))
    found = _newton(problem, theta, d, _inside(problem, theta, d, point, current), current)
    while isinstance(found, Plan) and current > mu:
        current = max(mu, current * 1e-2)
        found = _newton(problem, theta, d, found.point, current)
    return found


def _inside(
    problem: OptimalControlProblem, theta: Array, d: Array, point: Point, mu: float
) -> Point:
    """The point with slacks and multipliers above zero, of each pair the larger being kept."""
    at = conditions(problem, theta, d, point)
    wanted = wanted_rows(problem)
    lam, s = _pair(point.lam, -at.h, mu)
    lam_end, s_end = _pair(point.lam_end, -at.h_end, mu)
    return replace(
        point, lam=np.where(wanted, lam, 0.0), s=np.where(wanted, s, 1.0), lam_end=lam_end,
        s_end=s_end,
    )  # fmt: skip


def _pair(lam: Array, s: Array, mu: float) -> tuple[Array, Array]:
    held = lam > np.maximum(s, np.sqrt(mu))
    slack = np.maximum(s, np.sqrt(mu))
    lam = np.where(held, np.maximum(lam, np.sqrt(mu)), mu / slack)
    return lam, np.where(held, mu / lam, slack)


@np.errstate(over="ignore", invalid="ignore")  # a step that leads nowhere ends as such
def _newton(
    problem: OptimalControlProblem, theta: Array, d: Array, point: Point, mu: float
) -> Plan | str:
    """Newton's method with steps that keep s and lam positive and make the conditions smaller.

    What is returned where it does not end is the reason, if it is one that can be told.
    """
    at = conditions(problem, theta, d, point)
    left = residuals(problem, point, at, mu)
    error, merit = _errors(point, left, mu)
    short = 0
    for _ in range(_STEPS):
        factors = system(problem, point, at)
        if not np.isfinite(merit) or not np.all(np.isfinite(factors.lu)):
            return ""
        if not factors.regular:
            return _flat(problem, factors, at)
        step = _step(problem, point, at, left, factors)
        length = _longest(point, step)
        for _halved in range(12):
            trial = moved(point, step, length, keep=0.0)
            new_at = conditions(problem, theta, d, trial)
            new_left = residuals(problem, trial, new_at, mu)
            new_error, new_merit = _errors(trial, new_left, mu)
            if new_merit <= (1 - 1e-4 * length) * merit or new_error < _TOLERANCE:
                break
            length /= 2
        else:
            break
        short = short + 1 if length < _SHORTEST else 0
        settled = new_error < _TOLERANCE and new_error > error / 4
        point, at, left, error, merit = trial, new_at, new_left, new_error, new_merit
        if settled or error < 1e-14 or short == 2:
            break
    if error >= _TOLERANCE:
        return ""
    flat = _flat(problem, system(problem, point, at), at)
    return flat or Plan(problem, theta, d, point, mu, at.cost, error)


def _errors(point: Point, left: Residuals, mu: float) -> tuple[float, float]:
    """The largest of the conditions, relative, and the norm that a step must lessen."""
    size = max(1.0, *(float(np.max(np.abs(item), initial=0.0))
                      for item in (point.nu, point.lam, point.lam_end)))  # fmt: skip
    gradient = np.concatenate([left.u.ravel(), left.x.ravel()]) / size
    plain = np.concatenate([left.c.ravel(), left.rows.ravel(), left.rows_end])
    products = np.concatenate([left.products.ravel(), left.products_end])
    largest = [float(np.max(np.abs(item), initial=0.0)) for item in (gradient, plain, products)]
    error = max(largest[0], largest[1], largest[2] / mu * _TOLERANCE / _PRODUCT)
    norms = [float(item @ item) for item in (gradient * size, plain, products)]
    return error, float(np.sqrt(sum(norms)))


def _step(
    problem: OptimalControlProblem, point: Point, at: Conditions, left: Residuals, factors: System
) -> Point:
    sides = Residuals(*(item[..., None] for item in left))
    step = solve_conditions(problem, point, at, factors, sides, np.zeros((problem.n, 1)))
    return Point(*(item[..., 0] for item in vars(step).values()))


def _longest(point: Point, step: Point) -> float:
    """The largest step up to 1 that leaves a share of every slack and multiplier."""
    fall = 0.0
    for value, change in (
        (point.lam, step.lam), (point.s, step.s),
        (point.lam_end, step.lam_end), (point.s_end, step.s_end),
    ):  # fmt: skip
        asked = value > 0  # rows that are not asked for have a multiplier of zero
        fall = max(fall, float(np.max(-change[asked] / value[asked], initial=0.0)))
    return min(1.0, _TO_BOUNDARY / max(fall, 1e-300))


def moved(point: Point, step: Point, share: float = 1.0, keep: float = 0.1) -> Point:
    """The point moved by a `share` of a step, its multipliers and slacks positive.

    They keep at least the share `keep` of what they were: a tenth, for a step that is only a guess.
    """

    def positive(value: Array, change: Array) -> Array:
        return np.maximum(value + share * change, keep * value)

    return Point(
        point.x + share * step.x, point.u + share * step.u, point.nu + share * step.nu,
        positive(point.lam, step.lam), positive(point.s, step.s),
        positive(point.lam_end, step.lam_end), positive(point.s_end, step.s_end),
    )  # fmt: skip


def _flat(problem: OptimalControlProblem, factors: System, at: Conditions) -> str:
    """Where the second derivative along the dynamics is not positive, in words; or nothing.

    It is positive when the Riccati recursion over the stages has positive pivots.
    """
    n, P = problem.n, factors.H_end
    for k in range(problem.horizon - 1, -1, -1):
        F = at.F[k]
        whole = factors.H[k] + F.T @ P @ F
        whole = (whole + whole.T) / 2
        try:
            np.linalg.cholesky(whole[n:, n:])
        except np.linalg.LinAlgError:
            return f"the cost has no minimum in the inputs of sample {k}"
        P = whole[:n, :n] - whole[:n, n:] @ np.linalg.solve(whole[n:, n:], whole[n:, :n])
    return ""


def _no_plan(
    problem: OptimalControlProblem, theta: Array, d: Array, x: Array, u: Array, reason: str
) -> InfeasibleError | SolverError:
    name, sample, excess = worst_row(problem, theta, d, x, u)
    if excess > _EXCESS:
        return InfeasibleError(
            f"constraint {name}", f"no plan was found that keeps it at sample {sample}: the least"
            f" excess is {excess:.3g}", "give other first parameters or another initial state",
        )  # fmt: skip
    return SolverError(
        "plan", reason or "the search for a plan did not end",
        "give every input a price" if reason else "begin nearer, or try another solver",
    )  # fmt: skip
