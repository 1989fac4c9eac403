"""Nonlinear inverse MPC: the parameters of an optimal control problem behind its recordings.

    minimise over theta    sum ((x_sim(theta) - x) / scale)^2 + ((u_sim(theta) - u) / scale)^2

by Levenberg and Marquardt's method with exact derivatives, positive parameters in their logarithms.
The plans are those of the relaxed conditions s lam = mu, with mu falling in steps: at 1e-1 a
constraint is felt from afar, also one that the first parameters never reach, and the derivative is
smooth over changes of the active rows; at 1e-10 it is the problem itself. docs/nonlinear.md.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Array, Frozen, IntArray
from impc.checking import checked
from impc.errors import DataError, InfeasibleError, InputError, SolverError
from impc.nonlinear.combinations import Combinations, combinations, interval
from impc.nonlinear.plan import require_solver
from impc.nonlinear.search import (
    EXPLAINED,
    Budget,
    Residuals,
    along_mu,
    begin,
    guided,
    scales_of,
)

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from impc.nonlinear.problem import OptimalControlProblem
    from impc.nonlinear.recordings import OptimalRecording
    from impc.nonlinear.search import Evaluation
    from impc.reporting.document import Report
    from impc.reporting.provenance import Provenance

#: The falling sequence of mu, over the mean cost of a recorded stage where that is below one.
MU_STEPS = (1e-1, 1e-2, 1e-4, 1e-10)
_SPREAD = 0.3  # of further starts, in a logarithm
# A scaling holds while it moves all trajectories by less than this share of them, or of the noise
# of one number.
_UNMOVED, _LITTLE = 1e-5, 0.3


@dataclass(frozen=True, eq=False)
class OptimalControlEstimate(Frozen):
    """What was found, and which part of it the recordings identify."""

    problem: OptimalControlProblem
    recordings: tuple[OptimalRecording, ...]
    start: dict[str, float]  # Values by name at which the search began
    theta: dict[str, float]  # Values by name
    loss: float  # Sum of squares of all that was measured, in its units
    residual: Array  # Differences over their scales (r,)
    # Its derivative (r, k) by logarithms of positive parameters, by signed ones, and by unknown
    # initial states over their scales
    jacobian: Array
    # Of each residual the index of its state, or n and the index of its input (r,)
    signals: IntArray
    scales: Array  # Root-mean-square of each state and input in the recordings (n + m,)
    combinations: (
        Combinations  # What is identified and what is not, with the singular values that say so
    )
    x0: tuple[Array, ...]  # Initial state of each recording (n,)
    # Of each recording the states (steps + 1, n) and inputs (steps, m) that the estimate has
    runs: tuple[tuple[Array, Array], ...]
    settled: bool  # Whether the search ended by itself
    evaluations: int  # How often all recordings were solved and differentiated
    seconds: float  # Of the search, s

    def page(self, provenance: Provenance) -> Report:
        """Page, tables and figures, as `impc.report` writes them."""
        from impc.nonlinear.page import OptimalFit, optimal_report  # noqa: PLC0415 - it shows this

        names = tuple(f"recording {index + 1}" for index in range(len(self.recordings)))
        fit = OptimalFit(self, names, ((),) * len(names), self.problem.dt)
        return optimal_report(fit, provenance)

    def intervals(self, level: float = 0.95) -> dict[str, tuple[float, float]]:
        """Low and high end of each parameter by its name, at a `level` between 0 and 1.

        Normal in the logarithms of positive parameters; the noise of each signal is the root mean
        square of what is left of it. A parameter that is part of an unidentified combination has an
        infinite interval.
        """
        if not 0 < level < 1:
            raise InputError("level", f"got {level:g}", "give one between 0 and 1")
        rows = zip(self.combinations.deviations, self.problem.positive, strict=True)
        return {
            name: interval(value, float(deviation), not positive, level)
            for (name, value), (deviation, positive) in zip(self.theta.items(), rows, strict=True)
        }


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
    """Search the parameters from a start.

    Parameters
    ----------
    problem : OptimalControlProblem
    recordings : sequence of OptimalRecording
        Of `problem.recorded_plan` and `problem.recorded_loop`.
    start : dict
        First value of each parameter by its name.
    solver : str
        One of `impc.nonlinear.plan.SOLVERS`.
    evaluations : int
        After how many the search from a start is stopped.
    starts : int
        From how many starts, where the recordings are not explained from the first or it has no
        plan: the others are about it by 0.3 in a logarithm.

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
        When there is no plan at any start.

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
    >>> found.combinations.unidentified
    ()
    """
    solver = require_solver(solver)
    if not recordings:
        raise DataError("recordings", "there are none", "give at least one")
    if any(one.problem is not problem for one in recordings):
        raise InputError("recordings", "are of another problem", "record them with this one")
    began = time.perf_counter()
    theta, budget = problem.values(start), Budget()
    given = Residuals(problem, tuple(recordings), solver, scales_of(recordings))
    mu_steps, explained = _scaled(recordings, theta), EXPLAINED * given.size
    best: tuple[Evaluation, bool] | None = None
    refused: Exception = SolverError("start", "no search got away from it", "begin nearer")
    for place, steps in _places(given, theta, mu_steps, starts, evaluations, budget):
        budget.take()
        try:
            first = begin(given, given.unknowns(place), steps[0])
        except (InfeasibleError, SolverError) as error:  # said if no place has a plan
            refused = error if best is None and place is theta else refused
            continue
        # Initial states stay at their samples until the rest is found: from afar their search ends
        # elsewhere.
        held, free = given.free(sampled=False), given.free()
        found = along_mu(given, first, steps, held, budget)
        if found[1] and not np.array_equal(held, free):
            again = mu_steps[-1:] if found[0].loss < explained else mu_steps
            found = min(found, along_mu(given, found[0], again, free, budget), key=_loss)
        best = found if best is None else min(best, found, key=_loss)
        if best[0].loss < explained:
            break
    if best is None:
        raise refused
    return _estimate(given, theta, *best, budget.done, time.perf_counter() - began)


def _loss(found: tuple[Evaluation, bool]) -> float:
    return found[0].loss


def _places(
    given: Residuals,
    theta: Array,
    mu_steps: Sequence[float],
    starts: int,
    evaluations: int,
    budget: Budget,
) -> Iterator[tuple[Array, Sequence[float]]]:
    """The start and others about it, each after where closed loops guide from there, with their mu.

    They are the same for the same start.
    """
    for index in range(starts):
        budget.left, here = evaluations, theta
        if index:
            noise = _SPREAD * np.random.default_rng(index).normal(size=len(theta))
            here = np.where(given.problem.positive, theta * np.exp(noise), theta * (1 + noise))
        near = guided(given, here, mu_steps, budget)
        if near is not None:
            yield near, mu_steps[-2:]
        yield here, mu_steps


def _scaled(recordings: Sequence[OptimalRecording], theta: Array) -> Sequence[float]:
    """mu in the size of the cost: at 0.1 of it a limit is felt from afar and moves little else."""
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
    given: Residuals,
    start: Array,
    found: Evaluation,
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
            there = begin(given, unknowns, found.mu)
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
