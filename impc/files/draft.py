"""What a file holds: summary of its columns, and draft of a configuration from their names."""

from __future__ import annotations

import difflib
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from impc.arrays import Array
from impc.checking import replace
from impc.errors import InputError
from impc.files.alignment import named_clock, pulse, rising, usual_step
from impc.files.checks import changes_only, missing_code, straight_lines
from impc.files.clock import counts_days, read_clock, rejected_clocks
from impc.files.configuration import FILL_IN, RecordingTable
from impc.files.plant_sources import OWN, PlantSource, make_plant
from impc.files.table import Table, in_columns
from impc.files.units import is_unit, si_unit
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

_STATED = "stated in the file"
#: Comments on a value (guess, question, origin), not on its key: wrong beside another value.
ON_VALUE = re.compile(
    r"# (a guess|no remaining column fits|stated in the file|the file states '|fill in: deg, "
    r"|(recorded )?from \S+ to |prediction horizon )", re.IGNORECASE,
)  # fmt: skip


@dataclass(frozen=True)
class Guess:
    """Column of a signal or of the clock, with its unit."""

    column: str  # FILL_IN if none fits
    why: str  # Why this column; empty if the names agree
    unit: str  # FILL_IN if it is not known
    origin: str  # Where the unit comes from, or what is asked
    asked: tuple[tuple[str, str], ...] = ()  # Further lines of TOML, each with its question

    @property
    def certain(self) -> bool:
        """Whether nothing is guessed and nothing is to be filled in."""
        return not self.why and not self.asked and self.origin == _STATED


@dataclass(frozen=True, eq=False)
class Draft:
    """Meaning of the columns of a table, as far as names and units tell."""

    table: Table
    plant: Plant | None
    arguments: Mapping[str, object]  # Texts and numbers that the plant's function takes
    clock: Guess | None
    signals: dict[str, Guess]
    unused: tuple[str, ...]  # Columns

    @property
    def guesses(self) -> int:
        """Number of columns and units that are guessed, and of further questions."""
        known = [*self.signals.values(), *filter(None, [self.clock])]
        columns = sum(one.column != FILL_IN and bool(one.why) for one in known)
        columns += sum(len(one.asked) for one in known)
        return columns + sum(one.unit != FILL_IN and one.origin != _STATED for one in known)

    @property
    def places(self) -> int:
        """Number of values to fill in."""
        found = sum((one.column, one.unit).count(FILL_IN) for one in self.signals.values())
        found += sum(name in OWN or value == FILL_IN for name, value in self.arguments.items())
        return found + (self.plant is not None)

    @property
    def start(self) -> tuple[float, str] | None:
        """Time in s of the only pulse of a column without a use, and the question about it."""
        for column in self.unused:
            found = pulse(self.table.columns[column])
            if found and (self.clock or self.table.rate):
                place, height = found
                time = place / (self.table.rate or 1.0)
                if self.clock:
                    unit = si_unit(self.clock.unit).factor
                    time = float(self.table.columns[self.clock.column][place]) * unit
                high = f"{height:.2g} {self.table.units.get(column, '')}".strip()
                where = f"one pulse of {high} in {column!r} at {time:.6g} s"
                return time, f"{where}: does the trial begin there?"
        return None

    @np.errstate(all="ignore")
    def toml(self) -> str:
        """Text of a commented configuration (docs/howto/recordings.md)."""
        table, plant, name = self.table, self.plant, Path(self.table.source).name
        start = self.start
        lines = [
            f"# Meaning of the columns of {name!r}. Check every line; replace each",
            f'# "{FILL_IN}", which neither the file nor the plant determines.',
            "",
            "[recording]",
            *_clock_lines(table, self.clock),
            _line('subject = ""', "code of the subject"),
            *_OPTIONS,
            _START if start is None else _line(f"# start = {start[0]:.6g}", start[1]),
            *_MORE,
        ]
        if plant is None:
            lines += ["", "# Rename each table [signals.NAME] to an output or disturbance of the"]
            lines += ["# plant; remove columns that are neither."]
        for signal, guess in self.signals.items():
            acts = plant is not None and signal in plant.controls
            kind = _INPUT if acts else _span(table, guess.column)
            lines += ["", *_signal_lines(signal, guess, kind, plant)]
        if self.unused:
            idle = _idle(table)
            named = ", ".join(_stated(table, name, idle.get(name, "")) for name in self.unused)
            lines += ["", f"# Columns that are not used: {named}"]
        if plant is None:
            lines += ["", "[plant]", "# arguments of the plant's function", ""]
            lines += ["[fit]", "# settings of the fit"]
        else:
            lines += ["", *_plant_lines(self.arguments), "", *_fit_lines(plant)]
        return "\n".join(lines) + "\n"


