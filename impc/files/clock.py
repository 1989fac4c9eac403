"""The clock of a recording: period, gaps and jitter; resampling to uniform instants."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from impc.arrays import Array, IntArray
from impc.checking import replace
from impc.errors import DataError, InputError, blamed
from impc.files.alignment import GAP, named_clock, rising, usual_step
from impc.files.checks import missing_code
from impc.files.configuration import RecordingTable
from impc.files.table import Table
from impc.files.units import si_unit

# Deviation from a uniform clock, in periods, that is reported and makes values be interpolated.
_JITTER = 0.01
# Largest relative difference of two clocks that is that of two devices and not of two units.
_APART = 0.02
_UNITS = np.array([1, 60, 3600, 86400])  # of a clock, in s, times any power of ten
# Deviation of a step from a whole multiple of the usual one, in periods, in a clock or counter.
_UNEVEN = 0.05
# A file holds at most this many trials of at least so many samples, with a clock of which this
# share of steps is the usual one.
_TRIALS, _TRIAL, _EVEN = 50, 50, 0.9
_RISES = 0.9  # least part of the steps of a clock that are upward
# Relative difference above which two statements of the rate contradict each other.
_RATE = 1e-3
_TIME_UNIT = ("recording", "time_unit")
# Plausible: clocks below 30 000 years (1.7e9 s counts from 1970), periods in this range in s, and
# at most this many uniform instants for each sample, where gaps may be filled.
_LONGEST, _PERIODS, _GAPS = 1e12, (1e-9, 1e6), 10


@dataclass(frozen=True)
class Clock:
    """Sampling instants of a recording."""

    time: Array  # (samples,), s, on the file's clock
    rows: slice  # rows of the file that are used, after the cut
    steps: IntArray  # (samples,): index of the uniform instant of each sample; 0 for the first
    start: float  # s; the uniform instants are start + k period
    period: float  # s
    fill_gaps: float  # s, the longest gap that is interpolated
    findings: tuple[str, ...] = ()  # accepted gaps and jitter, for the report
    notes: tuple[str, ...] = ()  # how the clock was read, and columns that contradict it

    @property
    def even(self) -> bool:
        """Whether the samples lie on uniform instants and need no interpolation."""
        return not self.findings


def read_clock(table: Table, recording: RecordingTable, dt: float = 0.0) -> Clock:
    """Read the clock, cut, require uniform sampling; by default gaps up to `dt` s are filled."""
    fill_gaps = dt if recording.fill_gaps is None else recording.fill_gaps
    with blamed(table.source, "recording", "time"):
        return _read(table, recording, fill_gaps)


def _read(table: Table, recording: RecordingTable, fill_gaps: float) -> Clock:
    if recording.time is None:
        rate = _stated_rate(table, recording)
        _require_period(table.source, 1 / rate, "rate")
        time = np.arange(table.samples) / rate
        rows = _cut(table.source, time, recording)
        steps = np.arange(rows.stop - rows.start)
        clock = Clock(time[rows], rows, steps, float(time[rows.start]), 1 / rate, fill_gaps)
        return replace(clock, notes=_rows_lost(table, clock, None))
    name, values = column_of(table, recording.time, ("recording", "time"))
    subject = f"{table.source}: clock {name!r}"
    days = not recording.time_unit and name not in table.units and counts_days(values)
    stated = recording.time_unit or table.units.get(name) or ("day" if days else "s")
    try:
        unit = si_unit(stated)
    except InputError as error:
        remedy = 'write recording.time_unit = "s" or "ms"'
        problem = f"is in {error.subject}, which {error.problem}"
        raise DataError(subject, problem, remedy).at("", *_TIME_UNIT) from None
    if unit.base != "second":
        problem, remedy = f"has the unit {unit.written!r}", 'write time_unit = "s" or "ms"'
        raise DataError(subject, problem, remedy).at("", *_TIME_UNIT)
    if (fault := clock_fault(values)) is not None:
        raise DataError(subject, *fault)
    time = values * unit.factor
    if (furthest := float(max(abs(time[0]), abs(time[-1])))) > _LONGEST:
        remedy = "correct the clock, or recording.time_unit"
        raise DataError(subject, f"reaches {furthest:.3g} s", remedy).at("", *_TIME_UNIT)
    rows = _cut(table.source, time, recording)
    notes = (f"{subject}: read as day numbers of a spreadsheet",) if days else ()
    longest = "a model sample" if recording.fill_gaps is None else f"{fill_gaps:g} s"
    clock = _measured(subject, time[rows], rows, fill_gaps, longest)
    if table.rate is not None and abs(table.rate * clock.period - 1) > _RATE:
        stated = f"the file states {table.rate:g} samples per second"
        notes = (*notes, f"{subject} has {1 / clock.period:.4g} and {stated}")
    bad = rejected_clocks(table).items()
    others = (
        f"{table.source}: clock {other!r} {fault[0]}" for other, fault in bad if other != name
    )
    return replace(clock, notes=(*notes, *_rows_lost(table, clock, name), *others))


def counts_days(values: Array) -> bool:
    """Whether a clock without unit, `values` (samples,), holds day numbers of Excel or MATLAB.

    These are days since 1900 or year 0; read as seconds, the recording would last under 0.1 s.
    """
    first, last = float(values[0]), float(values[-1])
    return (2e4 < first < 1e5 or 6e5 < first < 9e5) and 0 < last - first < 0.1


def column_of(table: Table, name: str, place: tuple[str, ...]) -> tuple[str, Array]:
    """Name in the file and values (samples,) of column `name`, with or without its unit.

    `place` is the TOML path that names the column, for messages.
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
        raise DataError(f"{table.source}: column {name!r}", "cannot be used", skipped).at(
            table.source, *place
        )
    names = ", ".join(list(table.columns)[:12])
    more = ", ..." if len(table.columns) > 12 else ""
    raise DataError(
        f"{table.source}: column {name!r}",
        "is not in the file",
        f"{'.'.join(place)} may be {names}{more}",
    ).at(table.source, *place)


