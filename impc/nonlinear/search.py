"""Residuals of recordings from plans and closed loops, and their least squares.

    r = ((x_sim(theta) - x) / scale, (u_sim(theta) - u) / scale),        dr / dphi

where phi are the logarithms of positive parameters, the values of signed ones, and the initial
state of every recording over its scale; scales are root mean squares of the recorded signals. The
search uses a decreasing sequence of mu (docs/howto/nonlinear.md). `guided` treats every recorded
state of a closed loop as the start of a plan whose first input and next state were recorded: such
plans stay near the recording even if theta is wrong.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from impc.arrays import Array, BoolArray, IntArray, frozen
from impc.checking import replace
from impc.errors import SolverError
from impc.nonlinear.closed_loop import ClosedLoop, OptimalRecording, closed_loop_from
from impc.nonlinear.plan import Plan, nearby_plan, solve_plan, solved_plan
from impc.nonlinear.problem import OptimalControlProblem

#: Unexplained share of squares above which the plans may be of another kind: a cart-pole that does
#: not swing up leaves 0.8, noise of 16 dB leaves 0.025.
EXPLAINED = 0.03
_LONGEST_STEP = 0.7  # in a logarithm, a factor of two
_SMALL_STEP = 1e-9
_LEAST_DAMPING, _MOST_DAMPING = 1e-14, 1e6
_STILL = 1e-9  # share of the largest signal below which a signal counts as constant zero


@dataclass(frozen=True, eq=False)
class Residuals:
    """Recordings and what is fixed in a search."""

    problem: OptimalControlProblem  # whose parameters are estimated
    recordings: tuple[OptimalRecording, ...]
    solver: str  # one of `impc.nonlinear.plan.SOLVERS`
    scales: Array  # (n + m,), of states and inputs

    @property
    def size(self) -> float:
        """Sum of squares of all measured values over their scales."""
        recorded = np.vstack([np.hstack([one.x[1:], one.u]) for one in self.recordings])
        return float(np.nansum((recorded / self.scales) ** 2))

    def free(self, sampled: bool = True) -> BoolArray:
        """Mask (k,) of the estimated unknowns; not `sampled`: without recorded initial states."""
        states = [one.unknown_start and (sampled or not np.array_equal(one.x0, one.x[0]))
                  for one in self.recordings]  # fmt: skip
        return np.append(np.ones_like(self.problem.positive), np.repeat(states, self.problem.n))

    def unknowns(self, theta: Array) -> Array:
        """Unknowns (k,) at parameters theta (p,)."""
        logarithms = np.where(self.problem.positive, np.log(np.abs(theta)), theta)
        own = [one.x0 / self.scales[: self.problem.n] for one in self.recordings]
        return np.concatenate([logarithms, *own])

    def split(self, unknowns: Array) -> tuple[Array, Array]:
        """Parameters (p,) and initial states (recordings, n) of unknowns (k,)."""
        n, p = self.problem.n, len(self.problem.parameter_names)
        theta = np.where(self.problem.positive, np.exp(unknowns[:p]), unknowns[:p])
        return theta, unknowns[p:].reshape(-1, n) * self.scales[:n]

    def signals(self) -> IntArray:
        """Column of the state or input of each residual (r,)."""
        pairs = [_measured(one) for one in self.recordings]
        parts = [(np.flatnonzero(first), np.nonzero(kept)[1]) for kept, first in pairs]
        return np.concatenate([item for pair in parts for item in pair])


def scales_of(recordings: Sequence[OptimalRecording]) -> Array:
    """Root mean square of each state and input in the recordings (n + m,)."""
    columns = [column[np.isfinite(column)] for kind in ("x", "u")
               for column in np.vstack([getattr(one, kind) for one in recordings]).T]  # fmt: skip
    sizes = np.array([np.sqrt(np.mean(one**2)) if len(one) else 0.0 for one in columns])
    # A signal that does not move is scaled by the largest one.
    largest = float(np.max(sizes)) or 1.0
    return np.where(sizes > _STILL * largest, sizes, largest)


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Residual and derivative at one point."""

    unknowns: Array  # (k,)
    mu: float  # of the relaxed conditions
    residual: Array  # (r,)
    jacobian: Array  # (r, k)
    runs: tuple[Plan | ClosedLoop, ...]  # one per recording

    @property
    def loss(self) -> float:
        """Sum of squares of the residual."""
        return float(self.residual @ self.residual)


