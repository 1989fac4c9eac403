"""Residual of an inverse problem and its exact derivatives.

One pass over each recording gives both (docs/why/theory.md). Columns: gain, metric (with several
inputs), initial states and offsets of each trial, physical parameters. With a
`Correction` the residual is that of one-step-ahead predictions.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Array, frozen
from impc.checking import checked, replace
from impc.control.closed_loop import (
    prepare_loop,
    run_loop,
    simulate,
)
from impc.control.constraint_rows import Directions, directions
from impc.control.simulation import Status
from impc.errors import ImpcError
from impc.inverse.problem import (
    controller_for,
    drive_of,
    missed,
    modelled,
    recorded,
    require_riccati,
    scenarios,
    weights_controller,
)
from impc.model.bounds import bound_rows
from impc.model.plant_family import plant_differential
from impc.model.riccati import stabilises

if TYPE_CHECKING:
    from collections.abc import Callable

    from impc.control.controller import Controller
    from impc.control.simulation import Scenario, Sensitivity, Simulation
    from impc.control.terminal_set import TerminalSet
    from impc.inverse.prediction import Correction
    from impc.inverse.problem import Problem
    from impc.model.plant_family import PlantDifferential
    from impc.model.recordings import Recording
    from impc.model.weights import Weights

    OwnResidual = Callable[[Array, Array], tuple[Array, Array]]

# Residual assigned to each sample after an infeasible one, relative to the RMS output.
_NOT_REACHED = 1e3


@dataclass(frozen=True)
class Evaluation:
    """Residual and derivatives at one gain and metric."""

    residual: Array  # (r,), simulated minus recorded outputs, each divided by its scale
    dK: Array  # (r, m, n)
    dS: Array  # (r, m, m), with respect to the metric scaled as in `Controller`
    # (r, own), with respect to initial state and offsets of the trial to which the row belongs
    own: Array
    # (r, k), with respect to the logarithms of the physical parameters; k may be 0
    dparameters: Array
    reason: str  # Why a simulation stopped; empty if all trials are complete
    active: int  # Samples with an active bound
    weakly_active: int  # Samples at which the derivative is one-sided
    terminal: TerminalSet | None  # Terminal set, reused as a starting point by the next evaluation

    def along_gain(self, T: Array, G: Array) -> Array:
        """Derivative (r, mn) with respect to G^-1 K T (whitened coordinates T (n, n), G (m, m))."""
        return np.asarray(self.dK.reshape(len(self.residual), -1) @ np.kron(G, np.linalg.inv(T).T))

    def along_metric(self, metric: Array, changes: Array) -> Array:
        """Derivative (r, k) along `changes` (k, m, m) of the unscaled `metric` (m, m)."""
        scaled = scaled_changes(metric, changes).reshape(len(changes), metric.size)
        return np.asarray(self.dS.reshape(len(self.residual), -1) @ scaled.T)


def evaluate(
    problem: Problem,
    gain: Array,
    metric: Array,
    near: TerminalSet | None = None,
    correction: Correction | None = None,
) -> Evaluation:
    """Residual and exact derivatives at a `gain` (m, n) and a `metric` (m, m).

    A gain that does not stabilise the plant, or a loop that diverges, gives a large finite residual
    and a reason, so that a search can reject the step. With a `correction` every gain can be
    evaluated, but parameters cannot be searched. `near` as in `controller_for`.
    """
    require_riccati(problem)
    plant = problem.plant
    m, n = plant.m, plant.n
    refused = _refused(problem, gain, correction)
    if refused:
        return unusable(problem, refused)
    try:
        controller = controller_for(problem, gain, metric, near)
    except ImpcError as error:
        return unusable(problem, str(error))
    layout = _layout(problem)
    differential = _plant_differential(problem)
    along = _all_directions(problem, controller, layout, differential)
    seen = _Seen.of(problem, correction)
    if correction is not None and seen.moves is not None:
        E = np.zeros((n, seen.moves[2].shape[1], layout.count))
        along = replace(along, x0=correction.kept(problem) @ along.x0, E=E)
    prepared, outputs = prepare_loop(controller, along, seen.moves), seen.weighting @ plant.C
    residuals, derivatives, reason, active, weakly_active = [], [], "", 0, 0
    for trial, drive in zip(problem.recordings, seen.drives, strict=True):
        run, sensitivity = run_loop(
            prepared, drive, proved=False, seen=outputs, inputs=len(problem.measured) > len(plant.C)
        )
        weakly_active += run.weakly_active
        active += int(np.count_nonzero(run.status != Status.FREE))
        if not run.complete:
            reason = f"sample {run.reached}: {Status(int(run.status[run.reached])).sentence}"
        residuals.append(_difference(problem, seen, trial, run).ravel())
        derivatives.append(_slope(problem, seen, trial, run, sensitivity, layout, differential))
    jacobian = np.concatenate(derivatives) if len(derivatives) > 1 else derivatives[0]
    return Evaluation(
        np.concatenate(residuals),
        jacobian[:, layout.gain].reshape(-1, m, n),
        _symmetric(jacobian[:, layout.metric], m),
        jacobian[:, layout.own],
        jacobian[:, layout.parameters],
        reason,
        active,
        weakly_active,
        controller.terminal,
    )


def with_prior_rows(problem: Problem, found: Evaluation, noise: float) -> Evaluation:
    """Append one row per parameter with a stated uncertainty, scaled by the noise SD `noise`.

    A parameter q away from its nominal value counts as a residual of q / SD noise SDs.
    """
    k = int(np.count_nonzero(problem.stated))
    if k == 0:
        return found
    slopes = noise * np.diag(1 / problem.parameter_units)[problem.stated]
    below = {"residual": slopes @ problem.logarithms, "dparameters": slopes}
    for name in ("dK", "dS", "own"):
        below[name] = np.zeros((k, *getattr(found, name).shape[1:]))
    parts = {name: np.concatenate([getattr(found, name), part]) for name, part in below.items()}
    return replace(found, **parts)


def own_residual(problem: Problem, gain: Array, metric: Array) -> OwnResidual:
    """Residual of a one-trial problem as a function of its initial state and offsets."""
    controller = controller_for(problem, gain, metric)
    layout = _layout(replace(problem, family=None, logarithms=frozen([])))
    along = _all_directions(problem, controller, layout, None)
    prepared = prepare_loop(controller, along)
    (trial,) = problem.recordings
    seen = _Seen.of(problem, None)

    def at(x0: Array, offset: Array) -> tuple[Array, Array]:
        moved = replace(trial, offset=frozen(offset))
        run, sensitivity = run_loop(prepared, drive_of(trial, x0), seen=problem.scaled_outputs)
        slopes = _slope(problem, seen, moved, run, sensitivity, layout, None)
        return _difference(problem, seen, moved, run).ravel(), slopes[:, layout.own]

    return at


def misfit_or_reason(problem: Problem, gain: Array, metric: Array) -> tuple[float, str]:
    """2-norm of the residual and "", or infinity and the reason; faster than `evaluate`."""
    residual, reason = residual_or_reason(problem, gain, metric)
    return np.inf if reason else float(np.linalg.norm(residual)), reason


def residual_or_reason(
    problem: Problem, gain: Array, metric: Array, correction: Correction | None = None
) -> tuple[Array, str]:
    """Residual (r,) without derivatives and "", or an empty array and the reason."""
    refused = _refused(problem, gain, correction)
    if refused:
        return np.zeros(0), refused
    try:
        controller = controller_for(problem, gain, metric)
    except ImpcError as error:
        return np.zeros(0), str(error)
    seen, parts = _Seen.of(problem, correction), []
    prepared = prepare_loop(controller, directions(controller, 0), seen.moves)
    for trial, drive in zip(problem.recordings, seen.drives, strict=True):
        run, _ = run_loop(prepared, drive, proved=False)
        if not run.complete:
            reason = f"sample {run.reached}: {Status(int(run.status[run.reached])).sentence}"
            return np.zeros(0), reason
        parts.append(seen.off(problem, trial, run).ravel())
    return np.concatenate(parts), ""


def residual_only(problem: Problem, gain: Array, metric: Array) -> Array:
    """Residual without derivatives; raises if the loop cannot be simulated."""
    controller, seen = controller_for(problem, gain, metric), _Seen.of(problem, None)
    return np.concatenate(
        [
            seen.off(problem, trial, simulate(controller, drive)).ravel()
            for trial, drive in zip(problem.recordings, seen.drives, strict=True)
        ]
    )


def _refused(problem: Problem, gain: Array, correction: Correction | None) -> str:
    """Reason not to simulate a gain, or an empty string.

    With bounds, unstable gains have spurious local minima: saturation and the end of the recording
    hide the divergence. Without bounds a search may pass through unstable gains.
    """
    plant = problem.plant
    bounded = problem.terminal_set or len(bound_rows(problem.bounds, plant).b) > 0
    if correction is not None or not bounded or stabilises(plant, gain):
        return ""
    return "the gain does not stabilise the plant"


@dataclass(frozen=True)
class _Seen:
    """How the recordings of a problem are simulated and compared with the simulation."""

    moves: tuple[Array, Array, Array] | None
    drives: list[Scenario]
    weighting: Array

    @classmethod
    def of(cls, problem: Problem, correction: Correction | None) -> _Seen:
        if correction is None:
            return cls(None, scenarios(problem), np.diag(1 / problem.output_scale))
        return cls(
            correction.moves(problem), correction.drives(problem), correction.weighting(problem)
        )

    def off(self, problem: Problem, trial: Recording, run: Simulation) -> Array:
        """(Simulated - recorded) / scale, shape (samples, q); zero for missing values."""
        if self.moves is None:
            return missed(problem, trial, run)
        found = np.nan_to_num(modelled(problem, trial, run) - recorded(problem, trial))
        p = len(self.weighting)
        return np.hstack([found[:, :p] @ self.weighting.T, found[:, p:] / problem.scale[p:]])


@dataclass(frozen=True)
class _Layout:
    """Column ranges of the derivative: gain, metric, unknowns of one trial, parameters."""

    gain: slice
    metric: slice
    own: slice
    parameters: slice

    @property
    def count(self) -> int:
        return int(self.parameters.stop)


def _layout(problem: Problem) -> _Layout:
    m, n = problem.plant.m, problem.plant.n
    sizes = (
        m * n,
        m * (m + 1) // 2 if m > 1 else 0,
        problem.own_unknowns,
        len(problem.logarithms),
    )
    ends = np.cumsum((0, *sizes)).tolist()
    return _Layout(*(slice(a, b) for a, b in itertools.pairwise(ends)))


def _plant_differential(problem: Problem) -> PlantDifferential | None:
    if problem.family is None:
        return None
    return plant_differential(problem.family, problem.logarithms)


def _all_directions(
    problem: Problem,
    controller: Controller,
    layout: _Layout,
    differential: PlantDifferential | None,
) -> Directions:
    (m, n), searched = controller.K.shape, problem.searched_states
    count = layout.count
    dK = np.zeros((m * n, count))
    dK[:, layout.gain] = np.eye(m * n)
    dS = np.zeros((m, m, count))
    if m > 1:
        rows, columns = np.tril_indices(m)
        at = np.arange(layout.metric.start, layout.metric.stop)
        dS[rows, columns, at] = dS[columns, rows, at] = 1.0
    dx0 = np.zeros((n, count))
    dx0[:searched, layout.own.start : layout.own.start + searched] = np.eye(searched)
    given = {"K": dK, "S": dS, "x0": dx0}
    if differential is not None:
        for name in ("A", "B", "E", "C", "observer"):
            part = getattr(differential, name)
            given[name] = np.zeros((*part.shape[:-1], count))
            given[name][..., layout.parameters] = part
    if differential is not None and problem.family is not None:
        bounds = bound_rows(controller.bounds, problem.plant)
        given["bounds"] = np.zeros((len(bounds.b), count))
        for place, control in problem.family.limits(problem.plant):
            given["bounds"][:, layout.parameters.start + place] = bounds.along_limit(control)
    along = directions(controller, count, **given)
    if differential is None:
        return along
    return replace(along, bodies=((),) * layout.parameters.start + differential.bodies)


def _slope(
    problem: Problem,
    seen: _Seen,
    trial: Recording,
    run: Simulation,
    moved: Sensitivity,
    layout: _Layout,
    differential: PlantDifferential | None,
) -> Array:
    """Derivative of `_Seen.off` (samples q, count), including parameters in C."""
    p = len(problem.plant.outputs)
    slope = measured_slope(problem, trial, moved, layout.own.start, seen.weighting)
    if differential is not None:
        on_outputs = np.tensordot(run.x, differential.C, ((1,), (1,)))  # (samples, p, k)
        slope[:, :p, layout.parameters] += on_outputs / problem.output_scale[:, None]
        slope[np.isnan(recorded(problem, trial))] = 0.0
    return slope.reshape(-1, layout.count)


def measured_slope(
    problem: Problem,
    trial: Recording,
    moved: Sensitivity,
    own: int | None = None,
    weighting: Array | None = None,
) -> Array:
    """Derivative of scaled outputs and commands (samples, q, k); zero for missing values.

    `moved.x` are those of the scaled outputs and may be overwritten. Offset columns follow the
    initial states, starting at column `own`.
    """
    outputs, W = problem.plant.outputs, weighting
    W, p, slope = np.diag(1 / problem.output_scale) if W is None else W, len(outputs), moved.x
    if len(problem.measured) > p:
        slope = np.zeros((trial.samples, len(problem.measured), moved.x.shape[2]))
        slope[:, :p] = moved.x
    for place, name in enumerate(problem.offsets if own is not None else ()):
        slope[:, :p, (own or 0) + problem.searched_states + place] += W[:, outputs.index(name)]
    if slope.shape[1] > p:
        slope[:-1, p:] = moved.u / problem.command_scale[:, None]
    slope[np.isnan(recorded(problem, trial))] = 0.0
    return slope


def residual_along(problem: Problem, controller: Controller, along: Directions) -> Array:
    """Derivative of the residual (r, k) along directions of the controller."""
    parts, prepared = [], prepare_loop(controller, along)
    for trial, drive in zip(problem.recordings, scenarios(problem), strict=True):
        _, moved = run_loop(prepared, drive, seen=problem.scaled_outputs)
        parts.append(measured_slope(problem, trial, moved).reshape(-1, along.count))
    return np.concatenate(parts)


def _symmetric(columns: Array, m: int) -> Array:
    """Derivatives along symmetric directions, expanded to (r, m, m)."""
    dS = np.zeros((len(columns), m, m))
    if m > 1:
        # An off-diagonal direction moves two entries: each gets half of the derivative.
        rows, places = np.tril_indices(m)
        dS[:, rows, places] = columns * np.where(rows == places, 1.0, 0.5)
        dS[:, places, rows] = dS[:, rows, places]
    return dS


def _difference(problem: Problem, seen: _Seen, trial: Recording, run: Simulation) -> Array:
    """Scaled residual (samples, q), set to a large value after the last feasible sample."""
    difference = seen.off(problem, trial, run)
    if not run.complete:
        difference[run.reached + 1 :] = _NOT_REACHED * _scale(problem, trial)
    return difference


def _scale(problem: Problem, trial: Recording) -> float:
    return float(np.sqrt(np.nanmean((trial.outputs / problem.output_scale) ** 2))) or 1.0


def unusable(problem: Problem, reason: str) -> Evaluation:
    """Evaluation with a large finite residual and a reason, so that a search rejects the step."""
    m, n = problem.plant.m, problem.plant.n
    residual = np.concatenate(
        [
            np.full(size, _NOT_REACHED * _scale(problem, trial))
            for size, trial in zip(problem.trial_sizes, problem.recordings, strict=True)
        ]
    )
    size, own = len(residual), problem.own_unknowns
    return Evaluation(
        residual,
        np.zeros((size, m, n)),
        np.zeros((size, m, m)),
        np.zeros((size, own)),
        np.zeros((size, len(problem.logarithms))),
        reason,
        0,
        0,
        None,
    )


def scaled_changes(metric: Array, changes: Array) -> Array:
    """Map `changes` (k, m, m) of a metric (m, m) to those of the metric scaled to trace m."""
    trace = np.trace(metric)
    shares = np.trace(changes, axis1=1, axis2=2)[:, None, None] / trace
    return np.asarray(len(metric) / trace * (changes - shares * metric))


@checked
def verify_hard(problem: Problem, weights: Weights) -> list[Simulation]:
    """Simulate every recording with hard state bounds and terminal set."""
    controller = weights_controller(problem, weights, hard=True)
    return [simulate(controller, drive) for drive in scenarios(problem)]


def keeps_hard(problem: Problem, weights: Weights) -> bool:
    """Whether all trials stay feasible with hard state bounds and terminal set."""
    return all(run.complete for run in verify_hard(problem, weights))
