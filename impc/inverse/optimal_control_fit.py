"""Nonlinear inverse MPC: the parameters of an optimal control problem behind its recordings.

    minimise over theta    sum ((x_sim(theta) - x) / scale)^2 + ((u_sim(theta) - u) / scale)^2

by Levenberg and Marquardt's method with exact derivatives, positive parameters in their logarithms.
The plans are those of the relaxed conditions s lam = mu, with mu falling in steps: at 1e-1 a
constraint is felt from afar, also one that the first parameters never reach, and the derivative is
smooth over changes of the active rows; at 1e-10 it is the problem itself. docs/nonlinear.md.
"""

from __future__ import annotations

import itertools
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.stats

from impc.arrays import Array, BoolArray, Frozen, IntArray
from impc.control.nlp_solvers import require_solver
from impc.control.plan import Plan, nearby_plan, solve_plan, solved_plan
from impc.control.plan_derivatives import differentiate_plan
from impc.control.receding_horizon import ClosedLoop, closed_loop_from
from impc.errors import DataError, InputError, SolverError
from impc.inverse.told_combinations import Combinations, combinations

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from impc.control.optimal_control import OptimalControlProblem
    from impc.control.optimal_recordings import OptimalRecording
    from impc.control.plan_derivatives import PlanDerivatives

    _Run = tuple[Plan, PlanDerivatives] | ClosedLoop

__all__ = ["MU_STEPS", "OptimalControlEstimate", "fit_optimal_control"]

#: The falling sequence of mu, of the dimension of the cost.
MU_STEPS = (1e-1, 1e-2, 1e-4, 1e-10)
_LONGEST_STEP = 0.7  # in a logarithm: a factor of two
_STILL = 1e-9
_EXPLAINED = 0.01  # of the squares of a recording; a plan of another kind leaves far more
_SMALL_STEP = 1e-9
_LEAST_DAMPING, _MOST_DAMPING = 1e-14, 1e6


@dataclass(frozen=True, eq=False)
class _Evaluation:
    """Residuals (r,) and their derivative (r, k) at unknowns (k,), and what they came from."""

    unknowns: Array
    theta: Array
    mu: float
    residual: Array
    jacobian: Array
    runs: tuple[_Run, ...]

    @property
    def loss(self) -> float:
        return float(self.residual @ self.residual)


@dataclass(frozen=True, eq=False)
class OptimalControlEstimate(Frozen):
    """What was found, and which part of it the recordings tell.

    Attributes
    ----------
    problem : OptimalControlProblem
    recordings : tuple of OptimalRecording
    theta : dict
        Values by name.
    loss : float
        Sum of squares of all that was measured, in its units.
    residual : Array
        Differences over their scales (r,).
    jacobian : Array
        Its derivative (r, k) by logarithms of positive parameters, by signed ones, and by unknown
        initial states over their scales.
    signals : IntArray
        Of each residual the index of its state, or n and the index of its input (r,).
    scales : Array
        Root-mean-square of each state and input in the recordings (n + m,).
    singular_values : Array
        Of the part of the Jacobian that belongs to the parameters (p,), initial states projected
        out.
    combinations : Combinations
        What is told and what is not.
    x0 : tuple of Array
        Initial state of each recording (n,).
    runs : tuple
        States (T + 1, n) and inputs (T, m) of each recording as the estimate has them.
    settled : bool
        Whether the search ended by itself.
    evaluations : int
        How often all recordings were solved and differentiated.
    seconds : float
        Of the search, s.
    """

    problem: OptimalControlProblem
    recordings: tuple[OptimalRecording, ...]
    theta: dict[str, float]
    loss: float
    residual: Array
    jacobian: Array
    signals: IntArray
    scales: Array
    singular_values: Array
    combinations: Combinations
    x0: tuple[Array, ...]
    runs: tuple[tuple[Array, Array], ...]
    settled: bool
    evaluations: int
    seconds: float

    def intervals(self, level: float = 0.95) -> dict[str, tuple[float, float]]:
        """Low and high end of each parameter by its name, from the noise that is left.

        Normal in the logarithms of positive parameters; the noise of each signal is the root mean
        square of what is left of it. A parameter that is part of an untold combination has an
        infinite interval.

        Raises
        ------
        InputError
            When the level is not between 0 and 1.
        """
        if not 0 < level < 1:
            raise InputError("level", f"got {level:g}", "give one between 0 and 1")
        reach = float(scipy.stats.norm.ppf(0.5 + level / 2)) * self.combinations.deviations
        found = {}
        for index, (name, value) in enumerate(self.theta.items()):
            if self.problem.positive[index]:
                with np.errstate(over="ignore"):
                    factor = float(np.exp(reach[index]))
                found[name] = (value / factor, value * factor)
            else:
                found[name] = (value - float(reach[index]), value + float(reach[index]))
        return found


