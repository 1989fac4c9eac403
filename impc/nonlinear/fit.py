"""Nonlinear inverse MPC: fit the parameters of an optimal control problem to recordings.

    minimise over theta    sum ((x_sim(theta) - x) / scale)^2 + ((u_sim(theta) - u) / scale)^2

by the Levenberg-Marquardt method with exact derivatives, positive parameters in logarithms. Plans
satisfy the relaxed conditions s lam = mu with decreasing mu: at 1e-1 constraints act from a
distance, even ones that the starting parameters never reach, and the derivative is smooth across
changes of the active rows; 1e-10 is the problem itself (docs/howto/nonlinear.md).
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Array, Frozen, IntArray
from impc.attached_methods import attach
from impc.checking import checked
from impc.errors import DataError, InfeasibleError, InputError, SolverError
from impc.nonlinear import search
from impc.nonlinear.closed_loop import OptimalRecording
from impc.nonlinear.combinations import Combinations, combinations, interval
from impc.nonlinear.plan import require_solver
from impc.nonlinear.problem import OptimalControlProblem
from impc.reporting.document import Report
from impc.reporting.provenance import Provenance

#: Decreasing mu, relative to the mean cost of a recorded stage if that is below one.
MU_STEPS = (1e-1, 1e-2, 1e-4, 1e-10)
_SPREAD = 0.3  # standard deviation of further starts, in a logarithm
# A scaling is accepted if it moves all trajectories by less than this share of them, or of the
# noise of one number.
_UNMOVED, _LITTLE = 1e-5, 0.3


@dataclass(frozen=True, eq=False)
class OptimalControlEstimate(Frozen):
    """Estimated parameters of an optimal control problem, and their identifiability."""

    problem: OptimalControlProblem
    recordings: tuple[OptimalRecording, ...]
    start: dict[str, float]  # starting values by name
    theta: dict[str, float]  # estimates by name
    loss: float  # sum of squared residuals, in the units of the signals
    residual: Array  # (r,), differences over their scales
    # (r, k), derivative by logarithms of positive parameters, by signed ones, and by unknown
    # initial states over their scales
    jacobian: Array
    signals: IntArray  # (r,), index of each residual's signal: state, or n + input
    scales: Array  # (n + m,), root mean square of each state and input in the recordings
    combinations: Combinations  # identified and unidentified combinations
    x0: tuple[Array, ...]  # (n,), initial state of each recording
    # states (steps + 1, n) and inputs (steps, m) of the estimate for each recording
    runs: tuple[tuple[Array, Array], ...]
    settled: bool  # whether the search converged
    evaluations: int  # number of evaluations of all recordings with derivatives
    seconds: float  # run time of the search in s

    if TYPE_CHECKING:  # attached

        def page(self, provenance: Provenance) -> Report: ...  # noqa: D102 - at its function

    def intervals(self, level: float = 0.95) -> dict[str, tuple[float, float]]:
        """Return the interval of each parameter by name, at a `level` between 0 and 1.

        Normal in the logarithms of positive parameters, with the residual noise of each signal.
        Parameters in an unidentified combination have an infinite interval.
        """
        if not 0 < level < 1:
            raise InputError("level", f"got {level:g}", "give one between 0 and 1")
        rows = zip(self.combinations.deviations, self.problem.positive, strict=True)
        return {
            name: interval(value, float(deviation), not positive, level)
            for (name, value), (deviation, positive) in zip(self.theta.items(), rows, strict=True)
        }


attach(OptimalControlEstimate)


@checked(evaluations=1, starts=(1, 1000))
def fit_optimal_control(
    problem: OptimalControlProblem,
    recordings: Sequence[OptimalRecording],
    start: Mapping[str, float],
    *,
    solver: str = "ipopt",
    evaluations: int = 200,
    starts: int = 1,
) -> OptimalControlEstimate:
    """Estimate the parameters of an optimal control problem from recordings.

    Parameters
    ----------
    problem : OptimalControlProblem
        Problem with unknown parameters.
    recordings : sequence of OptimalRecording
        Results of `problem.recorded_plan` and `problem.recorded_loop`.
    start : dict
        Starting value of each parameter by name.
    solver : str
        Solver of the plans, "ipopt" or "fatrop".
    evaluations : int
        Budget of evaluations for each start of the search.
    starts : int
        Number of starts. Further ones are used if the first does not explain the recordings or has
        no plan; they are distributed about it with SD 0.3 in a logarithm.

    Returns
    -------
    OptimalControlEstimate
        `settled` is True if the search converged.

    Raises
    ------
    DataError
        If there are no recordings.
    InputError
        If a start is invalid, or a parameter affects nothing that was measured at any mu.
    InfeasibleError, SolverError
        If there is no plan at any start.

    Examples
    --------
    A point with drag, pushed to the origin; drag and cost weight are unknown.

    >>> import casadi as ca
    >>> import impc
    >>> x, u, drag, weight = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("drag"), ca.SX.sym("w")
    >>> problem = impc.OptimalControlProblem(
    ...     x, u, {"drag": drag, "weight": weight},
    ...     next_state=x + 0.1 * ca.vertcat(x[1], u - drag * x[1] ** 3),
    ...     stage_cost=weight * x[0] ** 2 + u**2,
    ...     constraints={"push": ca.vertcat(u - 1, -u - 1)},
    ...     horizon=15,
    ... )
    >>> loop = problem.closed_loop({"drag": 0.3, "weight": 5.0}, [1.0, 0.5], steps=20)
    >>> recording = problem.recorded_loop(loop.x, loop.u)
    >>> found = impc.fit_optimal_control(problem, [recording], {"drag": 0.5, "weight": 3.0})
    >>> {name: round(value, 6) for name, value in found.theta.items()}
    {'drag': 0.3, 'weight': 5.0}
    >>> found.combinations.unidentified
    ()
    """
    solver = require_solver(solver)
    if not recordings:
        raise DataError("recordings", "is empty", "give at least one recording")
    if any(one.problem is not problem for one in recordings):
        raise InputError("recordings", "belong to another problem", "record them with this one")
    began = time.perf_counter()
    theta, budget = problem.values(start), search.Budget()
    given = search.Residuals(problem, tuple(recordings), solver, search.scales_of(recordings))
    mu_steps, explained = _scaled(recordings, theta), search.EXPLAINED * given.size
    best: tuple[search.Evaluation, bool] | None = None
    refused: Exception = SolverError("start", "no search could leave it", "start nearer")
    for place, steps in _places(given, theta, mu_steps, starts, evaluations, budget):
        budget.take()
        try:
            first = search.begin(given, given.unknowns(place), steps[0])
        except (InfeasibleError, SolverError) as error:  # raised if no start has a plan
            refused = error if best is None and place is theta else refused
            continue
        # Initial states stay at their samples until the rest has converged: from a distant start
        # they would converge elsewhere.
        held, free = given.free(sampled=False), given.free()
        found = search.along_mu(given, first, steps, held, budget)
        if found[1] and not np.array_equal(held, free):
            again = mu_steps[-1:] if found[0].loss < explained else mu_steps
            found = min(found, search.along_mu(given, found[0], again, free, budget), key=_loss)
        best = found if best is None else min(best, found, key=_loss)
        if best[0].loss < explained:
            break
    if best is None:
        raise refused
    return _estimate(given, theta, *best, budget.done, time.perf_counter() - began)


def _loss(found: tuple[search.Evaluation, bool]) -> float:
    return found[0].loss


def _places(
    given: search.Residuals,
    theta: Array,
    mu_steps: Sequence[float],
    starts: int,
    evaluations: int,
    budget: search.Budget,
) -> Iterator[tuple[Array, Sequence[float]]]:
    """Yield the start and others about it, each after its guided version, with their mu."""
    for index in range(starts):
        budget.left, here = evaluations, theta
        if index:
            noise = _SPREAD * np.random.default_rng(index).normal(size=len(theta))
            here = np.where(given.problem.positive, theta * np.exp(noise), theta * (1 + noise))
        near = search.guided(given, here, mu_steps, budget)
        if near is not None:
            yield near, mu_steps[-2:]
        yield here, mu_steps


def _scaled(recordings: Sequence[OptimalRecording], theta: Array) -> Sequence[float]:
    """mu relative to the cost: at 0.1 of it, limits act from a distance without further effect."""
    costs = [
        abs(float(one.problem.functions[1](x, u, d, theta)))
        for one in recordings
        for x, u, d in zip(one.x[:-1], one.u, one.d, strict=True)
        if np.all(np.isfinite(x)) and np.all(np.isfinite(u))
    ]
    mean = float(np.mean(costs)) if costs else 1.0
    size = min(1.0, mean) if np.isfinite(mean) else 1.0
    return tuple(dict.fromkeys(max(mu * size, MU_STEPS[-1]) for mu in MU_STEPS))


def _estimate(
    given: search.Residuals,
    start: Array,
    found: search.Evaluation,
    settled: bool,
    evaluations: int,
    seconds: float,
) -> OptimalControlEstimate:
    problem, signals, p = given.problem, given.signals(), len(start)
    (theta, starts), jacobian = given.split(found.unknowns), found.jacobian[:, given.free()]
    noise = float(np.sqrt(np.mean(found.residual**2)))

    def holds(theta: Array) -> bool:
        unknowns = np.append(given.unknowns(theta)[:p], found.unknowns[p:])
        try:
            there = search.begin(given, unknowns, found.mu)
        except (InputError, InfeasibleError, SolverError):
            return False
        moved = float(np.linalg.norm(there.residual - found.residual))
        return bool(moved <= max(_UNMOVED * np.sqrt(given.size), _LITTLE * noise))

    begun, named = (
        dict(zip(problem.parameter_names, map(float, values), strict=True))
        for values in (start, theta)
    )
    return OptimalControlEstimate(
        problem, given.recordings, begun, named,
        float(np.sum((found.residual * given.scales[signals]) ** 2)), found.residual, jacobian,
        signals, given.scales,
        combinations(problem, theta, jacobian, found.residual, signals, holds), tuple(starts),
        tuple((run.x, run.u) for run in found.runs), settled, evaluations, seconds,
    )  # fmt: skip
