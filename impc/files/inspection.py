"""Summary of a file's columns, and a draft of a configuration for it."""

from __future__ import annotations

import difflib
import json
import re
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from impc.errors import InputError
from impc.files.alignment import named_clock, rising
from impc.files.clock import counts_days, read_clock
from impc.files.configuration import FILL_IN, RecordingTable
from impc.files.plant_sources import OWN
from impc.files.table import in_columns
from impc.files.units import si_unit

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from impc.arrays import Array
    from impc.files.table import Table
    from impc.model.plant import Plant

# Units tried for a clock without unit, with steps per second: the first in which steps are shorter
# than `_SLOWEST` s, the longest of any movement recording.
_GUESSES = (("s", 1.0), ("ms", 1e3), ("us", 1e6), ("ns", 1e9))
_SLOWEST = 0.2
_HORIZON = 20
_INPUT = "a recorded perturbation; delete this table if it was not recorded"
# Units at the end of names, as in alpha_deg.
_IN_NAMES = ("deg", "rad", "mm", "cm", "m", "N", "Nm", "V", "mV", "s", "ms")
_ALIKE = 0.6  # theta1 and theta_2 are alike; push and perturbation are not


@np.errstate(all="ignore")  # the mean of values of 1e308 overflows
def summary(table: Table, dt: float | None = None) -> str:
    """Table of the columns with the findings of their clock; `dt` of the plant in s, if known."""
    heads = ("column", "unit", "samples", "min", "max", "mean", "not finite", "rate")
    lines = [in_columns([heads, *(_row(table, name) for name in table.columns)], left=2)]
    if table.rate is not None:
        lines.append(f"The file states a rate of {table.rate:g} samples per second.")
    lines += _clock_findings(table, dt)
    lines += [f"Not read: {name} {reason}" for name, reason in table.skipped.items()]
    lines += [f"Note: {note}" for note in table.notes]
    return "\n".join(lines)


@np.errstate(all="ignore")
def draft_configuration(
    table: Table, plant: Plant | None = None, arguments: Mapping[str, object] | None = None
) -> str:
    """Draft a commented TOML configuration (docs/howto/recordings.md).

    Without a plant, every column becomes a signal named after itself. The first input of the plant
    is the command. `arguments` of its function with their defaults, `FILL_IN` if there is none.
    """
    lines = [
        f"# Meaning of the columns of {Path(table.source).name!r}. Check every line; replace each",
        f'# "{FILL_IN}", which neither the file nor the plant determines.',
        "",
        "[recording]",
        *_clock_lines(table),
        _line('subject = ""', "code of the subject"),
        *_OPTIONS,
    ]
    clock = _clock(table)
    rest = [name for name in table.columns if not clock or name != clock[0]] or list(table.columns)
    if plant is None:
        lines += ["", "# Rename each table [signals.NAME] to an output or disturbance of the"]
        lines += ["# plant; remove columns that are neither."]
        for column in rest:
            lines += ["", *_signal_lines(table, column, column, _span(table, column), "", "")]
        lines += ["", "[plant]", "# arguments of the plant's function", ""]
        return "\n".join([*lines, "[fit]", "# settings of the fit"]) + "\n"
    signals = (*plant.outputs, *plant.controls[1:])
    chosen = _guessed(table, signals, rest, plant)
    for signal in signals:
        column, why = chosen.get(signal, (FILL_IN, "no remaining column fits: enter its name"))
        acts = signal in plant.controls
        kind = _INPUT if acts else _span(table, column)
        lines += ["", *_signal_lines(table, signal, column, kind, why, plant.direction(signal))]
    unused = [name for name in rest if name not in [column for column, _ in chosen.values()]]
    if unused:
        named = ", ".join(_stated(table, name) for name in unused)
        lines += ["", f"# Columns that are not used: {named}"]
    return "\n".join([*lines, "", *_plant_lines(arguments or {}), "", *_fit_lines(plant)]) + "\n"