def on_even_instants(clock: Clock, values: Array) -> Array:
    """Interpolate `values` (samples,) at the steps[-1] + 1 uniform instants (Akima).

    Used if samples are missing, NaN or late; `values` must begin and end with finite numbers.
    """
    finite = np.isfinite(values)
    if clock.even and finite.all():
        return values
    instants = clock.start + clock.period * np.arange(clock.steps[-1] + 1)
    # A late first sample is used as it is; nothing is extrapolated.
    inside = np.clip(instants, clock.time[0], clock.time[-1])
    spline = scipy.interpolate.Akima1DInterpolator(
        clock.time[finite], values[finite], method="makima"
    )
    return np.asarray(spline(inside), dtype=np.float64)


def _stated_rate(table: Table, recording: RecordingTable) -> float:
    rate = table.rate if recording.rate is None else recording.rate
    if rate is None:
        raise DataError(
            table.source,
            "has neither a time column nor a sampling rate",
            "set recording.time or recording.rate",
        )
    if table.rate is not None and abs(rate - table.rate) > _RATE * table.rate:
        raise DataError(
            table.source,
            f"states {table.rate:g} samples per second, but recording.rate is {rate:g}",
            "correct recording.rate or leave it out",
        ).at("", "recording", "rate")
    return rate


def _rows_lost(table: Table, clock: Clock, chosen: str | None) -> tuple[str, ...]:
    """Columns that contradict the clock used (`chosen`, or a rate): rows lost, another rate."""
    found = []
    for name, values in table.columns.items():
        time = rising(values[clock.rows])
        if name == chosen or len(time) < len(clock.time):
            continue
        intervals = np.diff(time)
        usual = float(np.median(intervals))
        if named_clock(name, table.units.get(name, "")) and usual != 1:  # 1: a counter
            ratio = np.outer([usual, np.mean(intervals)], _UNITS) / clock.period
            ratio /= 10.0 ** np.rint(np.log10(ratio[0]))
            off = np.asarray((np.abs(ratio - 1) > _RATE).all(axis=1))
            if off.all() and chosen is None:
                rate = 1 / clock.period
                raise DataError(
                    f"{table.source}: clock {name!r}",
                    f"has {rate / ratio[0, 0]:.4g} samples per second, but the rate is {rate:g}",
                    f"set recording.time = {name!r}, or correct the rate",
                ).at("", "recording", "rate")
            if off.all() and (apart := abs(ratio[1, 0] - 1)) < _APART:
                found.append(f"clocks {chosen!r} and {name!r} run {apart:.2%} apart")
            if off[0]:
                continue  # another device, or rounded times
        counts = np.rint(intervals / usual)
        lost = int(counts.sum()) - len(counts) - (int(clock.steps[-1]) + 1 - len(clock.time))
        if lost > 0 and np.abs(intervals - usual * counts).max() < _UNEVEN * usual:
            after = int(np.argmax(counts > 1)) + 1
            wrong = "times are wrong from there; use it as recording.time if it is a clock"
            found.append(f"column {name!r} skips {lost} rows, first after sample {after}: {wrong}")
    return tuple(f"{table.source}: {one}" for one in found)


