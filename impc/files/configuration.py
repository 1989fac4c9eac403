"""What the columns of a recording mean: a short TOML file, checked at the door.

[recording] says time or rate, label and cut; [signals.NAME], one table a signal of the plant, says
column, unit, stop, offset and sign; [plant], [fit] and [plan] are arguments of the plant and
settings of the fit and of a plan, and not interpreted here.
"""

from __future__ import annotations

import difflib
import os
import re
import sys
import tomllib
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar, get_args, get_type_hints

import msgspec

from impc.checking import checked
from impc.errors import InputError, brief
from impc.files.disk import require_readable
from impc.files.units import si_unit

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

#: What `impc inspect` writes where nothing says; it has to be filled in.
FILL_IN = "?"

_LARGEST = 1_000_000
_DEEPEST = 16  # tables within tables
_DOTTED = re.compile(rf"""(?:(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')[ \t]*+\.[ \t]*+){{{_DEEPEST}}}""")
_LABELS = ("subject", "visit", "condition", "trial")
_TABLES = ("recording", "signals", "plant", "fit", "plan", "report")
_STUDY = ("study", "model", "select")

_MOST = sys.float_info.max
Finite = Annotated[float, msgspec.Meta(ge=-_MOST, le=_MOST)]
Positive = Annotated[float, msgspec.Meta(gt=0, le=_MOST)]
T = TypeVar("T")
S = TypeVar("S", bound=msgspec.Struct)


class RecordingTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The [recording] table."""

    time: str | None = None  # Column with the clock
    time_unit: str | None = None  # Its unit; None takes the one that the file says, or seconds
    # Samples per second, where there is no clock. Neither is needed for TDMS and C3D.
    rate: Positive | None = None
    subject: str = ""  # The label of the trial; empty where it is not said
    visit: str = ""
    condition: str = ""
    trial: str = ""
    # Regular expression that the file's name without its ending must match as a whole; its named
    # groups subject, visit, condition and trial give the label
    pattern: str | None = None
    # Seconds; the longest gap that may be filled by interpolation. 0 fills none.
    fill_gaps: Annotated[float, msgspec.Meta(ge=0, le=_MOST)] = 0.0
    # Whether longer gaps of outputs and commands count as not measured
    keep_gaps: bool = False
    # Seconds on the file's clock, which begins at 0 where there is only a rate
    start: Finite | None = None
    stop: Finite | None = None
    sheet: str = ""  # Of a workbook; empty for the first one with rows of numbers


class SignalTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A [signals.NAME] table: si value = sign * (column - offset) in SI base units."""

    column: str  # Column of the file
    unit: str  # Its unit, as pint knows it
    # Mechanical stop in this unit: the largest magnitude after offset and sign
    limit: Positive | None = None
    offset: Finite = 0.0  # In this unit
    sign: Literal[1, -1] = 1  # 1 or -1
    overrule_unit: bool = False  # Whether `unit` counts where the file gives another one
    # By how much the signal is moved later: a whole number of samples, or seconds with a point
    shift: int | Finite = 0
    # Whether it is a command of the subject that was recorded, and not a disturbance
    command: bool = False
    # What an output is regulated to: a column, or one value; unit, offset and sign are the signal's
    target: str | Finite | None = None


class ReportTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The [report] table."""

    # "degrees" or "radians": in which all pages and figures of a run show angles
    angles: Literal["degrees", "radians"] = "degrees"


class Configuration(msgspec.Struct, frozen=True):
    """What a configuration file says."""

    recording: RecordingTable
    signals: dict[str, SignalTable]  # By the name of an output or disturbance of the plant
    plant: dict[str, Any] = {}  # Arguments of the plant's function; not interpreted here
    fit: dict[str, Any] = {}  # Settings of the fit; not interpreted here
    plan: dict[str, Any] = {}  # Of an experiment that is planned; not interpreted here
    study: dict[str, Any] = {}  # Tables of a study; not interpreted here
    model: dict[str, Any] = {}
    select: dict[str, Any] = {}
    report: ReportTable = ReportTable()

    @property
    def recorded(self) -> tuple[str, ...]:
        """The signals that are no commands: what is recorded of the plant."""
        return tuple(name for name, entry in self.signals.items() if not entry.command)

    @property
    def aimed(self) -> tuple[str, ...]:
        """The signals with a target."""
        return tuple(name for name, entry in self.signals.items() if entry.target is not None)


@checked
def read_configuration(path: Path | str, *more: str) -> Configuration:
    r"""Read the configuration at `path`; `more` names tables that it may have besides.

    Raises
    ------
    InputError
        When the file cannot be read, is no TOML, or has a key or value that cannot be: the message
        names it by its TOML path.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import impc
    >>> text = '[recording]\nrate = 100\n[signals.angle]\ncolumn = "tilt"\nunit = "deg"\n'
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder, "lab.toml")
    ...     _ = path.write_text(text)
    ...     found = impc.read_configuration(path)
    >>> found.recording.rate, found.signals["angle"].unit
    (100.0, 'deg')
    """
    source = str(path)
    content = _parsed(source, Path(path))
    require_known(lambda key: f"{source}: {key}", content, (*_TABLES, *more), "is not known")
    tables = {name: content.get(name, {}) for name in (*_TABLES, *_STUDY)}
    for name, table in tables.items():
        if not isinstance(table, dict):
            raise InputError(f"{source}: {name}", "is not a table", f"write [{name}]")
    written = {
        key: str(value) if key in _LABELS and type(value) is int else value
        for key, value in tables["recording"].items()
    }
    recording = _convert(source, "recording", written, RecordingTable)
    _check_recording(source, recording)
    signals = {}
    for name, table in tables["signals"].items():
        signals[name] = _convert(source, f"signals.{brief(name, 80)}", table, SignalTable)
        if signals[name].unit != FILL_IN:
            _unit(source, f"signals.{brief(name, 80)}.unit", signals[name].unit)
    # A plan needs none: nothing is recorded yet.
    if not signals and not tables["plan"]:
        raise InputError(
            f"{source}: signals", "names no signal", "write a table [signals.NAME] for each"
        )
    plain: dict[str, Any] = {name: tables[name] for name in ("plant", "fit", "plan", *_STUDY)}
    report = _convert(source, "report", tables["report"], ReportTable)
    return Configuration(recording, signals, report=report, **plain)


def _parsed(source: str, path: Path) -> dict[str, Any]:
    if not os.path.lexists(path):
        raise InputError(source, "does not exist", "`impc inspect FILE --out` writes one")
    require_readable(path, _LARGEST, InputError)
    try:
        text = path.read_text(encoding="utf-8-sig")
        # tomllib keeps every prefix of a dotted key: one of 32 kB takes 1 GB.
        content = {} if (dotted := _DOTTED.search(text)) else tomllib.loads(text)
        if dotted or _deeper(content, _DEEPEST):
            raise RecursionError
        return content
    except OSError as error:
        reason = error.strerror or type(error).__name__
        raise InputError(source, f"cannot be opened ({reason})", "check the path") from None
    except UnicodeDecodeError:
        raise InputError(source, "is not UTF-8 text", "save it as UTF-8") from None
    except ValueError as error:  # an integer of 5000 digits is no TOMLDecodeError
        raise InputError(
            source, f"is not TOML ({brief(str(error), 160)})", "correct that line"
        ) from None
    except RecursionError:
        raise InputError(source, "is nested too deep", "give a plain TOML file") from None


def _deeper(value: Any, levels: int) -> bool:
    """Whether tables and lists are nested more than so many `levels` deep."""
    items = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    return levels < 0 or any(_deeper(item, levels - 1) for item in items)


def require_known(
    where: Callable[[str], str], table: Mapping[str, Any], known: Iterable[str], problem: str
) -> None:
    """Refuse a key that is not `known`; `where` makes the subject of a message from a path."""
    names = list(known)
    for key in table:
        if key not in names:
            near = difflib.get_close_matches(key, names, n=1, cutoff=0.5)
            remedy = f"did you mean {near[0]}?" if near else f"known: {', '.join(names)}"
            raise InputError(where(brief(key, 80)), problem, remedy)


def converted(
    where: Callable[[str], str], table: Mapping[str, Any], kind: type[T], see: str = "correct it"
) -> T:
    """The `table` as a `kind` of value, by msgspec; its messages in ours.

    `where` makes the subject of a message from a path, and `see` is what to do about most faults.
    """
    try:
        return msgspec.convert(table, kind)
    except msgspec.ValidationError as error:
        said, _, path = str(error).partition(" - at `$")
    path = path.rstrip("`").lstrip(".")
    unknown = re.fullmatch("Object contains unknown field `(.*)`", said)
    if unknown:
        raise InputError(where(f"{path}.{unknown[1]}"), "is not a setting", see)
    limit = re.fullmatch("Expected `(?:int|float)` ([<>]=?) (.*)", said)
    if limit and "..." not in path:
        found: Any = table
        for part in re.findall(r"[^.\[\]]+", path):
            found = found[int(part)] if isinstance(found, list) else found[part]
        words = {">": "more than", ">=": "at least", "<": "less than", "<=": "at most"}
        raise InputError(
            where(path), f"got {brief(found)}", f"give {words[limit[1]]} {float(limit[2]):.6g}"
        )
    problem = said.replace("Object missing required field", "lacks").replace("`", "'")
    problem = problem.replace("Expected 'array' of length >= 1", "is empty")
    allowed = get_args(get_type_hints(kind).get(path)) if "enum" in said else ()
    if allowed:
        see = f"give {' or '.join(map(str, allowed))}"
    raise InputError(where(path), problem, see)


def _convert(source: str, place: str, table: Any, kind: type[S]) -> S:
    if not isinstance(table, dict):
        raise InputError(f"{source}: {place}", "is not a table", f"write [{place}]")

    def where(path: str) -> str:
        return f"{source}: {place}.{path}" if path else f"{source}: {place}"

    require_known(where, table, kind.__struct_fields__, "is not known")
    return converted(where, table, kind)


def _check_recording(source: str, table: RecordingTable) -> None:
    def refuse(key: str, problem: str, remedy: str) -> InputError:
        return InputError(f"{source}: recording.{key}", problem, remedy)

    if table.time is not None and table.rate is not None:
        raise refuse("rate", "is given beside recording.time", "keep one of the two")
    if table.start is not None and table.stop is not None and table.stop <= table.start:
        raise refuse("stop", f"is {table.stop:g} s, start {table.start:g} s", "give a later one")
    if table.time_unit is not None and _unit(source, "recording.time_unit", table.time_unit) != (
        "second"
    ):
        raise refuse(
            "time_unit", f"{brief(table.time_unit, 80)!r} is no time", 'write "s", "ms" or "us"'
        )
    if table.pattern is not None:
        _check_pattern(refuse, table, table.pattern)


def _check_pattern(refuse: Any, table: RecordingTable, pattern: str) -> None:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # "possible nested set"
            groups = re.compile(pattern).groupindex
    except (re.error, OverflowError, RecursionError) as error:
        raise refuse(
            "pattern", f"is no regular expression ({brief(str(error), 80)})", "correct it"
        ) from None
    if not groups or not set(groups) <= set(_LABELS):
        named = ", ".join(f"(?P<{name}>...)" for name in _LABELS)
        raise refuse(
            "pattern", f"has the groups {brief(str(list(groups)), 80)}", f"name some of {named}"
        )
    for name in groups:
        if getattr(table, name):
            raise refuse(name, "is given, and in recording.pattern too", "keep one of the two")


def _unit(source: str, place: str, written: str) -> str:
    try:
        return si_unit(written).base
    except InputError as error:
        raise InputError(
            f"{source}: {place}", f"{error.subject} {error.problem}", error.remedy
        ) from None
