"""The residual of an inverse problem at a gain and a metric, with its exact derivatives.

One pass over each recording gives both (docs/theory.md, section 4). The columns follow what the
problem does not know: gain, metric for several inputs, initial states, physical parameters.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Array, frozen
from impc.checking import replace
from impc.control.closed_loop import prepare_loop, run_loop, simulate
from impc.control.constraint_rows import Directions, directions
from impc.control.simulation import Scenario, Status
from impc.errors import ImpcError
from impc.inverse.problem import controller_for, scenarios
from impc.model.bounds import bound_rows
from impc.model.plant_family import plant_differential
from impc.model.riccati import is_stable

if TYPE_CHECKING:
    from collections.abc import Callable

    from impc.control.controller import Controller
    from impc.control.simulation import Simulation
    from impc.control.terminal_set import TerminalSet
    from impc.inverse.problem import Problem
    from impc.model.plant_family import PlantDifferential
    from impc.model.recordings import Recording

    StartResidual = Callable[[Array], tuple[Array, Array]]

__all__ = [
    "Evaluation",
    "evaluate",
    "misfit_or_reason",
    "residual_only",
    "residual_or_reason",
    "start_residual",
    "unusable",
]

# What a sample that a trial controller does not reach counts for, in root-mean-square outputs.
_NOT_REACHED = 1e3


@dataclass(frozen=True)
class Evaluation:
    """Residual at one gain and metric.

    Attributes
    ----------
    residual : Array
        (r,), simulated minus recorded outputs, each divided by its scale.
    dK : Array
        (r, m, n).
    dS : Array
        (r, m, m), with respect to the metric scaled as in `Controller`.
    dx0 : Array
        (r, n), with respect to the initial state of the trial that the row belongs to; (r, 0)
        when the initial states are known.
    dparameters : Array
        (r, k), with respect to the logarithms of the parameters of the family; k may be 0.
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
    dx0: Array
    dparameters: Array
    reason: str
    weakly_active: int
    terminal: TerminalSet | None


def evaluate(
    problem: Problem, gain: Array, metric: Array, near: TerminalSet | None = None
) -> Evaluation:
    """Residual and exact derivatives at a `gain` (m, n) and a `metric` (m, m).

    `near` as in `controller_for`. A gain that does not stabilise the plant, or a loop that
    diverges, gives a large finite residual and its reason, so that a search can step back.
    """
    plant = problem.plant
    m, n = plant.m, plant.n
    # Past the edge of stability lie local minima that a bounded input and a recording that ends
    # hide; no weights have such a gain. A plain gain is left free: it goes there and comes back.
    bounded = problem.terminal_set or len(bound_rows(problem.bounds, plant).b) > 0
    if bounded and not is_stable(plant.A - plant.B @ gain, discrete=True):
        return unusable(problem, "the gain does not stabilise the plant")
    try:
        controller = controller_for(problem, gain, metric, near)
    except ImpcError as error:
        return unusable(problem, str(error))
    layout = _layout(problem)
    differential = _plant_differential(problem)
    prepared = prepare_loop(controller, _all_directions(controller, layout, differential))
    weighting = plant.C / problem.output_scale[:, None]
    residuals, derivatives, reason, weakly_active = [], [], "", 0
    for trial, drive in zip(problem.recordings, scenarios(problem), strict=True):
        run, sensitivity = run_loop(prepared, drive)
        weakly_active += run.weakly_active
        if not run.complete:
            reason = f"sample {run.reached}: {Status(int(run.status[run.reached])).sentence}"
        residuals.append(_difference(problem, trial, run).ravel())
        derivative = weighting @ sensitivity.x
        if differential is not None:
            seen = np.tensordot(run.x, differential.C, ((1,), (1,)))  # dC x: (samples, p, k)
            derivative[..., layout.parameters] += seen / problem.output_scale[:, None]
        derivatives.append(derivative.reshape(-1, layout.count))
    jacobian = np.concatenate(derivatives)
    return Evaluation(
        np.concatenate(residuals),
        jacobian[:, layout.gain].reshape(-1, m, n),
        _symmetric(jacobian[:, layout.metric], m),
        jacobian[:, layout.start],
        jacobian[:, layout.parameters],
        reason,
        weakly_active,
        controller.terminal,
    )


def start_residual(problem: Problem, gain: Array, metric: Array) -> StartResidual:
    """Residual of the only trial of a problem as a function of its initial state.

    Parameters
    ----------
    gain, metric : Array
        K (m, n) and S (m, m), which stay: rows and their derivatives are built once.

    Returns
    -------
    callable
        x0 (n,) -> residual (r,) and its derivative (r, n).

    Raises
    ------
    InputError, SolverError
        As `controller_for`.
    """
    controller = controller_for(problem, gain, metric)
    n = problem.plant.n
    prepared = prepare_loop(controller, directions(controller, n, x0=np.eye(n)))
    (trial,) = problem.recordings
    weighting = problem.plant.C / problem.output_scale[:, None]

    def at(x0: Array) -> tuple[Array, Array]:
        run, sensitivity = run_loop(prepared, Scenario(frozen(x0), trial.disturbance[:-1]))
        difference = _difference(problem, trial, run)
        return difference.ravel(), (weighting @ sensitivity.x).reshape(-1, n)

    return at


def misfit_or_reason(
    problem: Problem, gain: Array, metric: Array, most: float = np.inf
) -> tuple[float, str]:
    """2-norm of the residual and an empty string, or infinity and why there is none.

    At a `gain` (m, n) and a `metric` (m, m). A fifth of the time of `evaluate`, which also
    differentiates.

    Parameters
    ----------
    most : float
        Once the trials so far have more, the rest are not looked at, and theirs is not in it.
    """
    residual, reason = residual_or_reason(problem, gain, metric, most)
    return np.inf if reason else float(np.linalg.norm(residual)), reason


