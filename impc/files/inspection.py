"""Summary of a file's columns."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from impc.errors import InputError
from impc.files.checks import straight_lines
from impc.files.clock import read_clock, rejected_clocks
from impc.files.configuration import RecordingTable
from impc.files.draft import clock_guess, questions, rate_of
from impc.files.table import in_columns
from impc.files.units import si_unit

if TYPE_CHECKING:
    from impc.files.table import Table


@np.errstate(all="ignore")  # the mean of values of 1e308 overflows
def summary(table: Table, dt: float | None = None) -> str:
    """Table of the columns with the findings of their clock; `dt` of the plant in s, if known."""
    heads = ("column", "unit", "samples", "min", "max", "mean", "not finite", "rate")
    lines = [in_columns([heads, *(_row(table, name) for name in table.columns)], left=2)]
    if table.rate is not None:
        lines.append(f"The file states a rate of {table.rate:g} samples per second.")
    lines += _clock_findings(table, dt)
    rejected = rejected_clocks(table)
    for name, values in table.columns.items():
        if rate_of(values) is not None or name in rejected:
            continue
        lines += [f"Column {name!r}: {asked} ({line})" for line, asked in questions(table, name)]
        if (found := straight_lines(values)) is not None:
            said = f"is a straight line from sample {found[0] + 1} to {found[1] + 1}"
            lines.append(f"Column {name!r} {said}: a gap that was filled by interpolation?")
    lines += [f"Not read: {name} {reason}" for name, reason in table.skipped.items()]
    lines += [f"Note: {note}" for note in table.notes]
    return "\n".join(lines)


def _row(table: Table, name: str) -> tuple[str, ...]:
    values = table.columns[name]
    finite = values[np.isfinite(values)]
    numbers = (
        tuple(f"{value:.6g}" for value in (finite.min(), finite.max(), finite.mean()))
        if len(finite)
        else ("-", "-", "-")
    )
    rate = rate_of(values)
    return (
        name,
        table.units.get(name, ""),
        str(len(values)),
        *numbers,
        str(len(values) - len(finite)),
        "" if rate is None else f"{rate:.6g}",
    )


def _clock_findings(table: Table, dt: float | None) -> list[str]:
    """Findings of the clock that the draft names, or of the rate of the file."""
    recording = RecordingTable()
    if (clock := clock_guess(table)) is not None:
        longest = float(np.diff(table.columns[clock.column]).max()) * si_unit(clock.unit).factor
        fill_gaps = longest if dt is None else None
        recording = RecordingTable(time=clock.column, time_unit=clock.unit, fill_gaps=fill_gaps)
    elif table.rate is None:
        faults = rejected_clocks(table).items()
        return [f"{table.source}: clock {name!r} {'; '.join(fault)}" for name, fault in faults]
    try:
        used = read_clock(table, recording, dt or 0.0)
    except InputError as error:
        return [str(error)]
    found = [*used.findings, *used.notes]
    return found if dt else [one.removesuffix(": interpolated") for one in found]
