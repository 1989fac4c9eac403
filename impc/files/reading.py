"""Read recordings: columns by configuration, checked, resampled to the plant's rate."""

from __future__ import annotations

import difflib
import math
import os
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from impc.arrays import Array
from impc.checking import checked, replace
from impc.errors import DataError, FallError, ImpcError, InputError, blamed
from impc.files import checks
from impc.files.apart import match_apart
from impc.files.causality import departures, misaligned, rows_later
from impc.files.checks import Notice, fault, finding
from impc.files.clock import Clock, column_of, on_even_instants, read_clock
from impc.files.configuration import FILL_IN, Configuration, RecordingTable, SignalTable
from impc.files.digests import content_digest
from impc.files.formats import read_table
from impc.files.resampling import (
    first_common,
    held_means,
    held_values,
    instants,
    resampled_samples,
    same_rate,
    shifted,
    steps_of,
)
from impc.files.table import Table
from impc.files.units import Unit, si_unit
from impc.levels import Level
from impc.model.foresight import physical_disturbances, physical_states
from impc.model.plant import UNKNOWN, Plant
from impc.model.recordings import Label, Recording

T = TypeVar("T")
# Ratios to half the range above which offset and drift are reported.
_OFFSET, _DRIFT = 0.12, 0.25
# Samples needed for each state of the plant.
_SAMPLES_A_STATE = 5
# Largest share of missing samples in a resampled value that still counts as measured.
_LOST = 0.05
# Spread of the jumps of a push by its samples, in samples of the plant, that matters to a fit.
_JITTER = 0.05


@checked
def read_recordings(
    paths: Sequence[Path], configuration: Configuration, plant: Plant
) -> tuple[Recording, ...]:
    r"""Read one trial from each file, in the order given.

    Parameters
    ----------
    paths : sequence of Path
        One file for each trial.
    configuration : Configuration
        Names a column for each output of the plant, for its target, and for the recorded
        disturbances and commands; other disturbances are zero.
    plant : Plant
        Discrete-time plant; determines names and rate.

    Returns
    -------
    tuple of Recording
        Trials in SI base units, with initial states zero and the findings of the checks.

    Raises
    ------
    InputError
        If the configuration does not name the plant's signals, or a file is given twice.
    DataError
        If a file cannot be read or a check fails; nothing is returned then.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import control
    >>> import impc
    >>> plant = impc.Plant(control.ss([[0.9]], [[1]], [[1]], 0, 0.01, outputs=["angle"]))
    >>> text = '[recording]\nrate = 100\n[signals.angle]\ncolumn = "tilt"\nunit = "deg"\n'
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     file, settings = Path(folder, "trial.csv"), Path(folder, "lab.toml")
    ...     _ = settings.write_text(text)
    ...     table = impc.make_table("simulated", {"tilt": [90 * 0.9**k for k in range(20)]})
    ...     impc.write_table(file, table)
    ...     trials = impc.read_recordings([file], impc.read_configuration(settings), plant)
    >>> trials[0].outputs[:2].round(4).tolist()
    [[1.5708], [1.4137]]
    """
    trials, fallen = read_unit(paths, configuration, plant)
    if fallen:
        raise fallen[0]
    return trials


def read_unit(
    paths: Sequence[Path], configuration: Configuration, plant: Plant
) -> tuple[tuple[Recording, ...], tuple[FallError, ...]]:
    """Trials in which the subject did not fall, and the falls by file."""
    plant.require_discrete()
    for error in faults_of(configuration, plant):  # before the slow reading of files
        raise error
    require_distinct(paths)
    if not paths:
        raise InputError("recordings", "no file is given", "name at least one file")
    sheet = configuration.recording.sheet
    tables = (read_table(path, sheet=sheet) for path in paths)
    read: list[tuple[str, Recording]] = []
    fallen: list[FallError] = []
    for path, table in zip(paths, tables, strict=True):
        try:
            read.append((str(path), recording_of(table, configuration, plant)))
        except FallError as fall:
            fallen.append(fall)
    trials = dict(read)
    for one in unequal(read):
        found = (*trials[one.file].findings, one.text)
        trials[one.file] = replace(trials[one.file], findings=found)
    return tuple(trials.values()), tuple(fallen)