@np.errstate(all="ignore")
def draft(
    table: Table, plant: Plant | None = None, arguments: Mapping[str, object] | None = None
) -> Draft:
    """Draft a configuration for the file of a `table`.

    Without a plant, every column becomes a signal named after itself. The first input of the plant
    is the command. `arguments` of its function with their defaults, `FILL_IN` if there is none.
    """
    clock = clock_guess(table)
    clocks = {*rejected_clocks(table), *([clock.column] if clock else [])}
    rest = [name for name, values in table.columns.items() if name not in clocks]
    if plant is None:
        rest = [name for name in rest if not counts(table, name)]
    chosen, names = {column: (column, "") for column in rest}, tuple(rest)
    if plant is not None:
        names = (*plant.outputs, *plant.controls[1:])
        chosen = _guessed(table, names, rest, plant)
    none = (FILL_IN, "no remaining column fits: enter its name")
    outputs = () if plant is None else plant.outputs
    signals = {
        name: replace(one, asked=questions(table, one.column, name not in outputs))
        for name in names
        if (one := guess_of(table, *chosen.get(name, none)))
    }
    used = [one.column for one in signals.values()] + ([clock.column] if clock else [])
    unused = tuple(name for name in table.columns if name not in used)
    plain = {name: value for name, value in (arguments or {}).items()
             if isinstance(value, bool | int | float | str)}  # fmt: skip
    return Draft(table, plant, plain, clock, signals, unused)


def questions(table: Table, column: str, held: bool = True) -> tuple[tuple[str, str], ...]:
    """Lines of TOML that a column may need, and the question that each one answers."""
    values = table.columns.get(column, np.empty(0))
    found = []
    if (code := missing_code(values)) is not None:
        many = f"{code[0]} in {code[1]} of {len(values)} samples"
        asked = f"{many}, far from all others: does it mark missing values?"
        found.append((f"missing = {code[0]}", asked))
    if held and (written := changes_only(values)):
        asked = f"a value in {written} of {len(values)} samples: is it written only where it "
        found.append(("held = true", f"{asked}changes, and holds until then?"))
    return tuple(found)


def drafted(table: Table, source: PlantSource | None) -> Draft:
    """Draft a configuration for the plant of a `source`, if there is one."""
    if source is None:
        return draft(table)
    return draft(table, make_plant(source, ()), source.defaults())


def _plant_lines(arguments: Mapping[str, object]) -> list[str]:
    lines = ["[plant]", "# Arguments of the plant's function. They describe the subject: correct"]
    lines += ["# those that you know and remove the #."] if arguments else []
    for name, value in arguments.items():
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


def _stated(table: Table, column: str, idle: str) -> str:
    about = ", ".join(filter(None, (table.units.get(column), idle)))
    return f"{_quoted(column)} ({about})" if about else _quoted(column)


def _span(table: Table, column: str) -> str:
    values = table.columns.get(column, np.empty(0))
    values = values[np.isfinite(values)]
    return f"recorded from {values.min():.4g} to {values.max():.4g}" if len(values) else "missing"


def _fits(table: Table, column: str, signal: str, plant: Plant) -> int:
    """Fit of a column's unit to a signal: 0 contradicts, 1 unknown, 2 same kind."""
    try:
        stated = si_unit(guess_of(table, column, "").unit)
        needed = si_unit(plant.unit(signal))
    except InputError:  # one of the two units is missing or unknown
        return 1
    return 2 if stated.base == needed.base else int(stated.base == "dimensionless")


def guess_of(table: Table, column: str, why: str) -> Guess:
    """A column, with the unit that the file or the end of the column's name states."""
    stated = table.units.get(column)
    if stated:
        try:
            si_unit(stated)
        except InputError as error:
            said = f"the file states {stated!r}, which {error.problem}: {error.remedy}"
            return Guess(column, why, FILL_IN, said)
        return Guess(column, why, stated, _STATED)
    last = re.split(r"[_ .]", column)[-1]
    if last != column and last in _IN_NAMES:
        return Guess(column, why, last, "a guess from its name")
    return Guess(column, why, FILL_IN, "fill in: deg, rad, N*m, ...")


def counts(table: Table, name: str) -> bool:
    """Whether a column counts samples, or is another clock that rises evenly."""
    values = table.columns[name]
    whole = len(values) > 2 and bool((np.diff(values) == 1).all())
    return whole or (rate_of(values) is not None and named_clock(name, table.units.get(name, "")))


def rate_of(values: Array) -> float | None:
    """Samples per unit of a column that rises evenly; None for the others."""
    return 1 / usual_step(values) if len(rising(values)) == len(values) else None


def _line(setting: str, comment: str) -> str:
    return f"{setting:<26}# {comment}"


