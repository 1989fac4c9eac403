"""Differences of recordings from the plans and closed loops of a problem, and their derivatives.

    r = ((x_sim(theta) - x) / scale, (u_sim(theta) - u) / scale),        dr / dphi

phi the logarithms of positive parameters, the signed ones themselves, and initial states that are
not known, over their scales. A scale is the root mean square of a signal in the recordings.
docs/nonlinear.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Array, BoolArray, IntArray
from impc.errors import SolverError
from impc.nonlinear.closed_loop import ClosedLoop, closed_loop_from
from impc.nonlinear.derivatives import PlanDerivatives, differentiate_plan
from impc.nonlinear.plan import Plan, nearby_plan, solve_plan, solved_plan

if TYPE_CHECKING:
    from impc.nonlinear.problem import OptimalControlProblem
    from impc.nonlinear.recordings import OptimalRecording

#: Share of the squares of recordings above which plans are taken to be of another kind: a cart-pole
#: that does not swing up leaves 0.8 of them, noise of 16 dB leaves 0.025.
EXPLAINED = 0.03
_STILL = 1e-9  # of the largest signal: what is smaller stands still


@dataclass(frozen=True, eq=False)
class Residuals:
    """The recordings, with what is fixed in a search."""

    problem: OptimalControlProblem  # Whose parameters are searched
    recordings: tuple[OptimalRecording, ...]
    solver: str  # One of `impc.nonlinear.solvers.SOLVERS`
    scales: Array  # Of states and inputs (n + m,)
    size: float  # Sum of squares of all that was measured, over the scales

    def unknowns(self, theta: Array) -> Array:
        """Unknowns (k,) at parameters theta (p,)."""
        logarithms = np.where(self.problem.positive, np.log(np.abs(theta)), theta)
        own = [one.x0 / self.scales[: self.problem.n] for one in self.recordings
               if one.unknown_start]  # fmt: skip
        return np.concatenate([logarithms, *own])

    def split(self, unknowns: Array) -> tuple[Array, list[Array]]:
        """Parameters (p,), and the initial state (n,) of each recording, of unknowns (k,)."""
        n, place = self.problem.n, len(self.problem.parameter_names)
        theta = np.where(self.problem.positive, np.exp(unknowns[:place]), unknowns[:place])
        starts = []
        for one in self.recordings:
            if one.unknown_start:
                starts.append(unknowns[place : place + n] * self.scales[:n])
                place += n
            else:
                starts.append(one.x0)
        return theta, starts

    def signals(self) -> IntArray:
        """Of each residual the column of its state or input (r,)."""
        found = []
        for one in self.recordings:
            kept, first = _measured(one)
            found += [np.flatnonzero(first), np.nonzero(kept)[1]]
        return np.concatenate(found)


@dataclass(frozen=True, eq=False)
class Evaluation:
    """The residual somewhere."""

    unknowns: Array  # (k,)
    theta: Array  # Parameters (p,)
    mu: float  # Of the relaxed conditions
    residual: Array  # (r,)
    jacobian: Array  # (r, k)
    # Of each recording its `ClosedLoop`, or its `Plan` with the derivatives
    runs: tuple[tuple[Plan, PlanDerivatives] | ClosedLoop, ...]

    @property
    def loss(self) -> float:
        """Sum of squares of the residual."""
        return float(self.residual @ self.residual)

    def trajectories(self) -> tuple[tuple[Array, Array], ...]:
        """Of each recording the states (steps + 1, n) and the inputs (steps, m)."""
        return tuple(_trajectories(run)[:2] for run in self.runs)


def residuals_of(
    problem: OptimalControlProblem,
    recordings: tuple[OptimalRecording, ...],
    solver: str,
    scales: Array | None = None,
) -> Residuals:
    """Recordings, the `solver` of their plans, and scales (n + m,), made if they are not given."""
    if scales is None:
        x = np.concatenate([one.x for one in recordings])
        u = np.concatenate([one.u for one in recordings])
        sizes = np.array([_root_mean_square(column) for column in (*x.T, *u.T)])
        # A signal that stands still has no size of its own: it is measured by the largest.
        largest = float(np.max(sizes, initial=0.0)) or 1.0
        scales = np.where(sizes > _STILL * largest, sizes, largest)
    size = sum(
        float(np.nansum((np.hstack([one.x[1:], one.u]) / scales) ** 2)) for one in recordings
    )
    return Residuals(problem, recordings, solver, scales, size)


def begin(given: Residuals, unknowns: Array, mu: float) -> Evaluation:
    """Solve every recording from what was recorded, at unknowns (k,) and mu."""
    theta, starts = given.split(unknowns)
    runs: list[tuple[Plan, PlanDerivatives] | ClosedLoop] = []
    for one, x0 in zip(given.recordings, starts, strict=True):
        plan = first_plan(one, theta, x0, mu, given.solver)
        if not one.closed_loop:
            runs.append((plan, differentiate_plan(plan)))
            continue
        loop = closed_loop_from(plan, theta, x0, one.d, mu, given.solver)
        if isinstance(loop, int):
            raise SolverError(
                f"sample {loop}", "no plan was found in the closed loop", "begin nearer"
            )
        runs.append(loop)
    return assembled(given, unknowns, theta, mu, tuple(runs))


def first_plan(one: OptimalRecording, theta: Array, x0: Array, mu: float, solver: str) -> Plan:
    """The plan from a recording's initial state x0 (n,) at theta (p,) and mu, by a `solver`."""
    problem = one.problem
    whole = bool(np.all(np.isfinite(one.x)) and np.all(np.isfinite(one.u)))
    guesses = ((one.x, one.u),) if whole and not one.closed_loop else ()
    d = np.zeros((problem.horizon, problem.disturbance_count)) if one.closed_loop else one.d
    return solve_plan(problem, theta, x0, d=d, solver=solver, mu=mu, guesses=guesses)


