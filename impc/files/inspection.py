"""What a file holds, and a first configuration for it."""

from __future__ import annotations

import difflib
import json
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from impc.errors import InputError
from impc.files.columns import in_columns
from impc.files.configuration import UNKNOWN_UNIT
from impc.files.units import si_unit

if TYPE_CHECKING:
    from collections.abc import Sequence

    from impc.arrays import Array
    from impc.files.table import Table

__all__ = ["clock_column", "draft_configuration", "summary"]

_CLOCKS = ("time", "t", "zeit", "temps", "tiempo", "timestamp", "clock", "seconds", "sec")
# Units of a clock that tells none, and how many make a second: the first in which the steps are
# shorter than those of any recording of movement, s.
_GUESSES = (("s", 1.0), ("ms", 1e3), ("us", 1e6), ("ns", 1e9))
_SLOWEST = 0.2
_ALIKE = 0.6  # theta1 and theta_2 are, push and perturbation are not


@np.errstate(all="ignore")  # of values of 1e308, the mean is inf
def summary(table: Table) -> str:
    """A table of the columns: unit, samples, range, mean, missing, and a rate where it rises."""
    heads = ("column", "unit", "samples", "min", "max", "mean", "not finite", "rate")
    lines = [in_columns([heads, *(_row(table, name) for name in table.columns)], left=2)]
    if table.rate is not None:
        lines.append(f"The file says {table.rate:g} samples per second.")
    lines += [f"Not read: {name} {reason}" for name, reason in table.skipped.items()]
    return "\n".join(lines)


@np.errstate(all="ignore")
def clock_column(table: Table) -> str | None:
    """The column that is a clock: rising throughout, by its name or else with even steps."""
    rising = [name for name, values in table.columns.items() if _rate(values) is not None]
    named = [name for name in rising if _base(name) in _CLOCKS]
    return next(iter(named or rising), None)


@np.errstate(all="ignore")
def draft_configuration(
    table: Table, outputs: Sequence[str] = (), disturbances: Sequence[str] = ()
) -> str:
    """A commented TOML file that `read_configuration` reads.

    Parameters
    ----------
    table : Table
    outputs, disturbances : sequence of str
        Names of the plant's signals; without them every column becomes a signal by its own name.
    """
    lines = [
        f"# What the columns of {Path(table.source).name!r} mean. Check every line; units",
        f'# that the file does not tell are "{UNKNOWN_UNIT}" and must be filled in.',
        "",
        "[recording]",
        *_clock_lines(table),
        _line('subject = ""', "whose recording it is"),
        *_OPTIONS,
    ]
    clock = clock_column(table)
    rest = [name for name in table.columns if name != clock] or list(table.columns)
    if outputs:
        pairs = _guessed((*outputs, *disturbances), rest)
    else:
        pairs = [(name, name) for name in rest]
        lines += ["", "# Name each table [signals.NAME] by an output or disturbance of the plant;"]
        lines += ["# remove the columns that are none."]
    for signal, column in pairs:
        lines += ["", *_signal_lines(table, signal, column, signal in disturbances)]
    lines += ["", "[plant]", "# arguments of the plant's function", ""]
    lines += ["[fit]", "# settings of the fit"]
    return "\n".join(lines) + "\n"


def _row(table: Table, name: str) -> tuple[str, ...]:
    values = table.columns[name]
    finite = values[np.isfinite(values)]
    numbers = (
        tuple(f"{value:.6g}" for value in (finite.min(), finite.max(), finite.mean()))
        if len(finite)
        else ("-", "-", "-")
    )
    rate = _rate(values)
    return (
        name,
        table.units.get(name, ""),
        str(len(values)),
        *numbers,
        str(len(values) - len(finite)),
        "" if rate is None else f"{rate:.6g}",
    )


def _rate(values: Array) -> float | None:
    """Steps per unit of a column that rises evenly; None for the others."""
    steps = np.diff(values)
    if not np.isfinite(values).all() or (steps <= 0).any():
        return None
    median = float(np.median(steps))
    even = np.abs(steps - median) < 0.5 * median
    return 1 / median if even.mean() > 0.9 else None