class _Search:
    """The recordings with their scales, and a count of evaluations."""

    def __init__(
        self,
        problem: OptimalControlProblem,
        recordings: tuple[OptimalRecording, ...],
        solver: str,
    ) -> None:
        self.problem, self.recordings, self.solver = problem, recordings, solver
        self.evaluations = 0
        x = np.concatenate([one.x for one in recordings])
        u = np.concatenate([one.u for one in recordings])
        sizes = np.array([_root_mean_square(column) for column in (*x.T, *u.T)])
        # A signal that stands still has no size of its own: it is measured by the largest.
        largest = float(np.max(sizes, initial=0.0)) or 1.0
        self.scales = np.where(sizes > _STILL * largest, sizes, largest)
        #: Sum of squares of all that was measured, over the scales.
        self.size = sum(float(np.nansum((np.hstack([one.x[1:], one.u]) / self.scales) ** 2))
                        for one in recordings)  # fmt: skip

    def unknowns(self, theta: Array) -> Array:
        logarithms = np.where(self.problem.positive, np.log(np.abs(theta)), theta)
        starts = [one.x0 / self.scales[: self.problem.n] for one in self.recordings
                  if one.unknown_start]  # fmt: skip
        return np.concatenate([logarithms, *starts])

    def parameters(self, unknowns: Array) -> Array:
        part = unknowns[: len(self.problem.parameter_names)]
        return np.where(self.problem.positive, np.exp(part), part)

    def begin(self, unknowns: Array, mu: float, branch: int) -> _Evaluation | None:
        """Solve every recording from a guess of its own.

        Branch 0 begins at what was recorded, 1 at the initial state held, 2 at zeros: a problem
        that is not convex has several plans, and only one of them was recorded.
        """
        theta, starts = self.split(unknowns)
        runs: list[_Run] = []
        for one, x0 in zip(self.recordings, starts, strict=True):
            plan = self._first_plan(one, theta, x0, mu, branch)
            if plan is None:
                return None
            if not one.closed_loop:
                runs.append((plan, differentiate_plan(plan)))
                continue
            loop = closed_loop_from(plan, theta, x0, one.d, mu, self.solver)
            if isinstance(loop, int):
                if branch:
                    return None
                raise SolverError(
                    f"sample {loop}", "no plan was found at the first parameters", "begin nearer"
                )
            runs.append(loop)
        return self._assembled(unknowns, theta, mu, tuple(runs))

    def _first_plan(
        self, one: OptimalRecording, theta: Array, x0: Array, mu: float, branch: int
    ) -> Plan | None:
        problem, N = self.problem, self.problem.horizon
        d = np.zeros((N, problem.disturbance_count)) if one.closed_loop else np.array(one.d)
        held, still = np.repeat(x0[None], N + 1, axis=0), np.zeros((N, problem.m))
        if branch == 0:
            known = bool(np.all(np.isfinite(one.x)) and np.all(np.isfinite(one.u)))
            guess = known and not one.closed_loop
            guesses = ((np.array(one.x), np.array(one.u)),) if guess else ()
            return solve_plan(problem, theta, x0, d=d, solver=self.solver, mu=mu, guesses=guesses)
        x = held if branch == 1 else np.vstack([x0, np.zeros((N, problem.n))])
        found = solved_plan(problem, theta, d, x, still, self.solver, mu)
        return found if isinstance(found, Plan) else None

    def evaluate(self, unknowns: Array, mu: float, before: _Evaluation) -> _Evaluation | None:
        """Solve every recording near a solution; None where one has none near by."""
        theta, starts = self.split(unknowns)
        runs: list[_Run] = []
        for one, old, x0 in zip(self.recordings, before.runs, starts, strict=True):
            if isinstance(old, ClosedLoop):
                loop = closed_loop_from(old.plans[0], theta, x0, one.d, mu, self.solver, old)
                if isinstance(loop, int):
                    return None
                runs.append(loop)
                continue
            change = np.concatenate([theta - old[0].theta, x0 - old[0].x[0]])
            # Where plans of this kind explain the recording, a step too long for Newton's method is
            # one to be shortened: a solver from outside takes forty times as long. Where they do
            # not, it may find the kind that was recorded.
            far = bool(np.any(change))
            lost = before.loss > _EXPLAINED * self.size
            steps = (old[1].step(change),) if far else ()
            near = nearby_plan(old[0], theta, x0, mu, steps, "" if far else self.solver)
            if near is None and far and lost:
                kind = solved_plan(self.problem, theta, old[0].d, np.vstack([x0, old[0].x[1:]]),
                                   old[0].u, self.solver, mu)  # fmt: skip
                near = kind if isinstance(kind, Plan) else None
            if near is None:
                return None
            runs.append((near, differentiate_plan(near)))
        return self._assembled(unknowns, theta, mu, tuple(runs))

    def split(self, unknowns: Array) -> tuple[Array, list[Array]]:
        """Parameters, and the initial state of each recording."""
        place, starts = len(self.problem.parameter_names), []
        for one in self.recordings:
            if one.unknown_start:
                part = unknowns[place : place + self.problem.n]
                starts.append(part * self.scales[: self.problem.n])
                place += self.problem.n
            else:
                starts.append(one.x0)
        return self.parameters(unknowns), starts

    def _assembled(
        self, unknowns: Array, theta: Array, mu: float, runs: tuple[_Run, ...]
    ) -> _Evaluation:
        """Residuals and their derivatives."""
        self.evaluations += 1
        n, place = self.problem.n, len(theta)
        chain = np.where(self.problem.positive, theta, 1.0)
        parts, slopes = [], []
        for one, run in zip(self.recordings, runs, strict=True):
            x, u, dx, du = _trajectories(run)
            kept, first = _measured(one)
            scaled = np.hstack([x[1:] - one.x[1:], u - one.u]) / self.scales
            slope = np.concatenate([dx[1:], du], axis=1) / self.scales[:, None]
            parts += [((x[0] - one.x[0]) / self.scales[:n])[first], scaled[kept]]
            rows = np.concatenate([(dx[0] / self.scales[:n, None])[first], slope[kept]])
            whole = np.zeros((len(rows), len(unknowns)))
            whole[:, : len(theta)] = rows[:, : len(theta)] * chain
            if one.unknown_start:
                whole[:, place : place + n] = rows[:, len(theta) :] * self.scales[:n]
                place += n
            slopes.append(whole)
        return _Evaluation(unknowns, theta, mu, np.concatenate(parts), np.concatenate(slopes), runs)

    def signals(self) -> IntArray:
        """Of each residual the column of its state or input."""
        found = []
        for one in self.recordings:
            kept, first = _measured(one)
            found += [np.flatnonzero(first), np.nonzero(kept)[1]]
        return np.concatenate(found)