def clock_fault(values: Array) -> tuple[str, str] | None:
    """What is wrong with a clock, and what to do; None if it rises evenly."""
    with np.errstate(all="ignore"):  # steps beyond the largest float
        steps = np.diff(values)
    if (missing := ~np.isfinite(values)).any():
        problem = f"has {missing.sum()} missing times, the first in sample {np.argmax(missing) + 1}"
        return problem, "repair the clock, or give recording.rate instead"
    if code := missing_code(values):
        problem = f"has {code[0]} in {code[1]} samples, which no clock has"
        return problem, "repair the clock, or give recording.rate instead"
    if starts := _starts(values):
        listed = ", ".join(f"{place + 1} ({values[place]:g} after {values[place - 1]:g})"
                         for place in starts[:3])  # fmt: skip
        problem = f"begins again in sample {listed}: the file holds {len(starts) + 1} trials"
        return problem, "save each trial as a file of its own"
    backward = steps <= 0
    if np.mean(steps == 0) > 0.5 and not (steps < 0).any():
        coarse = f"has only {len(np.unique(values))} times in {len(values)} samples"
        return coarse, "export it with fractions of a second, or give recording.rate instead"
    if backward.any():
        first = int(np.argmax(backward))
        what = "is repeated" if steps[first] == 0 else "runs backward"
        problem = (
            f"{what} {backward.sum()} times, the first from sample {first + 1} to {first + 2} "
            f"(at {values[first]:g})"
        )
        return problem, "remove the repeated rows, or give recording.rate instead"
    return None


@np.errstate(all="ignore")
def rejected_clocks(table: Table) -> dict[str, tuple[str, str]]:
    """Columns that are clocks but rise unevenly: what is wrong with each, and what to do."""
    found = {}
    for name, values in table.columns.items():
        steps = np.diff(values[np.isfinite(values)])
        rises = np.sum(steps > 0) >= _RISES * np.sum(steps != 0)
        named = rises and named_clock(name, table.units.get(name, ""))
        fault = clock_fault(values) if named or _starts(values) else None
        if fault is None and named and len(rising(values)) < len(values):
            said = f"rises unevenly, in steps from {steps.min():.4g} to {steps.max():.4g}"
            fault = said, "export with a constant sampling rate, or give recording.rate instead"
        if fault is not None:
            found[name] = fault
    return found


def _starts(values: Array) -> list[int]:
    """Samples in which a clock begins again; empty if it does not, or is no clock."""
    with np.errstate(all="ignore"):
        steps = np.diff(values)
    falls = np.flatnonzero(steps <= 0)
    if not 0 < len(falls) <= _TRIALS or not (steps > 0).any():
        return []
    usual = float(np.median(steps[steps > 0]))
    even = np.abs(np.delete(steps, falls) - usual) < 0.5 * usual
    parts = np.diff([0, *(falls + 1), len(values)])
    back = steps[falls] < -2 * usual  # not a repeated row or a correction of the clock
    whole = even.mean() > _EVEN and parts.min() >= _TRIAL and back.all()
    return (falls + 1).tolist() if whole else []


