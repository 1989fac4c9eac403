"""`impc fit` of a problem of the user's own: its settings, its recordings in files, and the fit.

A state is wanted at the instants k dt, an input and a disturbance as held from k dt to
(k + 1) dt (`impc.files.resampling`). A signal without a column, and on the problem's own clock a
sample that is missing, is NaN: not measured. What stands in the last row of an input acts behind
the recording and is not used. docs/nonlinear.md.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import msgspec
import numpy as np

from impc.arrays import Array, Frozen
from impc.checking import replace
from impc.errors import InputError, brief
from impc.files import checks
from impc.files.clock import on_even_instants, read_clock
from impc.files.configuration import FILL_IN, require_known
from impc.files.formats import read_table
from impc.files.reading import (
    channel_of,
    label_of,
    require_distinct,
    require_filled_in,
    require_kind,
    told_unit,
)
from impc.files.resampling import held_means, instants, same_rate
from impc.files.units import si_unit
from impc.model.signal_units import UNKNOWN
from impc.nonlinear.fit import fit_optimal_control
from impc.nonlinear.page import OptimalFit
from impc.nonlinear.plan import require_solver
from impc.studies.fit.settings import read_settings

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from impc.files.clock import Clock
    from impc.files.configuration import Configuration
    from impc.files.table import Table
    from impc.model.recordings import Label
    from impc.nonlinear.problem import OptimalControlProblem
    from impc.nonlinear.recordings import OptimalRecording


@dataclass(frozen=True, eq=False)
class OptimalTrial(Frozen):
    """One file, in SI units on the problem's clock."""

    label: Label
    x: Array  # States (steps + 1, n); NaN where they were not measured
    u: Array  # Inputs (steps, m); NaN where they were not measured
    d: Array  # Disturbances, of shape (steps, d)
    dt: float  # Sample time, s
    findings: tuple[str, ...]  # What was let pass


def read_optimal_trials(
    paths: Sequence[Path], configuration: Configuration, problem: OptimalControlProblem
) -> tuple[OptimalTrial, ...]:
    """Read one recording from each of the `paths`.

    The `configuration` names a column for each disturbance of the `problem`, and for the states and
    inputs that were measured. Without a sample time of the problem that of each file is taken.
    """
    known = (*problem.state_names, *problem.input_names, *problem.disturbance_names)
    require_known("signals.{}".format, configuration.signals, known, "is no signal of the problem")
    for name, entry in configuration.signals.items():
        require_filled_in(name, entry)
        if entry.shift:
            unused = "is not used by an optimal control problem"
            raise InputError(f"signals.{name}.shift", unused, "shift the column in the file")
        require_kind(name, entry.unit, problem.signal_units.get(name, UNKNOWN))
    for name in problem.disturbance_names:
        if name not in configuration.signals:
            raise InputError(f"signals.{name}", "is missing", "a disturbance has to be recorded")
    require_distinct(paths)
    sheet = configuration.recording.sheet
    return tuple(_trial(read_table(path, sheet=sheet), configuration, problem) for path in paths)


def _trial(
    table: Table, configuration: Configuration, problem: OptimalControlProblem
) -> OptimalTrial:
    entry = configuration.recording
    label, clock = label_of(table.source, entry), read_clock(table, entry)
    dt = clock.period if problem.dt is None else problem.dt
    checks.comparable_rates(table.source, clock.period, dt)
    findings, columns = list(clock.findings), {}
    for name in configuration.signals:
        held = name not in problem.state_names
        columns[name], found = _series(table, clock, configuration, name, dt, held)
        findings += found
    # A configuration names a signal, so there is a column.
    samples = len(next(iter(columns.values())))
    checks.too_few(table.source, samples, 2)

    def side_by_side(names: Sequence[str]) -> Array:
        found = np.full((samples, len(names)), np.nan)
        for index, name in enumerate(names):
            found[:, index] = columns.get(name, np.nan)
        return found

    x, u, d = map(
        side_by_side, (problem.state_names, problem.input_names, problem.disturbance_names)
    )
    return OptimalTrial(label, x, u[:-1], d[:-1], dt, tuple(findings))


def _series(
    table: Table, clock: Clock, configuration: Configuration, name: str, dt: float, held: bool
) -> tuple[Array, list[str]]:
    """A signal on the problem's clock, and what was let pass."""
    entry = configuration.signals[name]
    channel = channel_of(table, clock, name, entry)
    found = [
        checks.unit_of_the_file(channel, told_unit(table, channel.column), entry.overrule_unit),
        checks.measurable(channel),
        "" if entry.limit is None else checks.beyond_the_stop(channel, entry.limit),
    ]
    values = channel.values * channel.unit.factor
    if clock.even and same_rate(len(values), clock.period, dt):
        lost = ~np.isfinite(values[:-1] if held else values)
        values = np.where(np.isfinite(values), values, np.nan)
        if np.any(lost):
            first = channel.at(int(np.argmax(lost)))
            found.append(
                f"{channel.name}: {int(lost.sum())} samples are missing, the first {first}; they "
                "count as not measured"
            )
    else:
        found.append(checks.missing(channel, configuration.recording.fill_gaps))
        resample = held_means if held else instants
        values = resample(on_even_instants(clock, values), clock.period, dt)
    return values, [finding for finding in found if finding]


@dataclass(frozen=True)
class ParameterSettings:
    """A parameter of the problem: where its search begins, or its value."""

    start: float | None = None  # First value of a search
    known: float | None = None  # Its value, when it is not searched
    unit: str = ""  # Of the number; that of the problem where it is empty