_OPTIONS = (
    '# visit = "1"',
    '# condition = "eyes open"',
    _line('# trial = "1"', "by default the name of the file"),
    "# pattern = '(?P<subject>[^_]+)_(?P<trial>[0-9]+)'  # or the label from the file's name",
    _line("# fill_gaps = 0.05", "s, longest gap to interpolate; default: a model sample"),
)
_START = _line("# start = 0.0", "s, cut on the file's clock")
_MORE = (
    "# stop = 30.0",
    _line('# sheet = "Data"', "of a workbook; by default the first with rows of numbers"),
)


def _clock_lines(table: Table, clock: Guess | None) -> list[str]:
    if clock is None and table.rate is not None:
        return [_line(f"# rate = {table.rate!r}", "samples per second, stated in the file")]
    if clock is None and (rejected := rejected_clocks(table)):
        said = [_line(f"# time = {_quoted(name)}", "; ".join(fault))
                for name, fault in rejected.items()]  # fmt: skip
        return [*said, _line("# rate = 1000.0", "samples per second, if no clock is right")]
    if clock is None:
        return [
            _line('# time = "..."', "no column rises evenly: name the clock column,"),
            _line("# rate = 1000.0", "or give the samples per second"),
        ]
    values = table.columns[clock.column]
    step = usual_step(values)
    if not named_clock(clock.column, table.units.get(clock.column, "")) and counts(
        table, clock.column
    ):
        asked = f"samples per second, which {clock.column!r} counts"
        return [_line("# rate = 1000.0", asked)]
    span = f"from {values[0]:.6g} to {values[-1]:.6g}, in steps of {step:.6g}"
    unit = _line(f"time_unit = {_quoted(clock.unit)}", clock.origin)
    return [_line(f"time = {_quoted(clock.column)}", span), unit]


def clock_guess(table: Table) -> Guess | None:
    """Column with the clock (named as one, or the first that rises), and its unit."""
    even = [name for name, values in table.columns.items() if rate_of(values) is not None]
    named = [name for name in even if named_clock(name, table.units.get(name, ""))]
    name = next(iter([*named, *even]), None)
    if name is None:
        return None
    values, guess = table.columns[name], guess_of(table, name, "")
    if guess.unit != "day" and counts_days(values) and not table.units.get(name):
        return Guess(name, "", "day", "a guess: day numbers of a spreadsheet")
    if guess.unit == FILL_IN and is_unit(name) and si_unit(name).base == "second":
        guess = replace(guess, unit=name, origin="a guess from its name")
    if guess.unit != FILL_IN and si_unit(guess.unit).base == "second":
        return guess
    step = usual_step(values)
    unit, second = next(pair for pair in _GUESSES if step < pair[1] * _SLOWEST or pair[1] == 1e9)
    origin = f"a guess: {second / step:.4g} samples per second; a counter needs rate"
    return Guess(name, "", unit, origin)


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
    free, idle = list(columns), _idle(table)
    for signal, column in sorted(likeness, key=lambda pair: -likeness[pair]):
        alike = likeness[signal, column] >= _ALIKE
        if alike and signal not in chosen and column in free:
            same = signal.lower() == column.lower()
            chosen[signal] = column, "" if same else "a guess from its name"
            free.remove(column)
    for signal in signals:
        left = [column for column in free if fits[signal, column] and column not in idle]
        if signal not in chosen and left:
            # The first of those that fit equally well.
            best = max(left, key=lambda column: fits[signal, column])
            how = "unit" if fits[signal, best] == 2 else "place"
            chosen[signal] = best, f"A GUESS from its {how}: check it"
            free.remove(best)
    return chosen


def _idle(table: Table) -> dict[str, str]:
    """Columns that are hardly signals, and why."""
    rejected, found = rejected_clocks(table), {}
    for column, values in table.columns.items():
        finite = values[np.isfinite(values)]
        if len(finite) == 0 or np.ptp(finite) == 0:
            found[column] = "constant"
        elif column in rejected:
            found[column] = f"a clock that {rejected[column][0]}"
        elif rate_of(finite) is not None:
            found[column] = "a clock or counter"
    return found


def _signal_lines(signal: str, guess: Guess, kind: str, plant: Plant | None) -> list[str]:
    key = signal if signal.isidentifier() and signal.isascii() else _quoted(signal)
    column = f"column = {_quoted(guess.column)}"
    positive = "" if plant is None else plant.direction(signal)
    positive = f"; positive {positive}" if positive else ""
    return [
        _line(f"[signals.{key}]", kind),
        _line(column, guess.why) if guess.why else column,
        _line(f"unit = {_quoted(guess.unit)}", guess.origin),
        *(
            _line(f"# {line}", f"{question} Then remove the first #")
            for line, question in guess.asked
        ),
        _line("# limit = 12.0", "mechanical stop, in this unit"),
        _line("# offset = 0.0", "subtracted, in this unit"),
        _line("# sign = -1", f"if the sensor counts in the opposite direction{positive}"),
    ]


def _quoted(text: str) -> str:
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")  # TOML forbids it


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