def evaluate(given: Residuals, unknowns: Array, mu: float, before: Evaluation) -> Evaluation | None:
    """Solve every recording at unknowns (k,) and mu near a solution; None where one has none."""
    theta, starts = given.split(unknowns)
    lost = before.loss > EXPLAINED * given.size
    runs: list[tuple[Plan, PlanDerivatives] | ClosedLoop] = []
    for one, old, x0 in zip(given.recordings, before.runs, starts, strict=True):
        if isinstance(old, ClosedLoop):
            loop = closed_loop_from(old.plans[0], theta, x0, one.d, mu, given.solver, old)
            if isinstance(loop, int):
                return None
            runs.append(loop)
            continue
        near = _near(old, theta, x0, mu, given.solver, lost)
        if near is None:
            return None
        runs.append((near, differentiate_plan(near)))
    return assembled(given, unknowns, theta, mu, tuple(runs))


def _near(
    old: tuple[Plan, PlanDerivatives], theta: Array, x0: Array, mu: float, solver: str, lost: bool
) -> Plan | None:
    """The plan of a step.

    Where plans of this kind explain the recording, a step too long for Newton's method is one to
    be shortened: a solver from outside takes forty times as long. Where they do not, it may find
    the kind that was recorded.
    """
    plan, slope = old
    change = np.concatenate([theta - plan.theta, x0 - plan.x[0]])
    if not np.any(change):
        return nearby_plan(plan, theta, x0, mu, (), solver)
    near = nearby_plan(plan, theta, x0, mu, (slope.step(change),), "")
    if near is None and lost:
        guess = np.vstack([x0, plan.x[1:]])
        found = solved_plan(plan.problem, theta, plan.d, guess, plan.u, solver, mu)
        return found if isinstance(found, Plan) else None
    return near


def assembled(
    given: Residuals,
    unknowns: Array,
    theta: Array,
    mu: float,
    runs: tuple[tuple[Plan, PlanDerivatives] | ClosedLoop, ...],
) -> Evaluation:
    """Residual and derivative of solved recordings, at unknowns (k,), theta (p,) and mu."""
    n, p, place = given.problem.n, len(theta), len(theta)
    chain = np.where(given.problem.positive, theta, 1.0)
    parts, slopes = [], []
    for one, run in zip(given.recordings, runs, strict=True):
        x, u, dx, du = _trajectories(run)
        kept, first = _measured(one)
        scaled = np.hstack([x[1:] - one.x[1:], u - one.u]) / given.scales
        slope = np.concatenate([dx[1:], du], axis=1) / given.scales[:, None]
        parts += [((x[0] - one.x[0]) / given.scales[:n])[first], scaled[kept]]
        rows = np.concatenate([(dx[0] / given.scales[:n, None])[first], slope[kept]])
        whole = np.zeros((len(rows), len(unknowns)))
        whole[:, :p] = rows[:, :p] * chain
        if one.unknown_start:
            whole[:, place : place + n] = rows[:, p:] * given.scales[:n]
            place += n
        slopes.append(whole)
    return Evaluation(unknowns, theta, mu, np.concatenate(parts), np.concatenate(slopes), runs)


def _measured(one: OptimalRecording) -> tuple[BoolArray, BoolArray]:
    """Which entries behind the first sample count, and which of the initial state."""
    return np.isfinite(np.hstack([one.x[1:], one.u])), np.isfinite(one.x[0]) & one.unknown_start


def _trajectories(
    run: tuple[Plan, PlanDerivatives] | ClosedLoop,
) -> tuple[Array, Array, Array, Array]:
    """x (steps + 1, n), u (steps, m) and their derivatives by theta and x_0."""
    if isinstance(run, ClosedLoop):
        return run.x, run.u, run.dx, run.du
    return run[0].x, run[0].u, run[1].x, run[1].u


def _root_mean_square(column: Array) -> float:
    known = column[np.isfinite(column)]
    return float(np.sqrt(np.mean(known**2))) if len(known) else 0.0
