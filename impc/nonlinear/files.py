"""`impc fit` of an optimal control problem: settings, recordings in files, and the fit.

States are resampled to the instants k dt, inputs and disturbances to means over k dt to (k + 1) dt
(`impc.files.resampling`). Signals without a column, and missing samples on the problem's own clock,
are NaN (not measured). The last row of an input is not used.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import Meta

from impc.arrays import Array
from impc.checking import replace
from impc.errors import InputError, brief
from impc.files import checks
from impc.files.clock import Clock, on_even_instants, read_clock
from impc.files.configuration import Configuration, converted, require_known
from impc.files.formats import read_table
from impc.files.reading import (
    channel_of,
    label_of,
    require_distinct,
    stated_unit,
    unit_faults,
)
from impc.files.resampling import held_means, instants, same_rate
from impc.files.table import Table
from impc.files.units import si_unit
from impc.model.plant import UNKNOWN
from impc.nonlinear.closed_loop import OptimalRecording
from impc.nonlinear.fit import fit_optimal_control
from impc.nonlinear.page import OptimalFit
from impc.nonlinear.plan import require_solver
from impc.nonlinear.problem import OptimalControlProblem
from impc.studies.fit.settings import read_settings


class ParameterSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A parameter of the problem: starting value, or known value.

    Attributes
    ----------
    start : float, optional
        Starting value of the search, if the parameter is estimated.
    known : float, optional
        Value of the parameter, if it is not estimated. Give either `start` or `known`.
    unit : str, optional
        Unit of the number; by default that of the problem.
    """

    start: float | None = None
    known: float | None = None
    unit: str = ""

    def __post_init__(self) -> None:
        if (self.start is None) == (self.known is None):
            raise ValueError(
                "needs start or known" if self.known is None else "has both start and known"
            )


@dataclass(frozen=True)
class OptimalFitSettings:
    """Settings of the fit of an optimal control problem.

    Attributes
    ----------
    parameters : table
        Every parameter of the problem by name, with `start` or `known`.
    recorded : "loop" or "plan", optional
        Whether a recording is a closed loop that replans at every sample, or a single plan.
    horizon : int, optional
        Prediction horizon in samples; by default that of the problem.
    x0 : table, optional
        Initial values of states in SI units; by default the first recorded values.
    unknown_start : bool, optional
        Whether initial states are estimated, starting from these values.
    solver : str, optional
        Solver of the plans: "ipopt" or "fatrop".
    evaluations : int, optional
        Budget of evaluations for each start of the search.
    starts : int, optional
        Number of starts, used if the first explains little or has no plan.
    """

    parameters: dict[str, Any] = field(default_factory=dict)
    recorded: Literal["loop", "plan"] = "loop"
    horizon: int | None = None
    x0: dict[str, float] = field(default_factory=dict)
    unknown_start: bool = True
    solver: str = "ipopt"
    evaluations: Annotated[int, Meta(ge=1)] = 200
    starts: Annotated[int, Meta(ge=1, le=1000)] = 5


def optimal_fit_settings(table: Mapping[str, Any]) -> OptimalFitSettings:
    """Read the [fit] table of a configuration."""
    settings = read_settings("fit", OptimalFitSettings, table)
    require_solver(settings.solver)
    parameters = {}
    for name, item in settings.parameters.items():

        def where(path: str, name: str = name) -> str:
            return f"[fit.parameters] {brief(name, 80)} {path.lstrip('.')}".rstrip()

        remedy = "write { start = 1.0 } or { known = 1.0 }"
        parameters[name] = converted(where, item, ParameterSettings, remedy)
    return replace(settings, parameters=parameters)


def posed(
    problem: OptimalControlProblem, settings: OptimalFitSettings
) -> tuple[OptimalControlProblem, dict[str, float], dict[str, float]]:
    """Problem as fitted, starting values and known values by name."""
    _require_own("parameters", settings.parameters, problem.parameter_names, "parameter")
    start: dict[str, float] = {}
    known: dict[str, float] = {}
    for name in problem.parameter_names:
        if (one := settings.parameters.get(name)) is None:
            raise InputError(f"[fit.parameters] {name}", "is missing", "give it start or known")
        factor = _factor(name, one.unit, problem.units.get(name, "")) if one.unit else 1.0
        if one.known is None:
            start[name] = factor * one.start
        else:
            known[name] = factor * one.known
    if settings.horizon is not None:
        problem = problem.with_horizon(settings.horizon)
    return (problem.with_known(known) if known else problem), start, known


def _factor(name: str, written: str, expected: str) -> float:
    """Factor from the unit `written` to that of the problem."""
    unit, own = si_unit(written), si_unit(expected or written)
    if own.base != unit.base:
        raise InputError(
            f"[fit.parameters] {name}.unit", f"is {written!r}, but the problem has {expected}",
            "correct the unit",
        )  # fmt: skip
    return unit.factor / (own.factor if expected else 1.0)


def _require_own(table: str, given: Iterable[str], known: Sequence[str], kind: str) -> None:
    for name in given:
        if name not in known:
            has = f"it has {', '.join(known)}"
            raise InputError(
                f"[fit.{table}] {brief(name, 80)}", f"is no {kind} of the problem", has
            )