def begin(given: Residuals, unknowns: Array, mu: float) -> Evaluation:
    """Solve every recording, starting from the recorded signals, at unknowns (k,) and mu."""
    theta, starts = given.split(unknowns)
    runs: list[Plan | ClosedLoop] = []
    for one, x0 in zip(given.recordings, starts, strict=True):
        whole = not one.closed_loop and np.all(np.isfinite(one.x)) and np.all(np.isfinite(one.u))
        plan = solve_plan(
            one.problem, theta, x0, d=None if one.closed_loop else one.d, solver=given.solver,
            mu=mu, guess=(one.x, one.u) if whole else None,
        )  # fmt: skip
        runs.append(closed_loop_from(plan, theta, x0, one.d, mu) if one.closed_loop else plan)
    return _assembled(given, unknowns, mu, tuple(runs))


def _evaluate(
    given: Residuals, unknowns: Array, mu: float, before: Evaluation
) -> Evaluation | None:
    """Solve every recording at unknowns (k,) and mu near a solution; None if one fails."""
    theta, starts = given.split(unknowns)
    runs: list[Plan | ClosedLoop | None] = []
    for one, old, x0 in zip(given.recordings, before.runs, starts, strict=True):
        if isinstance(old, ClosedLoop):
            try:
                runs.append(closed_loop_from(old.plans[0], theta, x0, one.d, mu, old))
            except SolverError:
                return None
            continue
        run = nearby_plan(old, theta, x0, mu)
        if run is None and before.loss > EXPLAINED * given.size:
            # Plans of this kind do not explain the recording; solve anew.
            guess = np.vstack([x0, old.x[1:]])
            run = solved_plan(old.problem, theta, old.d, guess, old.u, given.solver, mu)
        runs.append(run)
    found = tuple(run for run in runs if run is not None)
    return _assembled(given, unknowns, mu, found) if len(found) == len(runs) else None


def _assembled(
    given: Residuals, unknowns: Array, mu: float, runs: tuple[Plan | ClosedLoop, ...]
) -> Evaluation:
    """Residual and derivative of solved recordings, at unknowns (k,) and mu."""
    n, p, (theta, _) = given.problem.n, len(given.problem.positive), given.split(unknowns)
    chain = np.where(given.problem.positive, theta, 1.0)
    parts, slopes = [], []
    for index, (one, run) in enumerate(zip(given.recordings, runs, strict=True)):
        kept, first = _measured(one)
        scaled = np.hstack([run.x[1:] - one.x[1:], run.u - one.u]) / given.scales
        slope = np.concatenate([run.dx[1:], run.du], axis=1) / given.scales[:, None]
        parts += [((run.x[0] - one.x[0]) / given.scales[:n])[first], scaled[kept]]
        rows = np.concatenate([(run.dx[0] / given.scales[:n, None])[first], slope[kept]])
        whole, place = np.zeros((len(rows), len(unknowns))), p + index * n
        whole[:, :p] = rows[:, :p] * chain
        whole[:, place : place + n] = rows[:, p:] * given.scales[:n]
        slopes.append(whole)
    return Evaluation(unknowns, mu, np.concatenate(parts), np.concatenate(slopes), runs)


def _measured(one: OptimalRecording) -> tuple[BoolArray, BoolArray]:
    """Masks of the measured entries after the first sample, and of the initial state."""
    return np.isfinite(np.hstack([one.x[1:], one.u])), np.isfinite(one.x[0]) & one.unknown_start


@dataclass
class Budget:
    """Evaluations left for one start, and number of all evaluations."""

    left: int = 0
    done: int = 0

    def take(self) -> bool:
        """Count one evaluation, if one is left."""
        some = self.left > 0
        self.left, self.done = self.left - some, self.done + some
        return some


