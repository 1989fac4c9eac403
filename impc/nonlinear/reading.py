"""Recordings from files for an optimal control problem: its states and inputs by name.

A state is wanted at the instants k dt, an input and a disturbance as held from k dt to
(k + 1) dt (`impc.files.resampling`). A signal without a column, and on the problem's own clock a
sample that is missing, is NaN: not measured. What stands in the last row of an input acts behind
the recording and is not used.
"""

from __future__ import annotations

import difflib
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Array, Frozen, frozen
from impc.errors import InputError
from impc.files import checks, measurable
from impc.files.clock import on_even_instants, read_clock
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
from impc.model.signal_units import UNKNOWN

if TYPE_CHECKING:
    from collections.abc import Sequence

    from impc.files.clock import Clock
    from impc.files.configuration import Configuration
    from impc.files.table import Table
    from impc.model.recordings import Label
    from impc.nonlinear.problem import OptimalControlProblem


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
    _require_names(configuration, problem)
    require_distinct(paths)
    sheet = configuration.recording.sheet
    return tuple(_trial(read_table(path, sheet=sheet), configuration, problem) for path in paths)


def _require_names(configuration: Configuration, problem: OptimalControlProblem) -> None:
    known = (*problem.state_names, *problem.input_names, *problem.disturbance_names)
    for name, entry in configuration.signals.items():
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1)
            remedy = f"did you mean {near[0]}?" if near else f"it has {', '.join(known)}"
            raise InputError(f"signals.{name}", "is no signal of the problem", remedy)
        require_filled_in(name, entry)
        if entry.shift:
            unused = "is not used by an optimal control problem"
            raise InputError(f"signals.{name}.shift", unused, "shift the column in the file")
        require_kind(name, entry.unit, problem.signal_units.get(name, UNKNOWN))
    for name in problem.disturbance_names:
        if name not in configuration.signals:
            raise InputError(f"signals.{name}", "is missing", "a disturbance has to be recorded")


def _trial(
    table: Table, configuration: Configuration, problem: OptimalControlProblem
) -> OptimalTrial:
    entry = configuration.recording
    label, clock = label_of(table.source, entry), read_clock(table, entry)
    dt = clock.period if problem.dt is None else problem.dt
    measurable.comparable_rates(table.source, clock.period, dt)
    findings = list(clock.findings)
    columns: dict[str, Array] = {}
    for name in configuration.signals:
        values, found = _series(table, clock, configuration, name, problem)
        columns[name] = values
        findings += found
    # A configuration names a signal, so there is a column.
    samples = len(next(iter(columns.values())))
    checks.too_few(table.source, samples, 2)
    absent = np.full(samples, np.nan)

    def side_by_side(names: Sequence[str]) -> Array:
        return np.array([columns.get(name, absent) for name in names]).reshape(-1, samples).T

    return OptimalTrial(
        label,
        frozen(side_by_side(problem.state_names)),
        frozen(side_by_side(problem.input_names)[:-1]),
        frozen(side_by_side(problem.disturbance_names)[:-1]),
        dt,
        tuple(findings),
    )


def _series(
    table: Table,
    clock: Clock,
    configuration: Configuration,
    name: str,
    problem: OptimalControlProblem,
) -> tuple[Array, list[str]]:
    """A signal on the problem's clock, and what was let pass."""
    entry = configuration.signals[name]
    channel = channel_of(table, clock, name, entry)
    found = [
        checks.unit_of_the_file(channel, told_unit(table, channel.column), entry.overrule_unit),
        measurable.size(channel),
        "" if entry.limit is None else checks.beyond_the_stop(channel, entry.limit),
    ]
    dt = clock.period if problem.dt is None else problem.dt
    values = channel.values * channel.unit.factor
    if clock.even and same_rate(len(values), clock.period, dt):
        held = name not in problem.state_names
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
        resample = instants if name in problem.state_names else held_means
        values = resample(on_even_instants(clock, values), clock.period, dt)
    return values, [finding for finding in found if finding]