def unequal(trials: Sequence[tuple[str, Recording]]) -> list[Notice]:
    """Findings on trials, given by file, that are shorter than the longest."""
    longest = max((trial.samples for _, trial in trials), default=0)
    said = "trials of unequal length: {} samples, the longest has {}"
    return [finding(source, said.format(trial.samples, longest))
            for source, trial in trials if trial.samples < longest]  # fmt: skip


def examine(
    tables: Sequence[Table], configuration: Configuration, plant: Plant
) -> tuple[Notice, ...]:
    """All faults of a configuration and of recordings, and the findings of all checks, each once.

    Of each signal of a recording the first fault is given, which explains the others.
    """
    found = [fault(error) for error in faults_of(configuration, plant)]
    faulty = {one.place[1] for one in found if one.place}
    names = [name for name in names_of(configuration, plant) if name not in faulty]

    def tried(read: Callable[..., T], *given: Any) -> T | None:
        try:
            return read(*given)
        except ImpcError as error:
            found.append(fault(error))
            return None

    trials, given = [], (configuration, plant, found)
    for table in tables:
        if (trial := tried(recording_of, table, *given)) is not None:
            trials.append((table.source, trial))
            continue
        tried(label_of, table.source, configuration.recording)
        clock = tried(clock_of, table, *given)
        for name in names:
            if clock is not None:
                tried(signal_of, table, clock, name, *given)
            else:  # at least its column
                place = ("signals", name, "column")
                tried(column_of, table, configuration.signals[name].column, place)
    return tuple(dict.fromkeys([*found, *unequal(trials)]))


def names_of(configuration: Configuration, plant: Plant) -> tuple[str, ...]:
    """Names of the signals that are read: outputs, then recorded disturbances and commands."""
    inputs = (*plant.disturbances, *(plant.commands or plant.controls))
    return (*plant.outputs, *(name for name in inputs if name in configuration.signals))


def clock_of(
    table: Table, configuration: Configuration, plant: Plant, findings: list[Notice]
) -> Clock:
    """Clock of a recording that is fast and long enough for the plant."""
    clock, source = read_clock(table, configuration.recording, plant.dt), table.source
    checks.comparable_rates(source, clock.period, plant.dt)
    samples = resampled_samples(int(clock.steps[-1]) + 1, clock.period, plant.dt)
    checks.too_few(source, samples, _SAMPLES_A_STATE * physical_states(plant))
    findings += [finding(source, note) for note in table.notes]
    said, place = (*clock.findings, *clock.notes), ("recording", "time")
    findings += [Notice(Level.AMBER, source, place, text) for text in said]
    return clock