def require_signals(configuration: Configuration, problem: OptimalControlProblem) -> None:
    """Require that the configuration names signals of the problem, and all disturbances."""
    known = (*problem.state_names, *problem.input_names, *problem.disturbance_names)
    require_known("signals.{}".format, configuration.signals, known, "is no signal of the problem")
    for name, entry in configuration.signals.items():
        expected = problem.units.get(name, UNKNOWN)
        for fault in unit_faults(name, entry, expected, configuration.source):
            raise fault
        for key, given, remedy in (
            ("shift", entry.shift != 0, "shift the column in the file"),
            ("target", entry.target is not None, "make it a disturbance that the cost uses"),
        ):
            if given:
                unused = "is not used by an optimal control problem"
                raise InputError(f"signals.{name}.{key}", unused, remedy)
    for name in problem.disturbance_names:
        if name not in configuration.signals:
            raise InputError(f"signals.{name}", "is missing", "record every disturbance")


def read_recording(
    table: Table, clock: Clock, configuration: Configuration, problem: OptimalControlProblem,
    settings: OptimalFitSettings,
) -> tuple[OptimalRecording, list[str]]:  # fmt: skip
    """Read a file as a recording of the problem in SI units at its rate, with findings."""
    dt = problem.dt or clock.period
    checks.comparable_rates(table.source, clock.period, dt)
    findings, columns = list(clock.findings), {}
    for name in configuration.signals:
        held = name not in problem.state_names
        columns[name], found = _series(table, clock, configuration, name, dt, held)
        findings += found
    # The configuration names at least one signal.
    nothing = np.full(len(next(iter(columns.values()))), np.nan)
    checks.too_few(table.source, len(nothing), 2)
    groups = (problem.state_names, problem.input_names, problem.disturbance_names)
    x, u, d = (np.array([columns.get(name, nothing) for name in group]).reshape(-1, len(nothing)).T
               for group in groups)  # fmt: skip
    make = problem.recorded_plan if settings.recorded == "plan" else problem.recorded_loop
    start = first_state(problem, x[0], settings)
    made = make(x, u[:-1], d=d[:-1], x0=start, unknown_start=settings.unknown_start)
    return made, findings


def first_state(
    problem: OptimalControlProblem, recorded: Array, settings: OptimalFitSettings
) -> list[float]:
    """Initial state from the settings, or as `recorded` (n,)."""
    _require_own("x0", settings.x0, problem.state_names, "state")
    first = dict(zip(problem.state_names, recorded, strict=True)) | settings.x0
    for name, value in first.items():
        if np.isnan(value):
            raise InputError(
                f"[fit.x0] {name}", "is missing, and was not recorded",
                "set it; a guess suffices with unknown_start = true",
            )  # fmt: skip
    return list(first.values())


def _series(
    table: Table, clock: Clock, configuration: Configuration, name: str, dt: float, held: bool
) -> tuple[Array, list[str]]:
    """A signal at the problem's rate, and findings."""
    entry = configuration.signals[name]
    channel = channel_of(table, clock, name, entry)
    found = [
        checks.unit_of_the_file(channel, stated_unit(table, channel.column), entry.overrule_unit),
        checks.measurable(channel),
        None if entry.limit is None else checks.beyond_the_stop(channel, entry.limit),
    ]
    values = channel.values * channel.unit.factor
    if clock.even and same_rate(len(values), clock.period, dt):
        lost = ~np.isfinite(values[:-1] if held else values)
        values = np.where(np.isfinite(values), values, np.nan)
        if np.any(lost):
            first = channel.at(int(np.argmax(lost)))
            said = f"{int(lost.sum())} samples are missing, the first {first}"
            found.append(channel.finding(f": {said}; they count as not measured"))
    else:
        found.append(checks.missing(channel, clock.fill_gaps))
        resample = held_means if held else instants
        values = resample(on_even_instants(clock, values), clock.period, dt)
    return values, [finding.text for finding in found if finding]


def fit_files(
    problem: OptimalControlProblem,
    files: Sequence[Path],
    configuration: Configuration,
    solver: str | None,
) -> OptimalFit:
    """Read recordings of a problem from files, and fit it with the settings of [fit]."""
    settings = optimal_fit_settings(configuration.fit)
    if solver is not None:
        settings = replace(settings, solver=require_solver(solver))
    fitted, start, known = posed(problem, settings)
    require_signals(configuration, fitted)
    require_distinct(files)
    entry, recordings, labels, findings, dt = configuration.recording, [], [], [], problem.dt
    for path in files:
        table = read_table(path, sheet=entry.sheet)
        label, clock = label_of(table.source, entry), read_clock(table, entry, problem.dt or 0)
        recording, found = read_recording(table, clock, configuration, fitted, settings)
        recordings.append(recording)
        labels.append(str(label))
        findings.append(tuple(found))
        dt = dt or clock.period
    estimate = fit_optimal_control(
        fitted, recordings, start, solver=settings.solver, evaluations=settings.evaluations,
        starts=settings.starts,
    )  # fmt: skip
    units = {name: (value, problem.units.get(name, "")) for name, value in known.items()}
    made = msgspec.to_builtins(settings)
    return OptimalFit(estimate, tuple(labels), tuple(findings), dt, units, made)