def _plant_lines(arguments: Mapping[str, object]) -> list[str]:
    lines = ["[plant]", "# Arguments of the plant's function. They describe the subject: correct"]
    lines += ["# those that you know and remove the #."] if arguments else []
    for name, value in arguments.items():
        if isinstance(value, bool | int | float | str):
            text = json.dumps(value, ensure_ascii=False)
            own = f"the subject's own; without this line the plant's {text} is used"
            if name in OWN and value != FILL_IN:
                lines.append(_line(f'{name} = "{FILL_IN}"', own))
            else:
                lines.append(f"{name} = {text}" if value == FILL_IN else f"# {name} = {text}")
    return lines


def _fit_lines(plant: Plant) -> list[str]:
    seconds = f", {_HORIZON * plant.dt:.3g} s" if plant.dt else ""
    command = plant.controls[0]
    units = f"{command} in {plant.unit(command)}"
    return [
        "[fit]",
        _line(f"horizon = {_HORIZON}", f"prediction horizon of the controller in samples{seconds}"),
        _line(f'u_max = "{FILL_IN}"', f"largest command of the subject: {units}; without"),
        _line("", "this line there is no limit (inverse LQR)"),
    ]


def _stated(table: Table, column: str) -> str:
    about = ", ".join(filter(None, (table.units.get(column), _idle(table, column))))
    return f"{_quoted(column)} ({about})" if about else _quoted(column)


def _span(table: Table, column: str) -> str:
    values = table.columns.get(column, np.empty(0))
    values = values[np.isfinite(values)]
    return f"recorded from {values.min():.4g} to {values.max():.4g}" if len(values) else "missing"


def _fits(table: Table, column: str, signal: str, plant: Plant) -> int:
    """Fit of a column's unit to a signal: 0 contradicts, 1 unknown, 2 same kind."""
    try:
        stated = si_unit(_column_unit(table, column)[0])
        needed = si_unit(plant.unit(signal))
    except InputError:  # one of the two units is missing or unknown
        return 1
    return 2 if stated.base == needed.base else int(stated.base == "dimensionless")


def _column_unit(table: Table, column: str) -> tuple[str, str]:
    """Unit of a column, and its origin: the file, or the end of the column's name."""
    stated = table.units.get(column)
    if stated:
        try:
            si_unit(stated)
        except InputError:
            return FILL_IN, f"the file states {stated!r}, which is not known"
        return stated, "stated in the file"
    last = re.split(r"[_ .]", column)[-1]
    if last != column and last in _IN_NAMES:
        return last, "a guess from its name"
    return FILL_IN, ""


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
    """Samples per unit of a column that rises evenly; None for the others."""
    whole = len(rising(values)) == len(values)
    return 1 / float(np.median(np.diff(values))) if whole else None


def open_places(text: str) -> tuple[int, int]:
    """Numbers of guesses and of places to be filled in, in the `text` of a draft."""
    return len(re.findall("# a guess|# A GUESS", text)), text.count(f'= "{FILL_IN}"')


def _line(setting: str, comment: str) -> str:
    return f"{setting:<26}# {comment}"


_OPTIONS = (
    '# visit = "1"',
    '# condition = "eyes open"',
    _line('# trial = "1"', "by default the name of the file"),
    "# pattern = '(?P<subject>[^_]+)_(?P<trial>[0-9]+)'  # or the label from the file's name",
    _line("# fill_gaps = 0.05", "s, longest gap to interpolate; default: a model sample"),
    _line("# start = 0.0", "s, cut on the file's clock"),
    "# stop = 30.0",
    _line('# sheet = "Data"', "of a workbook; by default the first with rows of numbers"),
)


def _clock_lines(table: Table) -> list[str]:
    clock = _clock(table)
    if clock is None and table.rate is not None:
        return [_line(f"# rate = {table.rate!r}", "samples per second, stated in the file")]
    if clock is None:
        return [
            _line('# time = "..."', "no column rises evenly: name the clock column,"),
            _line("# rate = 1000.0", "or give the samples per second"),
        ]
    name, unit, why = clock
    values = table.columns[name]
    step = float(np.median(np.diff(values)))
    span = f"from {values[0]:.6g} to {values[-1]:.6g}, in steps of {step:.6g}"
    return [_line(f"time = {_quoted(name)}", span), _line(f"time_unit = {_quoted(unit)}", why)]