def recording_of(
    table: Table, configuration: Configuration, plant: Plant, findings: list[Notice] | None = None
) -> Recording:
    """Make the trial of one table: checks, uniform clock, plant's rate; append to `findings`."""
    for one in faults_of(configuration, plant):
        raise one
    label = label_of(table.source, configuration.recording)
    findings = [] if findings is None else findings
    clock, names = clock_of(table, configuration, plant, findings), names_of(configuration, plant)
    series, lost, targets, finer = _clocked(table, clock, configuration, plant, names, findings)
    samples = len(series[plant.outputs[0]])
    if clock.period > plant.dt and not same_rate(len(clock.time), clock.period, plant.dt):
        said = (
            f"recorded at {1 / clock.period:.4g} samples per second and analysed "
            f"at {1 / plant.dt:.4g}: it contains nothing above {0.5 / clock.period:.4g} Hz"
        )
        findings.append(finding(table.source, said))
    findings += _departing(table.source, series, targets, configuration, plant)
    disturbance = np.zeros((samples, physical_disturbances(plant)))
    for index, name in enumerate(plant.disturbances):
        if name in series:
            disturbance[:, index] = series[name]
            findings += [
                finding(table.source, f"{output} {reason} ({name})", "signals", name, "shift")
                for output in plant.outputs
                if (reason := misaligned(series[name], series[output], plant.dt))
            ]
    outputs = np.column_stack([series[name] for name in plant.outputs])
    if clock.even and same_rate(len(clock.time), clock.period, plant.dt):
        findings += _later(table.source, outputs, series, plant)
    for name, share in lost.items():
        series[name] = np.where(np.abs(share) > _LOST, np.nan, series[name])
    controls, nothing = plant.commands or plant.controls, np.full(samples, np.nan)
    commands = np.column_stack([series.get(name, nothing) for name in controls])
    if plant.commands:  # the controls are changes of the commands
        commands = np.diff(commands, axis=0, prepend=np.nan)
    other = None
    if finer:
        other = disturbance.copy()
        for name, values in finer.items():
            other[:, plant.disturbances.index(name)] = values
    return Recording(
        plant,
        np.column_stack([series[name] for name in plant.outputs]),
        disturbance,
        np.zeros(plant.n),
        target=targets,
        commands=commands if any(name in series for name in controls) else None,
        finer=other,
        timing=_timing(clock, configuration, plant),
        label=label,
        findings=tuple(one.text for one in findings),
    )


def signal_of(
    table: Table, clock: Clock, name: str, configuration: Configuration, plant: Plant,
    findings: list[Notice],
) -> dict[str, Array]:  # fmt: skip
    """Checked series of a signal at uniform instants by kind: "", "lost", "target"."""
    entry, keep = configuration.signals[name], configuration.recording.keep_gaps
    _shift(table.source, clock, name, entry)
    with blamed(table.source, "signals", name, "column"):
        channel = channel_of(table, clock, name, entry)
        response, gap = name in plant.outputs, None if name in plant.disturbances else keep
        findings += _checked(table, channel, entry, clock, response, gap)
    found = {"": on_even_instants(clock, channel.values * channel.unit.factor)}
    if gap and (gaps := checks.gaps(channel, clock.fill_gaps)).any():
        values, known = found[""], np.isfinite(found[""])
        found[""] = np.interp(np.arange(len(values)), np.flatnonzero(known), values[known])
        found["lost"] = np.zeros(len(values))
        found["lost"][clock.steps] = gaps
    if isinstance(entry.target, str):
        with blamed(table.source, "signals", name, "target"):
            found["target"] = _target(table, clock, name, entry, findings)
    return found


def _clocked(
    table: Table, clock: Clock, configuration: Configuration, plant: Plant, names: Sequence[str],
    findings: list[Notice],
) -> tuple[dict[str, Array], dict[str, Array], dict[str, Array], dict[str, Array]]:  # fmt: skip
    """Signals, their missing share, targets and finer pushes, at the plant's rate."""
    signals, given = configuration.signals, (configuration, plant, findings)
    acting = [name for name in plant.disturbances if name in names]
    even = {(name, kind): values for name in names
            for kind, values in signal_of(table, clock, name, *given).items()}  # fmt: skip
    shifts = {name: _shift(table.source, clock, name, signals[name]) for name in names}
    late = {key: 0.0 if key[1] == "target" else shifts[key[0]] for key in even}
    first, jumps = first_common(late), {name: steps_of(even[name, ""]) for name in acting}
    even = shifted(even, late)
    clocked: dict[str, dict[str, Array]] = {"": {}, "lost": {}, "target": {}}
    finer: dict[str, Array] = {}
    for (name, kind), values in even.items():
        resample = instants if name in plant.outputs else held_means
        resample = held_values if kind == "target" else resample
        clocked[kind][name] = resample(values, clock.period, plant.dt)
        steps = jumps.get(name)
        if plant.ahead or steps is None or steps.jitter * clock.period <= _JITTER * plant.dt:
            continue
        steps = steps.delayed(shifts[name] - first)
        finer[name] = held_means(values, clock.period, plant.dt, steps)
        switches = f"{name} switches every {steps.dwell * clock.period:.4g} s"
        placed = f"{switches}; its edges are placed between samples"
        findings.append(finding(table.source, placed, "signals", name, "shift"))
    targets = clocked["target"]
    samples = len(clocked[""][names[0]])
    for name in configuration.aimed:
        at = signals[name].target
        if isinstance(at, float | int):
            size = signals[name].sign * si_unit(signals[name].unit).factor
            targets[name] = np.full(samples, size * (at - signals[name].offset))
    return clocked[""], clocked["lost"], targets, finer