def _base(name: str) -> str:
    return name.rpartition(".")[2].rpartition("/")[2].strip().lower()


def _line(setting: str, comment: str) -> str:
    return f"{setting:<26}# {comment}"


_OPTIONS = (
    '# visit = "1"',
    '# condition = "eyes open"',
    _line('# trial = "1"', "by default the name of the file"),
    "# pattern = '(?P<subject>[^_]+)_(?P<trial>[0-9]+)'  # or the label from the file's name",
    _line("# fill_gaps = 0.0", "s, the longest gap that may be filled by interpolation"),
    _line("# start = 0.0", "s, cut on the file's clock"),
    "# stop = 30.0",
)


def _clock_lines(table: Table) -> list[str]:
    clock = clock_column(table)
    if clock is None and table.rate is not None:
        return [_line(f"# rate = {table.rate!r}", "samples per second; the file tells it itself")]
    if clock is None:
        return [
            _line('# time = "..."', "no column rises evenly: name the one with the clock,"),
            _line("# rate = 1000.0", "or give the samples per second"),
        ]
    values = table.columns[clock]
    step = float(np.median(np.diff(values)))
    unit, why = _time_unit(table.units.get(clock), step)
    span = f"from {values[0]:.6g} to {values[-1]:.6g}, in steps of {step:.6g}"
    return [_line(f"time = {_quoted(clock)}", span), _line(f"time_unit = {_quoted(unit)}", why)]


def _time_unit(told: str | None, step: float) -> tuple[str, str]:
    try:
        if told and si_unit(told).base == "second":
            return told, "as the file says"
    except InputError:
        pass
    unit, second = next(pair for pair in _GUESSES if step < pair[1] * _SLOWEST or pair[1] == 1e9)
    return unit, f"a guess: {second / step:.4g} samples per second; a counter needs rate"


def _guessed(signals: Sequence[str], columns: Sequence[str]) -> list[tuple[str, str]]:
    """A column for each signal: the most alike first, then by order."""
    likeness = {
        (signal, column): difflib.SequenceMatcher(None, signal.lower(), column.lower()).ratio()
        for signal in signals
        for column in columns
    }
    chosen: dict[str, str] = {}
    for signal, column in sorted(likeness, key=lambda pair: -likeness[pair]):
        alike = likeness[signal, column] >= _ALIKE
        if alike and signal not in chosen and column not in chosen.values():
            chosen[signal] = column
    left = [column for column in columns if column not in chosen.values()]
    for signal in signals:
        if signal not in chosen:
            chosen[signal] = left.pop(0) if left else columns[0]
    return [(signal, chosen[signal]) for signal in signals]


def _signal_lines(table: Table, signal: str, column: str, acts: bool) -> list[str]:
    told = table.units.get(column)
    try:
        unit, why = (told, "as the file says") if told and si_unit(told) else (UNKNOWN_UNIT, "")
    except InputError:
        unit, why = UNKNOWN_UNIT, f"the file says {told!r}, which is not known"
    values = table.columns[column][np.isfinite(table.columns[column])]
    span = f"from {values.min():.4g} to {values.max():.4g}" if len(values) else "all missing"
    key = signal if signal.isidentifier() and signal.isascii() else _quoted(signal)
    kind = "a disturbance: may be left out where none acts" if acts else f"recorded {span}"
    return [
        _line(f"[signals.{key}]", kind),
        f"column = {_quoted(column)}",
        _line(f"unit = {_quoted(unit)}", why or "fill in: deg, rad, N*m, ..."),
        _line("# limit = 12.0", "mechanical stop, in this unit"),
        _line("# offset = 0.0", "subtracted, in this unit"),
        _line("# sign = -1", "where the sensor counts the other way"),
    ]


def _quoted(text: str) -> str:
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")  # TOML forbids it