def residual_or_reason(
    problem: Problem, gain: Array, metric: Array, most: float = np.inf
) -> tuple[Array, str]:
    """`residual_only` (r,) and an empty string, or nothing (0,) and why there is none.

    At a `gain` (m, n) and a `metric` (m, m); `most` as in `misfit_or_reason`.
    """
    if not is_stable(problem.plant.A - problem.plant.B @ gain, discrete=True):
        return np.zeros(0), "the gain does not stabilise the plant"
    try:
        controller = controller_for(problem, gain, metric)
    except ImpcError as error:
        return np.zeros(0), str(error)
    parts, square = [], 0.0
    for trial, drive in zip(problem.recordings, scenarios(problem), strict=True):
        run = simulate(controller, drive)
        if not run.complete:
            reason = f"sample {run.reached}: {Status(int(run.status[run.reached])).sentence}"
            return np.zeros(0), reason
        parts.append(_off(problem, trial, run).ravel())
        square += float(parts[-1] @ parts[-1])
        if square > most**2:
            break
    return np.concatenate(parts), ""


def residual_only(problem: Problem, gain: Array, metric: Array) -> Array:
    """Residual without derivatives, for differences and comparisons.

    Parameters
    ----------
    gain, metric : Array
        K (m, n) and S (m, m).

    Returns
    -------
    Array
        Simulated minus recorded outputs over their scales (r,), trial by trial, sample by sample.

    Raises
    ------
    InputError, SolverError
        As `controller_for`.
    """
    controller = controller_for(problem, gain, metric)
    return np.concatenate(
        [
            _off(problem, trial, simulate(controller, drive)).ravel()
            for trial, drive in zip(problem.recordings, scenarios(problem), strict=True)
        ]
    )


@dataclass(frozen=True)
class _Layout:
    """Which directions stand where: gain, metric, initial state, parameters."""

    gain: slice
    metric: slice
    start: slice
    parameters: slice

    @property
    def count(self) -> int:
        return int(self.parameters.stop)


def _layout(problem: Problem) -> _Layout:
    m, n = problem.plant.m, problem.plant.n
    sizes = (
        m * n,
        m * (m + 1) // 2 if m > 1 else 0,
        n if problem.unknown_start else 0,
        len(problem.logarithms),
    )
    ends = np.cumsum((0, *sizes)).tolist()
    return _Layout(*(slice(a, b) for a, b in itertools.pairwise(ends)))


def _plant_differential(problem: Problem) -> PlantDifferential | None:
    if problem.family is None:
        return None
    return plant_differential(problem.family, problem.logarithms)


def _all_directions(
    controller: Controller, layout: _Layout, differential: PlantDifferential | None
) -> Directions:
    m, n = controller.K.shape
    count = layout.count
    dK = np.zeros((m * n, count))
    dK[:, layout.gain] = np.eye(m * n)
    dS = np.zeros((m, m, count))
    if m > 1:
        rows, columns = np.tril_indices(m)
        at = np.arange(layout.metric.start, layout.metric.stop)
        dS[rows, columns, at] = dS[columns, rows, at] = 1.0
    dx0 = np.zeros((n, count))
    width = layout.start.stop - layout.start.start
    dx0[:, layout.start] = np.eye(n, width)
    given = {"K": dK, "S": dS, "x0": dx0}
    if differential is not None:
        for name in ("A", "B", "E"):
            part = getattr(differential, name)
            given[name] = np.zeros((*part.shape[:-1], count))
            given[name][..., layout.parameters] = part
    along = directions(controller, count, **given)
    if differential is None:
        return along
    return replace(along, bodies=((),) * layout.parameters.start + differential.bodies)


def _symmetric(columns: Array, m: int) -> Array:
    """Derivatives along symmetric directions as (r, m, m)."""
    dS = np.zeros((len(columns), m, m))
    if m > 1:
        # Off-diagonal directions move two entries at once; half the derivative goes to each.
        rows, places = np.tril_indices(m)
        dS[:, rows, places] = columns * np.where(rows == places, 1.0, 0.5)
        dS[:, places, rows] = dS[:, rows, places]
    return dS


def _difference(problem: Problem, trial: Recording, run: Simulation) -> Array:
    """Simulated minus recorded outputs over their scales (samples, p), large where not reached."""
    difference = _off(problem, trial, run)
    if not run.complete:
        difference[run.reached + 1 :] = _NOT_REACHED * _scale(problem, trial)
    return difference


def _off(problem: Problem, trial: Recording, run: Simulation) -> Array:
    """Simulated minus recorded outputs over their scales (samples, p)."""
    return np.asarray((run.x @ problem.plant.C.T - trial.outputs) / problem.output_scale)


def _scale(problem: Problem, trial: Recording) -> float:
    return float(np.sqrt(np.mean((trial.outputs / problem.output_scale) ** 2))) or 1.0


def unusable(problem: Problem, reason: str) -> Evaluation:
    """A large finite residual with its reason, for a search to step back from."""
    m, n = problem.plant.m, problem.plant.n
    residual = np.concatenate(
        [
            np.full(trial.outputs.size, _NOT_REACHED * _scale(problem, trial))
            for trial in problem.recordings
        ]
    )
    size, starts = len(residual), n if problem.unknown_start else 0
    return Evaluation(
        residual,
        np.zeros((size, m, n)),
        np.zeros((size, m, m)),
        np.zeros((size, starts)),
        np.zeros((size, len(problem.logarithms))),
        reason,
        0,
        None,
    )