def _target(
    table: Table, clock: Clock, name: str, entry: SignalTable, findings: list[Notice]
) -> Array:
    """Target of a signal at uniform instants (last recorded value)."""
    channel = channel_of(table, clock, name, entry, "target")
    found = [
        checks.unit_of_the_file(channel, stated_unit(table, channel.column), entry.overrule_unit),
        checks.measurable(channel),
        checks.missing(channel, clock.fill_gaps),
    ]
    finite = np.isfinite(channel.values)
    instant = np.arange(clock.steps[-1] + 1)
    places = np.searchsorted(clock.steps[finite], instant, side="right") - 1
    findings += filter(None, found)
    return np.asarray(channel.unit.factor * channel.values[finite][places])


def require_whole(recordings: Sequence[Recording], command: str) -> None:
    """Refuse missing samples for a `command` that needs every sample."""
    if any(trial.has_gaps for trial in recordings):
        problem = f"leaves gaps, but impc {command} needs every sample"
        remedy = "remove it, or set fill_gaps"
        raise InputError("recording.keep_gaps", problem, remedy).at("", "recording", "keep_gaps")


def disturbances_of(table: Table, configuration: Configuration, plant: Plant) -> Array:
    """Perturbations of a table at the plant's rate (samples, d), in SI base units."""
    source = configuration.source
    for name in plant.disturbances:
        if name not in configuration.signals:
            remedy, place = "name the column of the file", ("signals", name)
            raise InputError(f"signals.{name}", "is missing", remedy).at(source, *place)
        for one in unit_faults(name, configuration.signals[name], plant.unit(name), source):
            raise one
    clock = read_clock(table, configuration.recording, plant.dt)
    checks.comparable_rates(table.source, clock.period, plant.dt)
    series, *_ = _clocked(table, clock, configuration, plant, plant.disturbances, [])
    return np.column_stack([series[name] for name in plant.disturbances])


def _shift(source: str, clock: Clock, name: str, entry: SignalTable) -> float:
    """Shift of a signal in samples of the recording; integers count samples, floats s."""
    shift = entry.delay(clock.period)[0]
    if abs(shift) > (len(clock.time) - 1) / 2:
        where, place = f"{source}: signals.{name}.shift", ("signals", name, "shift")
        problem = f"moves the signal by {shift:.4g} of {len(clock.time)} samples"
        raise DataError(where, problem, "use a smaller shift").at(source, *place)
    return shift


def _timing(clock: Clock, configuration: Configuration, plant: Plant) -> dict[str, float]:
    """Standard deviation of the time of signals in s: stated, or half a sample for pushes."""
    given = {
        name: entry.delay(clock.period)[1]
        for name, entry in configuration.signals.items()
        if not entry.command
    }
    assumed = dict.fromkeys(plant.disturbances, clock.period / 2)
    known = {name: value if value is not None else assumed.get(name, 0.0)
             for name, value in given.items()}  # fmt: skip
    return {name: value for name, value in known.items() if value}


