"""The inverse problem: recordings, and the closed loop that is to explain them.

For a gain K and a metric S the residual is vec(Y_sim - Y), all recordings in a row, and its
derivatives with respect to K and S are exact. The weights enter through K and S only, so every
method of the package is one of two searches over this residual: for a gain, or for weights.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Array
from impc.bounds import bound_rows, box_bounds
from impc.closed_loop import Scenario, Status, prepare_loop, run_loop, simulate
from impc.controller import Controller, gain_controller
from impc.errors import DataError, ImpcError
from impc.lqr import is_stable
from impc.prediction import Directions, directions

if TYPE_CHECKING:
    from impc.bounds import Bounds
    from impc.closed_loop import Simulation
    from impc.plant import Plant
    from impc.recording import Recording
    from impc.terminal_set import TerminalSet

__all__ = [
    "Evaluation",
    "InverseProblem",
    "controller_for",
    "evaluate",
    "inverse_problem",
    "misfit",
    "scenarios",
    "without_bounds",
]

# What a sample that a trial controller does not reach counts for, in root-mean-square outputs.
_NOT_REACHED = 1e3


@dataclass(frozen=True)
class InverseProblem:
    """Find the controller that made the recordings.

    Attributes
    ----------
    plant : Plant
    bounds : Bounds
    horizon : int
    recordings : tuple of Recording
    terminal_set : bool
        Whether the controller ends in its maximal invariant set.
    softening : float
        Price of exceeding a state bound or the terminal set during the search, see `Controller`.
        The rows are verified hard at the end.
    """

    plant: Plant
    bounds: Bounds
    horizon: int
    recordings: tuple[Recording, ...]
    terminal_set: bool
    softening: float


@dataclass(frozen=True)
class Evaluation:
    """Residual at one gain and metric.

    Attributes
    ----------
    residual : Array
        (r,), simulated minus recorded outputs.
    dK : Array
        (r, m, n).
    dS : Array
        (r, m, m), with respect to the metric scaled as in `Controller`.
    reason : str
        Why some samples were not reached; empty when all were.
    weakly_active : int
        Samples at which the derivative is one-sided.
    terminal : TerminalSet or None
        The terminal set, as a hint for the next evaluation nearby.
    """

    residual: Array
    dK: Array
    dS: Array
    reason: str
    weakly_active: int
    terminal: TerminalSet | None


def inverse_problem(
    plant: Plant,
    bounds: Bounds,
    horizon: int,
    recordings: tuple[Recording, ...],
    *,
    terminal_set: bool = True,
    softening: float = 1e6,
) -> InverseProblem:
    """Check and gather an inverse problem.

    Raises
    ------
    PlantError, DataError, InputError
        When the plant is continuous or there is no recording.
    """
    plant.require_discrete()
    if not recordings:
        raise DataError("recordings", "there are none", "give at least one trial")
    return InverseProblem(plant, bounds, horizon, tuple(recordings), terminal_set, softening)


def without_bounds(problem: InverseProblem) -> InverseProblem:
    """Return the same problem for a plain feedback gain: no bounds, no terminal set."""
    return replace(problem, bounds=box_bounds(problem.plant), terminal_set=False)


def controller_for(
    problem: InverseProblem, gain: Array, metric: Array, near: TerminalSet | None = None
) -> Controller:
    """Return the controller of the problem with that gain and metric.

    `near` is the terminal set of a gain nearby: the same answer in less time.

    Raises
    ------
    InputError, SolverError
        As `gain_controller`.
    """
    return gain_controller(
        problem.plant,
        gain,
        problem.bounds,
        problem.horizon,
        metric=metric,
        terminal_set=problem.terminal_set,
        softening=problem.softening,
        near=near,
    )


def scenarios(problem: InverseProblem) -> list[Scenario]:
    """What drives each recording."""
    return [Scenario(trial.x0, trial.disturbance[:-1]) for trial in problem.recordings]


def misfit(problem: InverseProblem, simulations: list[Simulation]) -> float:
    """2-norm of all simulated minus recorded outputs."""
    parts = [
        run.x @ problem.plant.C.T - trial.outputs
        for run, trial in zip(simulations, problem.recordings, strict=True)
    ]
    return float(np.linalg.norm(np.concatenate([part.ravel() for part in parts])))


def evaluate(
    problem: InverseProblem, gain: Array, metric: Array, near: TerminalSet | None = None
) -> Evaluation:
    """Residual and exact derivatives at a gain and a metric; `near` as in `controller_for`.

    A gain that does not stabilise the plant, or a loop that diverges, gives a large finite
    residual and its reason, so that a search can step back from it.
    """
    plant = problem.plant
    m, n = plant.m, plant.n
    # Past the edge of stability lie local minima that a bounded input and a recording that ends
    # hide; no weights have such a gain. A plain gain is left free: it goes there and comes back.
    bounded = problem.terminal_set or len(bound_rows(problem.bounds, plant).b) > 0
    if bounded and not is_stable(plant.A - plant.B @ gain, discrete=True):
        return _unusable(problem, "the gain does not stabilise the plant")
    try:
        controller = controller_for(problem, gain, metric, near)
    except ImpcError as error:
        return _unusable(problem, str(error))
    along = _gain_and_metric(controller)
    prepared = prepare_loop(controller, along)
    residuals, derivatives, reason, weakly_active = [], [], "", 0
    for trial, drive in zip(problem.recordings, scenarios(problem), strict=True):
        run, sensitivity = run_loop(prepared, drive)
        difference = run.x @ plant.C.T - trial.outputs
        weakly_active += run.weakly_active
        if not run.complete:
            difference[run.reached + 1 :] = _NOT_REACHED * _scale(trial)
            reason = f"sample {run.reached}: {Status(int(run.status[run.reached])).sentence}"
        residuals.append(difference.ravel())
        derivatives.append(plant.C @ sensitivity.x)
    jacobian = np.concatenate([part.reshape(-1, along.count) for part in derivatives])
    dS = np.zeros((len(jacobian), m, m))
    rows, columns = np.tril_indices(m)
    if m > 1:
        # Off-diagonal directions move two entries at once; half the derivative goes to each.
        share = np.where(rows == columns, 1.0, 0.5)
        dS[:, rows, columns] = jacobian[:, m * n :] * share
        dS[:, columns, rows] = dS[:, rows, columns]
    return Evaluation(
        np.concatenate(residuals),
        jacobian[:, : m * n].reshape(-1, m, n),
        dS,
        reason,
        weakly_active,
        controller.terminal,
    )


def residual_only(problem: InverseProblem, gain: Array, metric: Array) -> Array:
    """Residual without derivatives, for differences and comparisons."""
    controller = controller_for(problem, gain, metric)
    runs = [simulate(controller, drive) for drive in scenarios(problem)]
    return np.concatenate(
        [
            (run.x @ problem.plant.C.T - trial.outputs).ravel()
            for run, trial in zip(runs, problem.recordings, strict=True)
        ]
    )


def _gain_and_metric(controller: Controller) -> Directions:
    m, n = controller.K.shape
    rows, columns = np.tril_indices(m)
    metric_count = len(rows) if m > 1 else 0
    count = m * n + metric_count
    dK = np.zeros((m * n, count))
    dK[:, : m * n] = np.eye(m * n)
    dS = np.zeros((m, m, count))
    for index in range(metric_count):
        dS[rows[index], columns[index], m * n + index] = 1.0
        dS[columns[index], rows[index], m * n + index] = 1.0
    return directions(controller, count, K=dK, S=dS)


def _scale(trial: Recording) -> float:
    return float(np.sqrt(np.mean(trial.outputs**2))) or 1.0


def _unusable(problem: InverseProblem, reason: str) -> Evaluation:
    m, n = problem.plant.m, problem.plant.n
    residual = np.concatenate(
        [np.full(trial.outputs.size, _NOT_REACHED * _scale(trial)) for trial in problem.recordings]
    )
    size = len(residual)
    return Evaluation(residual, np.zeros((size, m, n)), np.zeros((size, m, m)), reason, 0, None)
