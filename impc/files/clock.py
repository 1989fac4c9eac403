"""The clock of a recording: its period, its gaps, its jitter, and values on even instants."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.interpolate

from impc.checking import replace
from impc.errors import DataError, InputError
from impc.files.units import si_unit

if TYPE_CHECKING:
    from impc.arrays import Array, BoolArray, IntArray
    from impc.files.configuration import RecordingTable
    from impc.files.table import Table

# An interval this many periods long has lost a sample.
_GAP = 1.5
# Deviation from an even clock, in periods, from which it is a finding and values are interpolated.
_JITTER = 0.01
# Two statements of the rate that differ by more than this contradict each other.
_RATE = 1e-3
# What no recorder has: a clock beyond 30 000 years (1.7e9 s is a count from 1970), a period outside
# of these, in s, and more even instants for each sample, where gaps may be filled.
_LONGEST, _PERIODS, _GAPS = 1e12, (1e-9, 1e6), 10


@dataclass(frozen=True)
class Clock:
    """When the samples were taken."""

    time: Array  # (samples,), s, on the file's clock
    rows: slice  # The rows of the file that are used, after the cut
    steps: IntArray  # (samples,): even instant at which each sample was taken; 0 for the first
    start: float  # s; the even instants are start + k period
    period: float
    findings: tuple[str, ...] = ()  # Gaps and jitter that were let pass
    note: str = ""  # How its numbers were read, where nothing says it; empty otherwise

    @property
    def even(self) -> bool:
        """Whether the samples stand on the even instants, so that they need no interpolation."""
        return not self.findings


def read_clock(table: Table, recording: RecordingTable) -> Clock:
    """Read the clock, cut the recording, and check that its instants are even."""
    if recording.time is None:
        rate = _stated_rate(table, recording)
        _require_period(table.source, 1 / rate)
        time = np.arange(table.samples) / rate
        rows = _cut(table.source, time, recording)
        steps = np.arange(rows.stop - rows.start)
        return Clock(time[rows], rows, steps, float(time[rows.start]), 1 / rate)
    name, values = column_of(table, recording.time, "recording.time")
    subject = f"{table.source}: clock {name!r}"
    days = not recording.time_unit and name not in table.units and counts_days(values)
    stated = recording.time_unit or table.units.get(name) or ("day" if days else "s")
    try:
        unit = si_unit(stated)
    except InputError as error:
        remedy = 'write recording.time_unit = "s" or "ms"'
        raise DataError(subject, f"is in {error.subject}, which {error.problem}", remedy) from None
    if unit.base != "second":
        raise DataError(subject, f"has the unit {unit.written!r}", 'write time_unit = "s" or "ms"')
    _require_rising(subject, values)
    time = values * unit.factor
    if (furthest := float(max(abs(time[0]), abs(time[-1])))) > _LONGEST:
        remedy = "correct the clock, or recording.time_unit"
        raise DataError(subject, f"reaches {furthest:.3g} s", remedy)
    rows = _cut(table.source, time, recording)
    note = f"{subject}: read as day numbers of a spreadsheet" if days else ""
    return replace(_measured(subject, time[rows], rows, recording.fill_gaps), note=note)


def counts_days(values: Array) -> bool:
    """Whether a clock without a unit, `values` (samples,), has day numbers of Excel or MATLAB.

    Days since 1900 or the year 0; as seconds the recording would last less than a tenth of one.
    """
    first, last = float(values[0]), float(values[-1])
    return (2e4 < first < 1e5 or 6e5 < first < 9e5) and 0 < last - first < 0.1


def column_of(table: Table, name: str, place: str) -> tuple[str, Array]:
    """A column by its `name`, with or without the unit behind it: its name in the file, its values.

    The values are (samples,); `place` is the key of the configuration that gives the name.
    """
    short = name.rpartition(" (")[0] or name.rpartition(" [")[0]
    for known in (name, short):
        if known in table.columns:
            return known, table.columns[known]
    skipped = next(
        (
            f"{known} {reason}"
            for known, reason in table.skipped.items()
            if name == known or name.startswith((f"{known}.", f"{known}_"))
        ),
        None,
    )
    if skipped is not None:
        raise DataError(f"{table.source}: column {name!r}", "cannot be used", skipped)
    names = ", ".join(list(table.columns)[:12])
    more = ", ..." if len(table.columns) > 12 else ""
    raise DataError(
        f"{table.source}: column {name!r}", "is not in the file", f"{place} may be {names}{more}"
    )


def on_even_instants(clock: Clock, values: Array) -> Array:
    """The `values` (samples,) at start + k period (instants,), of which there are steps[-1] + 1.

    Akima's interpolation where samples are missing, NaN, or late; the values themselves where the
    clock is even and all are finite. The first and the last are.
    """
    finite = np.isfinite(values)
    if clock.even and finite.all():
        return values
    instants = clock.start + clock.period * np.arange(clock.steps[-1] + 1)
    # A late first sample is taken as it is; nothing is extrapolated.
    inside = np.clip(instants, clock.time[0], clock.time[-1])
    spline = scipy.interpolate.Akima1DInterpolator(
        clock.time[finite], values[finite], method="makima"
    )
    return np.asarray(spline(inside), dtype=np.float64)


def _stated_rate(table: Table, recording: RecordingTable) -> float:
    given, stated = recording.rate, table.rate
    if given is None and stated is None:
        raise DataError(
            table.source,
            "gives no clock and no rate",
            "name the column with recording.time, or give recording.rate",
        )
    if given is not None and stated is not None and abs(given - stated) > _RATE * stated:
        raise DataError(
            table.source,
            f"says {stated:g} samples per second and recording.rate {given:g}",
            "correct recording.rate or leave it out",
        )
    rate = given if given is not None else stated
    assert rate is not None
    return rate


def _require_rising(subject: str, values: Array) -> None:
    missing = ~np.isfinite(values)
    if missing.any():
        raise DataError(
            subject,
            f"has {missing.sum()} missing times, the first in sample {np.argmax(missing) + 1}",
            "repair the clock, or give recording.rate instead",
        )
    with np.errstate(over="ignore"):  # a step of more than the largest number is a step
        backward = np.diff(values) <= 0
    if backward.any():
        first = int(np.argmax(backward))
        step = values[first + 1] - values[first]
        what = "is repeated" if step == 0 else "runs backward"
        raise DataError(
            subject,
            f"{what} {backward.sum()} times, the first from sample {first + 1} to {first + 2} "
            f"(at {values[first]:g})",
            "remove the repeated rows, or give recording.rate instead",
        )


def _cut(source: str, time: Array, recording: RecordingTable) -> slice:
    slack = 1e-9 * max(abs(time[0]), abs(time[-1]), 1.0)
    start = -np.inf if recording.start is None else recording.start - slack
    stop = np.inf if recording.stop is None else recording.stop + slack
    kept = np.flatnonzero((time >= start) & (time <= stop))
    if len(kept) < 2:
        raise DataError(
            source,
            f"has {len(kept)} samples between recording.start and stop",
            f"its clock runs from {time[0]:g} to {time[-1]:g} s",
        )
    for key, wanted, reached in (
        ("start", recording.start, float(time[0])),
        ("stop", recording.stop, float(time[-1])),
    ):
        spare = float(np.median(np.diff(time[kept])))
        beyond = wanted is not None and (
            wanted < reached - spare if key == "start" else wanted > reached + spare
        )
        if beyond:
            raise DataError(
                source,
                f"does not reach recording.{key} = {wanted:g} s",
                f"its clock runs from {time[0]:g} to {time[-1]:g} s",
            )
    return slice(int(kept[0]), int(kept[-1]) + 1)


def _measured(subject: str, time: Array, rows: slice, fill_gaps: float) -> Clock:
    """Period by least squares over the samples, with gaps counted as whole periods."""
    intervals = np.diff(time)
    usual = intervals[intervals < _GAP * np.median(intervals)]
    rough = float(np.mean(usual))
    _require_period(subject, rough)
    if (instants := (time[-1] - time[0]) / rough) > _GAPS * len(time):
        problem = f"has {len(time)} samples on {instants:.3g} even instants: the rest are gaps"
        raise DataError(subject, problem, "cut with recording.start and stop")
    counts = np.rint(intervals / rough).astype(np.int64)
    if (counts == 0).any():
        first = int(np.argmax(counts == 0))
        raise DataError(
            subject,
            f"is uneven: an interval of {intervals[first]:.4g} s at {time[first]:.6g} s where "
            f"{rough:.4g} s are usual",
            "export with an even clock",
        )
    gaps = intervals > _GAP * rough
    findings = _gaps(subject, time, intervals, gaps, fill_gaps)
    steps = np.concatenate([[0], np.cumsum(counts)])
    period, start = (float(value) for value in np.polyfit(steps, time - time[0], 1))
    late = np.abs(time - time[0] - start - period * steps)
    if late.max() > _JITTER * period:
        worst = int(np.argmax(late))
        findings.append(
            f"{subject}: jitter, {np.sum(late > _JITTER * period)} of {len(time)} samples are off "
            f"an even clock by more than 1 % of its period, at most by {late.max() / period:.0%} "
            f"(at {time[worst]:.6g} s); values were interpolated"
        )
    return Clock(time, rows, steps, float(time[0]) + start, period, tuple(findings))


def _gaps(
    subject: str, time: Array, intervals: Array, gaps: BoolArray, fill_gaps: float
) -> list[str]:
    if not gaps.any():
        return []
    longest = int(np.argmax(intervals))
    found = (
        f"{gaps.sum()} gaps, the first at {time[np.argmax(gaps)]:.6g} s, the longest of "
        f"{intervals[longest]:.4g} s at {time[longest]:.6g} s"
    )
    if intervals[longest] > fill_gaps * (1 + 1e-9):
        raise DataError(
            subject,
            f"has {found}",
            f"cut with recording.start and stop, or allow recording.fill_gaps "
            f"(now {fill_gaps:g} s)",
        )
    return [f"{subject}: {found}; filled by interpolation"]


def _require_period(subject: str, period: float) -> None:
    """Require that a recorder can have the `period`, in s."""
    if not _PERIODS[0] <= period <= _PERIODS[1]:
        raise DataError(
            subject,
            f"has a sample every {period:.3g} s",
            f"correct the rate or the clock's unit: {_PERIODS[0]:g} to {_PERIODS[1]:g} s can be",
        )