def _departing(
    source: str,
    series: dict[str, Array],
    targets: dict[str, Array],
    configuration: Configuration,
    plant: Plant,
) -> list[Notice]:
    """Report offsets and drifts that are large compared with the motion."""
    found: list[Notice] = []
    if any(np.ptp(values) == 0 for values in targets.values()):
        return found  # a constant target moves the equilibrium away from zero
    acting = [series[name] for name in plant.disturbances if name in series]
    acting += targets.values()
    for name in plant.outputs:
        entry = configuration.signals[name]
        values = series[name] / (si_unit(entry.unit).factor * entry.sign)
        offset, drift = departures(values, acting)
        motion = float(np.ptp(values)) / 2
        moves = f"{entry.unit}, and moves by {motion:.3g}"
        digits = 2 - math.floor(math.log10(motion)) if motion > 0 else 0
        key = f"signals.{name}.offset = {round(entry.offset + offset, digits):g}"
        if abs(drift) > _DRIFT * motion:
            remedy = "remove the drift of the sensor from the file"
            said = f"drifts by about {drift:.2g} {moves}: {remedy}"
        elif abs(offset) > _OFFSET * motion:
            said = f"is off by about {offset:.2g} {moves}: if the sensor's zero is off, set {key}"
        else:
            continue
        found.append(finding(source, f"{name} {said}", "signals", name, "offset"))
    return found


def _later(source: str, outputs: Array, series: dict[str, Array], plant: Plant) -> list[Notice]:
    """Report a disturbance that acts earlier or later than in the plant."""
    found = []
    for index, name in enumerate(plant.disturbances):
        if name not in series:
            continue
        after = [np.linalg.matrix_power(plant.A, samples) for samples in range(3)]
        effects = np.array([plant.C @ power @ plant.E[:, index] for power in after])
        rows = rows_later(outputs, series[name], effects)
        if rows:
            how = f"{abs(rows)} sample{'s' * (abs(rows) > 1)} {'later' if rows > 0 else 'earlier'}"
            said = f"{name} acts {how} than recorded: try signals.{name}.shift = {rows}"
            found.append(finding(source, said, "signals", name, "shift"))
    return found


def faults_of(configuration: Configuration, plant: Plant) -> Iterator[InputError]:
    """Every fault of the signals of a configuration for a plant."""
    controls, source = plant.commands or plant.controls, configuration.source
    for name, entry in configuration.signals.items():
        place = source, "signals", name
        known = controls if entry.command else (*plant.outputs, *plant.disturbances)
        if entry.target is not None and name not in plant.outputs:
            remedy = f"set it for one of {', '.join(plant.outputs)}"
            error = InputError(f"signals.{name}.target", "is allowed for outputs only", remedy)
            yield error.at(*place, "target")
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1)
            remedy = f"did you mean {near[0]}?" if near else f"the plant has {', '.join(known)}"
            what = "command" if entry.command else "output or disturbance"
            yield InputError(f"signals.{name}", f"is no {what} of the plant", remedy).at(*place)
    for name in plant.outputs:
        if name not in configuration.signals:
            yield InputError(
                f"signals.{name}",
                f"is missing: the plant's outputs are {', '.join(plant.outputs)}",
                "write a table [signals.NAME] for each, or [plant] outputs = [...] with the others",
            ).at(source, "signals", name)
    for name, entry in configuration.signals.items():
        if name in (*plant.outputs, *plant.disturbances, *controls):
            yield from unit_faults(name, entry, plant.unit(name), source)


def unit_faults(name: str, entry: SignalTable, expected: str, file: str) -> Iterator[InputError]:
    """Column and unit of signal `name` that are not filled in, or a unit unlike `expected`."""
    for key, meant in (("column", "its name in the file"), ("unit", "the column's unit")):
        if getattr(entry, key) == FILL_IN:
            error = InputError(f"signals.{name}.{key}", f"is still {FILL_IN!r}", f"fill in {meant}")
            yield error.at(file, "signals", name, key)
    if expected == UNKNOWN or entry.unit == FILL_IN:
        return
    unit = si_unit(expected)
    if unit.factor != 1:
        yield InputError(
            f"plant.units {name}",
            f"is {expected!r}, not an SI base unit",
            "make the plant in SI units",
        )
    if si_unit(entry.unit).base not in (unit.base, "dimensionless"):
        yield InputError(
            f"signals.{name}.unit",
            f"is {entry.unit!r}, but the plant has {name} in {expected}",
            "correct the unit or the column",
        ).at(file, "signals", name, "unit")