def _cut(source: str, time: Array, recording: RecordingTable) -> slice:
    """Rows between recording.start and stop, which must lie within the recording."""
    slack = 1e-9 * max(abs(time[0]), abs(time[-1]), 1.0)
    start, stop = (-np.inf if recording.start is None else recording.start,
                   np.inf if recording.stop is None else recording.stop)  # fmt: skip
    kept = np.flatnonzero((time >= start - slack) & (time <= stop + slack))
    if len(kept) < 2:
        raise DataError(
            source,
            f"has {len(kept)} samples between recording.start and stop",
            f"choose them within the recording ({time[0]:g} to {time[-1]:g} s)",
        ).at("", "recording", "start")
    spare = float(np.median(np.diff(time[kept])))
    for key, wanted, beyond in (
        ("start", start, -np.inf < start < time[0] - spare),
        ("stop", stop, time[-1] + spare < stop < np.inf),
    ):
        if beyond:
            raise DataError(
                source,
                f"recording.{key} = {wanted:g} s lies outside the recording",
                f"choose a value between {time[0]:g} and {time[-1]:g} s",
            ).at("", "recording", key)
    return slice(int(kept[0]), int(kept[-1]) + 1)


def _measured(subject: str, time: Array, rows: slice, fill_gaps: float, longest: str) -> Clock:
    """Period by least squares over the samples; gaps count as whole periods."""
    intervals = np.diff(time)
    rough = usual_step(time)
    _require_period(subject, rough, "time_unit")
    if (instants := (time[-1] - time[0]) / rough) > _GAPS * len(time):
        problem = f"has {len(time)} samples at {instants:.3g} uniform instants: the rest are gaps"
        remedy = "cut with recording.start and stop"
        raise DataError(subject, problem, remedy).at("", "recording", "start")
    counts = np.rint(intervals / rough).astype(np.int64)
    if (counts == 0).any():
        first = int(np.argmax(counts == 0))
        raise DataError(
            subject,
            f"is not uniform: an interval of {intervals[first]:.4g} s at {time[first]:.6g} s where "
            f"{rough:.4g} s are usual",
            "export with a constant sampling rate",
        )
    steps = np.concatenate([[0], np.cumsum(counts)])
    findings, lost = list[str](), intervals > GAP * rough
    if lost.any():
        worst = int(np.argmax(intervals))
        if intervals[worst] > fill_gaps * (1 + 1e-9):
            raise DataError(
                subject,
                f"has {lost.sum()} gaps, the first at {time[np.argmax(lost)]:.6g} s, the longest "
                f"of {intervals[worst]:.4g} s at {time[worst]:.6g} s",
                "cut with recording.start and stop, or raise recording.fill_gaps "
                f"(now {fill_gaps:g} s)",
            ).at("", "recording", "fill_gaps")
        rows_lost = steps[-1] + 1 - len(time)
        said = f"{rows_lost} rows missing, none for longer than {longest}: interpolated"
        findings.append(f"{subject}: {said}")
    period, start = (float(value) for value in np.polyfit(steps, time - time[0], 1))
    late = np.abs(time - time[0] - start - period * steps)
    if late.max() > _JITTER * period:
        worst = int(np.argmax(late))
        findings.append(
            f"{subject}: jitter: {np.sum(late > _JITTER * period)} of {len(time)} samples deviate "
            f"from a uniform clock by more than 1 % of its period, at most by "
            f"{late.max() / period:.0%} (at {time[worst]:.6g} s); values were interpolated"
        )
    return Clock(time, rows, steps, float(time[0]) + start, period, fill_gaps, tuple(findings))


def _require_period(subject: str, period: float, key: str) -> None:
    """Require a plausible sampling period in s."""
    if not _PERIODS[0] <= period <= _PERIODS[1]:
        raise DataError(
            subject,
            f"has a sample every {period:.3g} s",
            f"correct the rate or the clock's unit ({_PERIODS[0]:g} to {_PERIODS[1]:g} s)",
        ).at("", "recording", key)