def _measured(one: OptimalRecording) -> tuple[BoolArray, BoolArray]:
    """Which entries behind the first sample count, and which of the initial state."""
    return np.isfinite(np.hstack([one.x[1:], one.u])), np.isfinite(one.x[0]) & one.unknown_start


def fit_optimal_control(
    problem: OptimalControlProblem,
    recordings: Sequence[OptimalRecording],
    start: Mapping[str, float],
    *,
    solver: str = "ipopt",
    mu_steps: Sequence[float] = MU_STEPS,
    evaluations: int = 200,
) -> OptimalControlEstimate:
    """Search the parameters from a start.

    Parameters
    ----------
    problem : OptimalControlProblem
    recordings : sequence of OptimalRecording
        Of `problem.recorded_plan` and `problem.recorded_loop`.
    start : dict
        First value of each parameter by its name.
    solver : str
        One of `impc.control.nlp_solvers.SOLVERS`.
    mu_steps : sequence of float
        Falling.
    evaluations : int
        After how many the search is stopped.

    Returns
    -------
    OptimalControlEstimate
        Its `settled` says whether the search ended by itself.

    Raises
    ------
    DataError
        When there are no recordings.
    InputError
        When a start is not usable, or a parameter moves nothing that was measured at any mu.
    InfeasibleError, SolverError
        When there is no plan at the start.

    Examples
    --------
    A point with drag, pushed to the origin; drag and price are not known.

    >>> import casadi as ca
    >>> import impc
    >>> x, u, drag, price = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("drag"), ca.SX.sym("w")
    >>> problem = impc.OptimalControlProblem(
    ...     x, u, {"drag": drag, "price": price},
    ...     next_state=x + 0.1 * ca.vertcat(x[1], u - drag * x[1] ** 3),
    ...     stage_cost=price * x[0] ** 2 + u**2,
    ...     constraints={"push": ca.vertcat(u - 1, -u - 1)},
    ...     horizon=15,
    ... )
    >>> loop = problem.closed_loop({"drag": 0.3, "price": 5.0}, [1.0, 0.5], steps=20)
    >>> recording = problem.recorded_loop(loop.x, loop.u)
    >>> found = impc.fit_optimal_control(problem, [recording], {"drag": 0.5, "price": 3.0})
    >>> {name: round(value, 6) for name, value in found.theta.items()}
    {'drag': 0.3, 'price': 5.0}
    >>> found.combinations.untold
    ()
    """
    require_solver(solver)
    if not recordings:
        raise DataError("recordings", "there are none", "give at least one")
    if not mu_steps or any(b >= a for a, b in itertools.pairwise(mu_steps)):
        raise InputError("mu_steps", f"got {tuple(mu_steps)!r:.60}", "give falling numbers")
    began = time.perf_counter()
    search = _Search(problem, tuple(recordings), solver)
    unknowns, best, settled = search.unknowns(problem.values(start)), None, False
    for branch in range(3):
        begun = search.begin(unknowns, mu_steps[0], branch)
        if begun is None:
            continue
        found, ended = _descend(search, begun, mu_steps, evaluations)
        if best is None or found.loss < best.loss:
            best, settled = found, ended
        if best.loss < _EXPLAINED * search.size or search.evaluations >= evaluations:
            break
    assert best is not None  # branch 0 ends with an answer or an error
    return _estimate(search, best, settled, time.perf_counter() - began)