def require_distinct(paths: Sequence[Path]) -> None:
    """Require that no file is given twice, under any name or as an identical copy."""
    sizes = Counter(os.path.getsize(path) for path in paths if os.path.isfile(path))
    seen: dict[str, Path] = {}
    for path in paths:
        place = os.path.realpath(path)  # Path.resolve raises for circular links
        problem = ""
        if place in seen:
            same = "" if str(seen[place]) == str(path) else f", also as {seen[place]}"
            problem = f"is given twice{same}"
        elif os.path.isfile(path) and sizes[os.path.getsize(path)] > 1:
            other = seen.setdefault(content_digest(path), path)
            problem = "" if other is path else f"is a copy of {other}, byte for byte"
        if problem:
            raise InputError(str(path), problem, "name each trial once").at(str(path))
        seen[place] = Path(path)


def label_of(source: str, entry: RecordingTable) -> Label:
    """Label of the trial in file `source`, from its name and the [recording] table."""
    # Bytes of a name that are not UTF-8 are shown escaped.
    stem = os.fsencode(Path(source).stem).decode("utf-8", "backslashreplace")
    groups: dict[str, str | None] = {}
    if entry.pattern is not None:
        found = match_apart("recording.pattern", entry.pattern, stem)
        if found is None:
            raise DataError(
                source,
                f"the name {stem!r} does not match recording.pattern {entry.pattern!r}",
                "rename the file or correct the pattern",
            ).at(source, "recording", "pattern")
        groups = found
    return Label(
        subject=groups.get("subject") or entry.subject,
        visit=groups.get("visit") or entry.visit,
        condition=groups.get("condition") or entry.condition,
        trial=groups.get("trial") or entry.trial or stem,
    )


def channel_of(
    table: Table, clock: Clock, name: str, entry: SignalTable, key: str = "column"
) -> checks.Channel:
    """Column of signal `name`, or of its target, in its own unit, after offset and sign."""
    column, values = column_of(table, getattr(entry, key), ("signals", name, key))
    values = checks.without_codes(values, () if entry.missing is None else entry.missing)
    values = checks.held(values) if entry.held else values
    # Overflow and signalling NaN become values that are not finite, reported below.
    with np.errstate(over="ignore", invalid="ignore"):
        used = entry.sign * (values[clock.rows] - entry.offset)
    return checks.Channel(table.source, name, column, si_unit(entry.unit), clock.time, used)


def _checked(
    table: Table,
    channel: checks.Channel,
    entry: SignalTable,
    clock: Clock,
    response: bool,
    keep: bool | None,
) -> list[Notice]:
    """All checks of a channel; faults that explain others come first."""
    raw = table.columns[channel.column][clock.rows]
    if entry.missing is None:
        checks.coded(channel, raw)
    if entry.held is None and not response:
        checks.written_at_changes(channel, raw)
    found = [
        checks.unit_of_the_file(channel, stated_unit(table, channel.column), entry.overrule_unit),
        checks.measurable(channel),
        checks.missing(channel, clock.fill_gaps, keep),
        checks.constant(channel),
        checks.degrees_for_radians(channel) if response else None,
        None if entry.limit is None else checks.beyond_the_stop(channel, entry.limit),
        # A perturbation of two or three levels stays at its extremes by design.
        checks.clipped(channel) if response else None,
        checks.stretches(channel) if response else None,
        checks.straight(channel) if response else None,
    ]
    return [one for one in found if one]


def stated_unit(table: Table, column: str) -> Unit | None:
    """Unit that the file states for a `column`; None if missing or unknown."""
    try:
        return si_unit(table.units[column])
    except (KeyError, InputError):
        return None