@dataclass(frozen=True)
class OptimalFitSettings:
    """What a user may set of the fit of an optimal control problem."""

    # Every parameter of the problem by its name
    parameters: dict[str, ParameterSettings] = field(default_factory=dict)
    # Whether a recording is of a controller that plans anew at every sample, or is one plan
    recorded: Literal["loop", "plan"] = "loop"
    horizon: int | None = None  # In samples, in place of the problem's
    # Initial values of states, in SI units, in place of what was recorded
    x0: dict[str, float] = field(default_factory=dict)
    # Whether initial states are searched, from what was recorded of them and from `x0`
    unknown_start: bool = True
    solver: str = "ipopt"  # One of `impc.nonlinear.plan.SOLVERS`
    evaluations: Annotated[int, msgspec.Meta(ge=1, le=100_000)] = (
        200  # After how many a search is stopped
    )
    # From how many starts, where the first explains little or has no plan
    starts: Annotated[int, msgspec.Meta(ge=1, le=1000)] = 5


def optimal_fit_settings(table: Mapping[str, Any]) -> OptimalFitSettings:
    """Read the [fit] table of a configuration."""
    given = table.get("parameters", {})
    places = {"[fit]": table}
    for name, item in given.items() if isinstance(given, dict) else ():
        place = f"[fit.parameters] {brief(name, 80)}"
        if not isinstance(item, dict):
            raise InputError(place, f"got {brief(item)}", "write it as in { start = 1.0 }")
        known = ParameterSettings.__dataclass_fields__
        require_known(f"{place}.{{}}".format, item, known, "is not a setting")
        places[place] = item
    for place, entries in places.items():
        for key, value in entries.items():
            if value == FILL_IN:
                raise InputError(f"{place} {key}", f"is still {FILL_IN!r}", "fill it in")
    settings = read_settings("fit", OptimalFitSettings, table)
    for name, one in settings.parameters.items():
        if (one.start is None) == (one.known is None):
            raise InputError(
                f"[fit.parameters] {brief(name, 80)}",
                "has both start and known" if one.known is not None else "has no number",
                "give start for one that is searched, or known",
            )
    require_solver(settings.solver)
    return settings


def _require_own(table: str, given: Iterable[str], known: Sequence[str], kind: str) -> None:
    for name in given:
        if name not in known:
            has = f"it has {', '.join(known)}"
            raise InputError(f"[fit.{table}] {brief(name, 80)}", f"is no {kind}", has)


def posed(
    problem: OptimalControlProblem, settings: OptimalFitSettings
) -> tuple[OptimalControlProblem, dict[str, float], dict[str, float]]:
    """The problem as it is fitted, where the search begins, and what is known; by name."""
    names, kind = problem.parameter_names, "parameter of the problem"
    _require_own("parameters", settings.parameters, names, kind)
    start: dict[str, float] = {}
    known: dict[str, float] = {}
    for name, unit in zip(names, problem.units, strict=True):
        one = settings.parameters.get(name)
        if one is None:
            raise InputError(f"[fit.parameters] {name}", "is missing", "give it start or known")
        factor = _factor(name, one.unit, unit)
        if one.known is not None:
            known[name] = factor * one.known
        elif one.start is not None:
            start[name] = factor * one.start
    if settings.horizon is not None:
        problem = problem.with_horizon(settings.horizon)
    return (problem.with_known(known) if known else problem), start, known


def _factor(name: str, written: str, expected: str) -> float:
    """From the unit that is written to that of the problem."""
    if not written:
        return 1.0
    unit, own = si_unit(written), si_unit(expected) if expected else None
    if own is not None and own.base != unit.base:
        raise InputError(
            f"[fit.parameters] {name}.unit", f"is {written!r}, and the problem has {expected}",
            "correct the unit",
        )  # fmt: skip
    return unit.factor / (1.0 if own is None else own.factor)


def recorded(
    problem: OptimalControlProblem, trial: OptimalTrial, settings: OptimalFitSettings
) -> OptimalRecording:
    """A file as a recording of the problem."""
    _require_own("x0", settings.x0, problem.state_names, "state")
    first = dict(zip(problem.state_names, trial.x[0], strict=True)) | settings.x0
    for name, value in first.items():
        if np.isnan(value):
            raise InputError(
                f"[fit.x0] {name}", "is missing, and was not recorded",
                "give it, or a guess with unknown_start = true",
            )  # fmt: skip
    make = problem.recorded_plan if settings.recorded == "plan" else problem.recorded_loop
    x0 = list(first.values())
    return make(trial.x, trial.u, d=trial.d, x0=x0, unknown_start=settings.unknown_start)


def fit_files(
    problem: OptimalControlProblem,
    files: Sequence[Path],
    configuration: Configuration,
    solver: str | None,
) -> OptimalFit:
    """Read recordings of a problem from files, and fit it as the configuration says."""
    settings = optimal_fit_settings(configuration.fit)
    if solver is not None:
        require_solver(solver)
        settings = replace(settings, solver=solver)
    units = dict(zip(problem.parameter_names, problem.units, strict=True))
    fitted, start, known = posed(problem, settings)
    trials = read_optimal_trials(files, configuration, fitted)
    recordings = [recorded(fitted, trial, settings) for trial in trials]
    estimate = fit_optimal_control(
        fitted,
        recordings,
        start,
        solver=settings.solver,
        evaluations=settings.evaluations,
        starts=settings.starts,
    )
    return OptimalFit(
        estimate,
        tuple(str(trial.label) for trial in trials),
        tuple(trial.findings for trial in trials),
        trials[0].dt,
        {name: (value, units[name]) for name, value in known.items()},
        asdict(settings),
    )