def along_mu(
    given: Residuals,
    current: Evaluation,
    mu_steps: Sequence[float],
    free: BoolArray,
    budget: Budget,
) -> tuple[Evaluation, bool]:
    """Search the `free` unknowns (k,) along falling mu; whether the last search converged."""
    settled = True
    for mu in mu_steps:
        if mu != current.mu:
            there = _evaluate(given, current.unknowns, mu, current) if budget.take() else None
            if there is None:
                return current, False
            current = there
        current, settled = _levenberg(given, current, mu == mu_steps[-1], free, budget)
    return current, settled


def _levenberg(
    given: Residuals, current: Evaluation, last: bool, free: BoolArray, budget: Budget
) -> tuple[Evaluation, bool]:
    """Levenberg-Marquardt steps until the loss no longer falls; before the last mu, roughly.

    Damping keeps the unidentified directions unchanged. scipy's trust region moved along them and
    gave wrong combinations in two fits: rocket (S = .3), quadrotor (S = .1).
    """
    damping, patience, enough = (1e-3, 60, 1e-13) if last else (1e-2, 12, 1e-2)
    for _ in range(patience):
        left, values, right = np.linalg.svd(current.jacobian[:, free], full_matrices=False)
        drive = left.T @ current.residual
        while True:
            gain, step = values / (values**2 + damping * values[0] ** 2), np.zeros(len(free))
            step[free] = -right.T @ (gain * drive)
            step *= min(1.0, _LONGEST_STEP / max(float(np.max(np.abs(step))), 1e-300))
            if current.loss == 0 or np.max(np.abs(step)) < _SMALL_STEP:
                return current, True
            if not budget.take():
                return current, False
            expected = current.residual + current.jacobian @ step
            predicted = current.loss - float(expected @ expected)
            tried = _evaluate(given, current.unknowns + step, current.mu, current)
            ratio = -1.0 if tried is None else (current.loss - tried.loss) / max(predicted, 1e-300)
            if tried is not None and ratio > 1e-4:
                break
            damping *= 8
            if damping > _MOST_DAMPING or predicted < 1e-14 * current.loss:
                return current, True
        damping = max(damping / 10 if ratio > 0.5 else damping * 2, _LEAST_DAMPING)
        fell = (current.loss - tried.loss) / current.loss
        current = tried
        if fell < enough or current.loss < 1e-28 * len(current.residual):
            return current, True
    return current, not last


def guided(
    given: Residuals, theta: Array, mu_steps: Sequence[float], budget: Budget
) -> Array | None:
    """Parameters (p,) by a plan from each recorded state; None if no plan or input is there."""
    if not any(one.closed_loop and np.any(np.isfinite(one.u)) for one in given.recordings):
        return None
    problem, parts, runs = given.problem, [], []
    for one in given.recordings:
        old: Plan | None = None
        for part in _first_steps(one) if one.closed_loop else [replace(one, unknown_start=False)]:
            found = None if old is None else nearby_plan(old, theta, part.x0, mu_steps[0])
            if found is None:
                x, u = np.repeat(part.x0[None], problem.horizon + 1, axis=0), np.zeros_like(part.u)
                found = solved_plan(problem, theta, part.d, x, u, given.solver, mu_steps[0])
            if found is not None:
                parts.append(part)
                runs.append(found)
                old = found
    if not parts:
        return None
    own = replace(given, recordings=tuple(parts))
    first = _assembled(own, own.unknowns(theta), mu_steps[0], tuple(runs))
    return own.split(along_mu(own, first, mu_steps, own.free(), budget)[0].unknowns)[0]


def _first_steps(one: OptimalRecording) -> list[OptimalRecording]:
    """First steps of plans from every completely measured state of a closed loop."""
    found, N, (steps, m) = [], one.problem.horizon, one.u.shape
    for t in range(steps):
        if not np.all(np.isfinite(one.x[t])) or not np.any(np.isfinite(one.u[t])):
            continue
        x, u = np.full((N + 1, one.problem.n), np.nan), np.full((N, m), np.nan)
        x[0], u[0] = one.x[t], one.u[t]
        if not np.any(one.d[t]):  # the controller's prediction was exact
            x[1] = one.x[t + 1]
        found.append(replace(
            one, x=frozen(x), u=frozen(u), d=np.zeros((N, one.d.shape[1])), x0=frozen(one.x[t]),
            closed_loop=False, unknown_start=False,
        ))  # fmt: skip
    return found