def _clock(table: Table) -> tuple[str, str, str] | None:
    """Column with the clock (named as one, or the first that rises), its unit and its origin."""
    even = [name for name, values in table.columns.items() if _rate(values) is not None]
    named = [name for name in even if named_clock(name, table.units.get(name, ""))]
    name = next(iter([*named, *even]), None)
    if name is None:
        return None
    values, (written, how) = table.columns[name], _column_unit(table, name)
    if written != "day" and counts_days(values) and not table.units.get(name):
        return name, "day", "a guess: day numbers of a spreadsheet"
    if written != FILL_IN and si_unit(written).base == "second":
        return name, written, how
    step = float(np.median(np.diff(values)))
    unit, second = next(pair for pair in _GUESSES if step < pair[1] * _SLOWEST or pair[1] == 1e9)
    return name, unit, f"a guess: {second / step:.4g} samples per second; a counter needs rate"


def _clock_findings(table: Table, dt: float | None) -> list[str]:
    """Findings of the clock that the draft names, or of the rate of the file."""
    recording = RecordingTable()
    if (clock := _clock(table)) is not None:
        longest = float(np.diff(table.columns[clock[0]]).max()) * si_unit(clock[1]).factor
        fill_gaps = longest if dt is None else None
        recording = RecordingTable(time=clock[0], time_unit=clock[1], fill_gaps=fill_gaps)
    elif table.rate is None:
        return []
    try:
        used = read_clock(table, recording, dt or 0.0)
    except InputError as error:
        return [str(error)]
    found = [*used.findings, *used.notes]
    return found if dt else [one.removesuffix(": interpolated") for one in found]


def _guessed(
    table: Table, signals: Sequence[str], columns: Sequence[str], plant: Plant
) -> dict[str, tuple[str, str]]:
    """Column for each signal, and why: most similar names first, then by unit and order."""
    fits = {
        (signal, column): _fits(table, column, signal, plant)
        for signal in signals
        for column in columns
    }
    likeness = {
        (signal, column): difflib.SequenceMatcher(None, signal.lower(), column.lower()).ratio()
        for (signal, column), fit in fits.items()
        if fit
    }
    chosen: dict[str, tuple[str, str]] = {}
    free = list(columns)
    for signal, column in sorted(likeness, key=lambda pair: -likeness[pair]):
        alike = likeness[signal, column] >= _ALIKE
        if alike and signal not in chosen and column in free:
            same = signal.lower() == column.lower()
            chosen[signal] = column, "" if same else "a guess from its name"
            free.remove(column)
    for signal in signals:
        left = [column for column in free if fits[signal, column] and not _idle(table, column)]
        if signal not in chosen and left:
            # The first of those that fit equally well.
            best = max(left, key=lambda column: fits[signal, column])
            how = "unit" if fits[signal, best] == 2 else "place"
            chosen[signal] = best, f"A GUESS from its {how}: check it"
            free.remove(best)
    return chosen


def _idle(table: Table, column: str) -> str:
    """Reason why a column is hardly a signal; empty if it may be one."""
    values = table.columns[column]
    values = values[np.isfinite(values)]
    if len(values) == 0 or np.ptp(values) == 0:
        return "constant"
    return "" if _rate(values) is None else "a clock or counter"


def _signal_lines(
    table: Table, signal: str, column: str, kind: str, why: str, way: str
) -> list[str]:
    unit, how = _column_unit(table, column)
    key = signal if signal.isidentifier() and signal.isascii() else _quoted(signal)
    return [
        _line(f"[signals.{key}]", kind),
        _line(f"column = {_quoted(column)}", why) if why else f"column = {_quoted(column)}",
        _line(f"unit = {_quoted(unit)}", how or "fill in: deg, rad, N*m, ..."),
        _line("# limit = 12.0", "mechanical stop, in this unit"),
        _line("# offset = 0.0", "subtracted, in this unit"),
        _line(
            "# sign = -1",
            f"if the sensor counts in the opposite direction{way and f'; positive {way}'}",
        ),
    ]


def _quoted(text: str) -> str:
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")  # TOML forbids it
