"""Residual of an inverse problem and its exact derivatives.

One pass over each recording gives both (docs/why/theory.md). Columns of a trial: the controller
(gain and metric, or cost weights), physical parameters, then the trial's own unknowns: initial
states and errors of signals. With a `Correction` the residual is that of one-step-ahead
predictions.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from impc.arrays import Array
from impc.checking import replace
from impc.control.closed_loop import prepare_loop, run_loop, simulate
from impc.control.constraint_rows import Directions, directions
from impc.control.controller import Controller
from impc.control.simulation import Scenario, Sensitivity, Simulation, Status
from impc.control.terminal_set import TerminalSet
from impc.errors import ImpcError, SolverError
from impc.inverse.prediction import Correction
from impc.inverse.problem import (
    Problem,
    controller_for,
    missed,
    modelled,
    recorded,
    require_riccati,
    scenarios,
    weights_controller,
)
from impc.model.bounds import bound_rows
from impc.model.plant_family import PlantDifferential, plant_differential
from impc.model.recordings import Recording
from impc.model.riccati import stabilises
from impc.model.signal_errors import distortion, resampled
from impc.model.weights import Weights

# Residual assigned to each sample after an infeasible one, relative to the RMS output.
_NOT_REACHED = 1e3


@dataclass(frozen=True)
class Linear:
    """Residual and derivatives at a point, trial by trial."""

    residuals: tuple[Array, ...]  # (rows,) each: (simulated - recorded) / scale
    tables: tuple[Array, ...]  # (rows, shared + own) each
    shared: int  # Columns of the controller and the parameters; those of the trial follow
    reason: str  # Why a simulation stopped; empty if all trials are complete
    active: int  # Samples with an active bound
    weakly_active: int  # Samples at which the derivative is one-sided
    terminal: TerminalSet | None  # Terminal set, reused as a starting point by the next evaluation

    @property
    def residual(self) -> Array:
        """Residual of all trials (r,)."""
        return np.concatenate(self.residuals)

    def parts(self, problem: Problem) -> tuple[Array, Array, Array]:
        """Derivatives (r, k) by the controller, the parameters, and the unknowns of the trial."""
        table = np.concatenate(self.tables) if len(self.tables) > 1 else self.tables[0]
        first = self.shared - len(problem.logarithms)
        return table[:, :first], table[:, first : self.shared], table[:, self.shared :]

    def with_prior(self, problem: Problem, noise: float) -> Linear:
        """With a row per stated uncertainty (`Problem.row_sizes`), scaled by the noise SD `noise`.

        A value q away from its nominal one counts as a residual of q / SD noise SDs.
        """
        residuals, tables = list(self.residuals), list(self.tables)
        weights = noise * problem.own_weights
        stated = np.any(weights, axis=0)
        width = tables[0].shape[1]
        if np.any(stated):
            away = weights * problem.own_values
            for index, own in enumerate(weights):
                below = np.zeros((np.count_nonzero(stated), width))
                below[:, self.shared :] = np.diag(own)[stated]
                tables[index] = np.vstack([tables[index], below])
                residuals[index] = np.concatenate([residuals[index], away[index, stated]])
        slopes = noise * np.diag(1 / problem.parameter_units)[problem.stated]
        if len(slopes):
            below = np.zeros((len(slopes), width))
            below[:, self.shared - len(problem.logarithms) : self.shared] = slopes
            residuals.append(slopes @ problem.logarithms)
            tables.append(below)
        return replace(self, residuals=tuple(residuals), tables=tuple(tables))


def linearise(
    problem: Problem,
    controller: Controller,
    law: Mapping[str, Array],
    correction: Correction | None = None,
) -> Linear:
    """Residual and derivatives under a controller.

    `law` has the parts of the controller, K and S or Q and R, along the shared columns (last axis);
    the last k columns are the physical parameters. With a `correction` every gain can be evaluated,
    but neither parameters nor errors can be searched.
    """
    shared = next(iter(law.values())).shape[-1]
    differential = None
    if problem.family is not None:
        differential = plant_differential(problem.family, problem.logarithms)
    along = _directions(problem, controller, law, differential)
    seen = _Seen.of(problem, correction)
    if correction is not None and seen.moves is not None:
        E = np.zeros((problem.plant.n, seen.moves[2].shape[1], along.count))
        along = replace(along, x0=correction.kept(problem) @ along.x0, E=E)
    prepared, outputs = (
        prepare_loop(controller, along, seen.moves),
        seen.weighting @ problem.plant.C,
    )
    residuals, tables, reason, active, weakly_active = [], [], "", 0, 0
    commands = len(problem.measured) > len(problem.plant.C)
    for trial, drive in zip(problem.recordings, seen.drives, strict=True):
        run, moved = run_loop(
            *(prepared, drive),
            proved=False,
            seen=outputs,
            inputs=commands,
            pushed=_pushed(problem, trial),
        )
        weakly_active += run.weakly_active
        active += int(np.count_nonzero(run.status != Status.FREE))
        difference = seen.off(problem, trial, run)
        if not run.complete:
            reason = f"sample {run.reached}: {Status(int(run.status[run.reached])).sentence}"
            difference[run.reached + 1 :] = _NOT_REACHED * _scale(problem, trial)
        residuals.append(difference.ravel())
        tables.append(_table(problem, seen, trial, run, moved, shared, differential))
    return Linear(
        tuple(residuals), tuple(tables), shared, reason, active, weakly_active, controller.terminal
    )


def stable_controller(
    problem: Problem,
    gain: Array,
    metric: Array,
    near: TerminalSet | None = None,
    correction: Correction | None = None,
) -> Controller:
    """Controller of a `gain` (m, n) and a `metric` (m, m) that a search may simulate.

    With bounds, unstable gains have spurious local minima: saturation and the end of the recording
    hide the divergence. Without bounds, or with a `correction`, a search may pass through them.
    """
    require_riccati(problem)
    plant = problem.plant
    bounded = problem.terminal_set or len(bound_rows(problem.bounds, plant).b) > 0
    if correction is None and bounded and not stabilises(plant, gain):
        raise SolverError("gain", "does not stabilise the plant", "use another one")
    return controller_for(problem, gain, metric, near)


def misfit_or_reason(problem: Problem, gain: Array, metric: Array) -> tuple[float, str]:
    """2-norm of the residual and "", or infinity and the reason; faster than `linearise`."""
    residual, reason = residual_or_reason(problem, gain, metric)
    return np.inf if reason else float(np.linalg.norm(residual)), reason


def residual_or_reason(
    problem: Problem, gain: Array, metric: Array, correction: Correction | None = None
) -> tuple[Array, str]:
    """Residual (r,) without derivatives and "", or an empty array and the reason."""
    require_riccati(problem)
    try:
        controller = stable_controller(problem, gain, metric, correction=correction)
    except ImpcError as error:
        return np.zeros(0), str(error)
    return controlled_residual(problem, controller, correction)


def controlled_residual(
    problem: Problem, controller: Controller, correction: Correction | None = None
) -> tuple[Array, str]:
    """Residual (r,) under a controller and "", or an empty array and the reason."""
    parts = []
    for run, difference in _runs(problem, controller, correction):
        if not run.complete:
            reason = f"sample {run.reached}: {Status(int(run.status[run.reached])).sentence}"
            return np.zeros(0), reason
        parts.append(difference.ravel())
    return np.concatenate(parts), ""


def residual_only(problem: Problem, gain: Array, metric: Array) -> Array:
    """Residual without derivatives, of incomplete simulations too."""
    runs = _runs(problem, controller_for(problem, gain, metric))
    return np.concatenate([difference.ravel() for _, difference in runs])


def _runs(
    problem: Problem, controller: Controller, correction: Correction | None = None
) -> Iterator[tuple[Simulation, Array]]:
    """Simulation and residual (samples, q) of each trial, without derivatives."""
    seen = _Seen.of(problem, correction)
    prepared = prepare_loop(controller, directions(controller, 0), seen.moves)
    for trial, drive in zip(problem.recordings, seen.drives, strict=True):
        run, _ = run_loop(prepared, drive, proved=False)
        yield run, seen.off(problem, trial, run)


@dataclass(frozen=True)
class _Seen:
    """How the recordings of a problem are simulated and compared with the simulation."""

    # A, B and E of the simulated plant, if they differ from those of the controller's
    moves: tuple[Array, Array, Array] | None
    drives: list[Scenario]
    weighting: Array  # (p, p), from C x to the residual
    plain: bool = True  # Whether that only divides by the scales

    @classmethod
    def of(cls, problem: Problem, correction: Correction | None) -> _Seen:
        """As simulations, or as predictions with a `correction`."""
        if correction is None:
            return cls(None, scenarios(problem), np.diag(1 / problem.output_scale))
        moves, drives = correction.moves(problem), correction.drives(problem)
        return cls(moves, drives, correction.weighting(problem), plain=False)

    def off(self, problem: Problem, trial: Recording, run: Simulation) -> Array:
        """(Simulated - recorded) / scale, shape (samples, q); zero for missing values."""
        if self.plain:
            return missed(problem, trial, run)
        p, W = len(self.weighting), self.weighting
        found = np.nan_to_num(modelled(problem, trial, run) - recorded(problem, trial))
        return np.hstack([found[:, :p] @ W.T, found[:, p:] / problem.scale[p:]])


def _pushed(problem: Problem, trial: Recording) -> Array | None:
    """Derivatives of the disturbance (steps, d, errors) by errors of signals; None if zero."""
    p, places = len(problem.plant.outputs), problem.error_places
    if not any(column >= p for _, column in places):
        return None
    slopes = distortion(trial.disturbance[:-1], trial.errors[:, p:], held=True)
    found = np.zeros((*slopes.shape[:2], len(places)))
    for place, (kind, column) in enumerate(places):
        if column >= p:
            found[:, column - p, place] = slopes[:, column - p, kind]
    return found


def _directions(
    problem: Problem,
    controller: Controller,
    law: Mapping[str, Array],
    differential: PlantDifferential | None,
) -> Directions:
    """Directions of the shared columns `law` (last axis), then those of a trial."""
    n, searched = problem.plant.n, problem.searched_states
    shared = next(iter(law.values())).shape[-1]
    count = shared + problem.own_unknowns
    given = {name: np.zeros((*part.shape[:-1], count)) for name, part in law.items()}
    for name, part in law.items():
        given[name][..., :shared] = part
    given["x0"] = np.zeros((n, count))
    given["x0"][:searched, shared : shared + searched] = np.eye(searched)
    first = shared - len(problem.logarithms)
    if differential is not None and problem.family is not None:
        for name in ("A", "B", "E", "C", "observer"):
            part = getattr(differential, name)
            given[name] = np.zeros((*part.shape[:-1], count))
            given[name][..., first:shared] = part
        bounds = bound_rows(controller.bounds, problem.plant)
        given["bounds"] = np.zeros((len(bounds.b), count))
        for place, control in problem.family.limits(problem.plant):
            given["bounds"][:, first + place] = bounds.along_limit(control)
    along = directions(controller, count, **given)
    if differential is None:
        return along
    return replace(along, bodies=((),) * first + differential.bodies)


def _table(
    problem: Problem,
    seen: _Seen,
    trial: Recording,
    run: Simulation,
    moved: Sensitivity,
    shared: int,
    differential: PlantDifferential | None,
) -> Array:
    """Derivative of `_Seen.off` (samples q, count), parameters in C and errors included."""
    p, slope = len(problem.plant.outputs), moved.x
    if differential is not None:
        on_outputs = np.tensordot(run.x, differential.C, ((1,), (1,)))  # (samples, p, k)
        parameters = slice(shared - on_outputs.shape[2], shared)
        slope[:, :p, parameters] += on_outputs / problem.output_scale[:, None]
    slope = measured_slope(problem, trial, moved)
    if problem.signal_errors:
        outputs = run.x @ problem.plant.C.T
        own = distortion(outputs, trial.errors[:, :p], held=False)
        first = shared + problem.searched_states
        for place, (kind, column) in enumerate(problem.error_places):
            if column < p:
                by = own[:, column, kind, None] * seen.weighting[:, column]
                slope[:, :p, first + place] += by
        slope[np.isnan(recorded(problem, trial))] = 0.0
    return slope.reshape(slope.shape[0] * slope.shape[1], slope.shape[2])


def measured_slope(problem: Problem, trial: Recording, moved: Sensitivity) -> Array:
    """Derivative of scaled outputs and commands (samples, q, k); zero for missing values.

    `moved.x` are those of the scaled outputs and may be overwritten.
    """
    p, slope = len(problem.plant.outputs), moved.x
    if np.any(trial.errors[:, :p]):
        slope = resampled(slope, trial.errors[:, :p])
    if len(problem.measured) > p:
        slope = np.zeros((trial.samples, len(problem.measured), moved.x.shape[2]))
        slope[:, :p] = moved.x
        slope[:-1, p:] = moved.u / problem.command_scale[:, None]
    slope[np.isnan(recorded(problem, trial))] = 0.0
    return slope


def along_bounds(problem: Problem, gain: Array, metric: Array, moves: Array) -> Array:
    """Derivative of the residual (r, k) by `moves` (c, k) of the right sides of `bound_rows`."""
    controller = controller_for(problem, gain, metric)
    prepared = prepare_loop(controller, directions(controller, moves.shape[1], bounds=moves))
    parts = []
    for trial, drive in zip(problem.recordings, scenarios(problem), strict=True):
        _, moved = run_loop(prepared, drive, seen=problem.scaled_outputs)
        parts.append(np.concatenate(measured_slope(problem, trial, moved)))
    return np.concatenate(parts)


def _scale(problem: Problem, trial: Recording) -> float:
    return float(np.sqrt(np.nanmean((trial.outputs / problem.output_scale) ** 2))) or 1.0


def unusable(problem: Problem, shared: int, reason: str) -> Linear:
    """A large finite residual and a reason, so that a search rejects the step."""
    sizes, width = problem.trial_sizes, shared + problem.own_unknowns
    residuals = tuple(
        np.full(size, _NOT_REACHED * _scale(problem, trial))
        for size, trial in zip(sizes, problem.recordings, strict=True)
    )
    tables = tuple(np.zeros((size, width)) for size in sizes)
    return Linear(residuals, tables, shared, reason, 0, 0, None)


def scaled_changes(metric: Array, changes: Array) -> Array:
    """Map `changes` (k, m, m) of a metric (m, m) to those of the metric scaled to trace m."""
    trace = np.trace(metric)
    shares = np.trace(changes, axis1=1, axis2=2)[:, None, None] / trace
    return np.asarray(len(metric) / trace * (changes - shares * metric))


def verify_hard(problem: Problem, weights: Weights) -> list[Simulation]:
    """Simulate every recording with hard state bounds and terminal set."""
    controller = weights_controller(problem, weights, hard=True)
    return [simulate(controller, drive) for drive in scenarios(problem)]


def keeps_hard(problem: Problem, weights: Weights) -> bool:
    """Whether all trials stay feasible with hard state bounds and terminal set."""
    return all(run.complete for run in verify_hard(problem, weights))