def _descend(
    search: _Search, current: _Evaluation, mu_steps: Sequence[float], most: int
) -> tuple[_Evaluation, bool]:
    """The search along the falling mu."""
    settled = True
    for mu in mu_steps:
        if mu != current.mu:
            if search.evaluations >= most:
                return current, False
            followed = search.evaluate(current.unknowns, mu, current)
            if followed is None:
                return current, False
            current = followed
        current, settled = _levenberg(search, current, mu == mu_steps[-1], most)
    return current, settled


def _levenberg(
    search: _Search, current: _Evaluation, last: bool, most: int
) -> tuple[_Evaluation, bool]:
    """Steps until the loss no longer falls; at a mu on the way a rough answer is enough."""
    damping, patience, enough = (1e-3, 60, 1e-13) if last else (1e-2, 12, 1e-2)
    for _ in range(patience):
        left, values, right = np.linalg.svd(current.jacobian, full_matrices=False)
        drive = left.T @ current.residual
        while True:
            if search.evaluations >= most:
                return current, False
            gain = values / (values**2 + damping * values[0] ** 2)
            step = -right.T @ (gain * drive)
            step *= min(1.0, _LONGEST_STEP / max(float(np.max(np.abs(step))), 1e-300))
            if current.loss == 0 or np.max(np.abs(step)) < _SMALL_STEP:
                return current, True
            predicted = current.loss - float(
                np.sum((current.residual + current.jacobian @ step) ** 2)
            )
            tried = search.evaluate(current.unknowns + step, current.mu, current)
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


def _estimate(
    search: _Search, found: _Evaluation, settled: bool, seconds: float
) -> OptimalControlEstimate:
    problem, p = search.problem, len(search.problem.parameter_names)
    signals = search.signals()
    loss = float(np.sum((found.residual * search.scales[signals]) ** 2))
    told = combinations(problem, found.theta, found.jacobian, found.residual, signals)
    starts = [one.x0 for one in search.recordings]
    place = p
    for index, one in enumerate(search.recordings):
        if one.unknown_start:
            part = found.unknowns[place : place + problem.n]
            starts[index], place = part * search.scales[: problem.n], place + problem.n
    return OptimalControlEstimate(
        problem, search.recordings,
        dict(zip(problem.parameter_names, map(float, found.theta), strict=True)), loss,
        found.residual, found.jacobian, signals, search.scales, told.singular_values, told,
        tuple(starts), tuple(_trajectories(run)[:2] for run in found.runs), settled,
        search.evaluations, seconds,
    )  # fmt: skip


def _trajectories(run: _Run) -> tuple[Array, Array, Array, Array]:
    """x (T + 1, n), u (T, m) and their derivatives by theta and x_0."""
    if isinstance(run, ClosedLoop):
        return run.x, run.u, run.dx, run.du
    return run[0].x, run[0].u, run[1].x, run[1].u


def _root_mean_square(column: Array) -> float:
    known = column[np.isfinite(column)]
    return float(np.sqrt(np.mean(known**2))) if len(known) else 0.0
