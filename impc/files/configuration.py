"""Read and validate the TOML file that describes the columns of a recording.

[subject] has plant and files of a fit; [recording] has clock or rate, label and cut;
[signals.NAME], one table for each signal of the plant, has column, unit, mechanical stop, offset
and sign. [plant], [fit] and [plan] are passed on and not interpreted here.
"""

from __future__ import annotations

import difflib
import os
import re
import sys
import tomllib
import warnings
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path, PureWindowsPath
from typing import Annotated, Any, Literal, TypeVar, get_args, get_type_hints

import msgspec

from impc.checking import checked
from impc.errors import InputError, blamed, brief
from impc.files.disk import require_readable
from impc.files.units import si_unit

#: Placeholder that `impc inspect` writes for an unknown unit; the user has to replace it.
FILL_IN = "?"

_LARGEST = 1_000_000
_DEEPEST = 16  # nested tables
_DOTTED = re.compile(rf"""(?:(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')[ \t]*+\.[ \t]*+){{{_DEEPEST}}}""")
_LABELS = ("subject", "visit", "condition", "trial")
_TABLES = ("subject", "recording", "signals", "plant", "fit", "plan", "report")
_STUDY = ("study", "model", "select")

# A delay with its standard deviation, such as "0 ± 2 ms" or "-0.02 +- 0.001 s".
_SHIFT = r"^\s*([+-]?\d+(?:\.\d*)?)\s*(?:±|\+/?-)\s*(\d+(?:\.\d*)?)\s*(ms|s)\s*$"
_SECONDS = {"ms": 1e-3, "s": 1.0}
_MOST = sys.float_info.max
Finite = Annotated[float, msgspec.Meta(ge=-_MOST, le=_MOST)]
Positive = Annotated[float, msgspec.Meta(gt=0, le=_MOST)]
T = TypeVar("T")
S = TypeVar("S", bound=msgspec.Struct)


class SubjectTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The [subject] table: what `impc fit --config FILE` and `impc compare --config FILE` fit.

    Attributes
    ----------
    plant : str, optional
        Plant as for `--plant`, which replaces it; a file of matrices is relative to this file.
    files : list of str, optional
        Recordings, one for each trial, relative to this file; FILES of the command replace them.
    """

    plant: str = ""
    files: tuple[str, ...] = ()


class RecordingTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The [recording] table.

    Attributes
    ----------
    time : str, optional
        Column with the time of each sample.
    time_unit : str, optional
        Unit of the time column, such as "s" or "ms"; by default the unit stated in the file, or s.
    rate : float, optional
        Samples per second, if there is no time column. TDMS and C3D files need neither.
    subject : str, optional
        Code of the subject.
    visit : str, optional
        Visit (session).
    condition : str, optional
        Experimental condition.
    trial : str, optional
        Name of the trial; by default the name of the file.
    pattern : str, optional
        Regular expression that must match the whole file name without its ending. Its named
        groups `subject`, `visit`, `condition` and `trial` give the label.
    fill_gaps : float, optional
        Longest gap in s that is filled by interpolation; by default a sample of the model.
    keep_gaps : bool, optional
        Whether longer gaps of outputs and commands count as not measured instead of an error.
    start : float, optional
        First time that is used, in s on the file's clock (from 0 if only a rate is given).
    stop : float, optional
        Last time that is used, in s on the file's clock.
    sheet : str, optional
        Sheet of a workbook; by default the first one with rows of numbers.
    """

    time: str | None = None
    time_unit: str | None = None
    rate: Positive | None = None
    subject: str = ""
    visit: str = ""
    condition: str = ""
    trial: str = ""
    pattern: str | None = None
    fill_gaps: Annotated[float, msgspec.Meta(ge=0, le=_MOST)] | None = None
    keep_gaps: bool = False
    start: Finite | None = None
    stop: Finite | None = None
    sheet: str = ""


class SignalTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A [signals.NAME] table: value in SI units = sign * (column - offset), converted.

    Attributes
    ----------
    column : str
        Column of the file.
    unit : str
        Unit of the column, as the library pint spells it, such as "deg", "rad/s" or "N*m".
    limit : float, optional
        Mechanical stop in `unit`: largest possible magnitude after offset and sign.
    offset : float, optional
        Reading of the sensor at zero, in `unit`; it is subtracted first.
    sign : 1 or -1, optional
        -1 reverses the direction of the signal.
    overrule_unit : bool, optional
        Whether `unit` counts although the file states another one.
    shift : int, float or str, optional
        Delay that is added to the signal: a whole number of samples, or s if written with a point.
        Text such as "0 ± 2 ms" also states its standard deviation; a fit then estimates the rest.
        Without one it is half a recorded sample for a perturbation, 0 for other signals.
    command : bool, optional
        Whether the signal is a recorded command of the subject and not a disturbance.
    missing : float or list of float, optional
        Code of a missing value in the file, such as -9999; `[]` if no value is one.
    held : bool, optional
        Whether the column is written only where it changes: each value holds until the next one.
    target : str or float, optional
        Value that the subject regulates an output to: a column, or a constant; with unit, offset
        and sign of the signal.
    """

    column: str
    unit: str
    limit: Positive | None = None
    offset: Finite = 0.0
    sign: Literal[1, -1] = 1
    overrule_unit: bool = False
    shift: int | Finite | Annotated[str, msgspec.Meta(pattern=_SHIFT)] = 0
    command: bool = False
    missing: Finite | tuple[Finite, ...] | None = None
    held: bool | None = None
    target: str | Finite | None = None

    def delay(self, period: float) -> tuple[float, float | None]:
        """Delay in samples of `period` s, and its stated standard deviation in s, if any."""
        if isinstance(self.shift, str):
            found = re.match(_SHIFT, self.shift)
            assert found is not None  # the pattern of the field
            mean, deviation = float(found[1]), float(found[2])
            unit = _SECONDS[found[3]]
            return unit * mean / period, unit * deviation
        return (self.shift if isinstance(self.shift, int) else self.shift / period), None


class ReportTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The [report] table.

    Attributes
    ----------
    angles : "degrees" or "radians", optional
        Unit of angles in all pages and figures of a run.
    """

    angles: Literal["degrees", "radians"] = "degrees"


class Configuration(msgspec.Struct, frozen=True):
    """Content of a configuration file."""

    recording: RecordingTable
    signals: dict[str, SignalTable]  # by name of the plant's output, disturbance or command
    plant: dict[str, Any] = {}  # arguments of the plant's function; not interpreted here
    fit: dict[str, Any] = {}  # settings of the fit; not interpreted here
    plan: dict[str, Any] = {}  # settings of a planned experiment; not interpreted here
    study: dict[str, Any] = {}  # tables of a study; not interpreted here
    model: dict[str, Any] = {}
    select: dict[str, Any] = {}
    report: ReportTable = ReportTable()
    subject: SubjectTable = SubjectTable()
    source: str = ""  # file, for messages

    @property
    def recorded(self) -> tuple[str, ...]:
        """Names of the recorded signals that are not commands."""
        return tuple(name for name, entry in self.signals.items() if not entry.command)

    @property
    def aimed(self) -> tuple[str, ...]:
        """Names of the signals with a target."""
        return tuple(name for name, entry in self.signals.items() if entry.target is not None)


@checked
def read_configuration(path: Path | str, *more: str) -> Configuration:
    r"""Read the TOML file that describes the columns of a recording.

    Parameters
    ----------
    path : Path or str
        Configuration file.
    *more : str
        Names of further tables that the file may contain.

    Returns
    -------
    Configuration
        Validated content of the file.

    Raises
    ------
    InputError
        If the file cannot be read, is not TOML, or has an unknown key or invalid value; the
        message names the key by its TOML path.

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
    with blamed(source):
        content = toml_content(_text(source, Path(path)), source)
    return configuration(content, source, *more)


def require_inside(where: str, name: str) -> None:
    """Reject a path that leaves the folder it is relative to, on any system."""
    path = PureWindowsPath(name)  # either slash separates
    if not path.name or path.anchor or ".." in path.parts or not name.isprintable():
        raise InputError(
            where, f"{brief(name, 80)!a} is no path below its folder", "name a file in that folder"
        )


def configuration(content: Mapping[str, Any], source: str, *more: str) -> Configuration:
    """Validate the content of a configuration file called `source`; `more` names further tables."""
    with blamed(source):
        require_known(lambda key: f"{source}: {key}", content, (*_TABLES, *more), "is not known")
        tables = {name: content.get(name, {}) for name in (*_TABLES, *_STUDY)}
        for name, table in tables.items():
            if not isinstance(table, dict):
                error = InputError(f"{source}: {name}", "is not a table", f"write [{name}]")
                raise error.at("", name)
        written = {
            key: str(value) if key in _LABELS and type(value) is int else value
            for key, value in tables["recording"].items()
        }
        recording = _convert(source, ("recording",), written, RecordingTable)
        _check_recording(source, recording)
        signals = {}
        for name, table in tables["signals"].items():
            signals[name] = _convert(source, ("signals", name), table, SignalTable)
            if signals[name].unit != FILL_IN:
                _unit(source, ("signals", name, "unit"), signals[name].unit)
        # A plan needs no signals: nothing is recorded yet.
        if not signals and not tables["plan"]:
            raise InputError(
                f"{source}: signals", "contains no signal", "write a table [signals.NAME] for each"
            ).at("", "signals")
        plain: dict[str, Any] = {name: tables[name] for name in ("plant", "fit", "plan", *_STUDY)}
        report = _convert(source, ("report",), tables["report"], ReportTable)
        subject = _convert(source, ("subject",), tables["subject"], SubjectTable)
        for name in subject.files:
            require_inside(f"{source}: subject.files", name)
        return Configuration(
            recording, signals, report=report, subject=subject, source=source, **plain
        )


def _text(source: str, path: Path) -> str:
    if not os.path.lexists(path):
        raise InputError(source, "does not exist", "create it with `impc inspect FILE --out`")
    require_readable(path, _LARGEST, InputError)
    try:
        return path.read_text(encoding="utf-8-sig")
    except OSError as error:
        reason = error.strerror or type(error).__name__
        raise InputError(source, f"cannot be opened ({reason})", "check the path") from None
    except UnicodeDecodeError:
        raise InputError(source, "is not UTF-8 text", "save it as UTF-8") from None


def toml_content(text: str, source: str) -> dict[str, Any]:
    """Content of a TOML `text`, which must not be nested deep; `source` names it in messages."""
    try:
        # tomllib stores every prefix of a dotted key: one of 32 kB takes 1 GB.
        content = {} if (dotted := _DOTTED.search(text)) else tomllib.loads(text)
        if dotted or _deeper(content, _DEEPEST):
            raise RecursionError
        return content
    except ValueError as error:  # an integer of 5000 digits raises no TOMLDecodeError
        raise InputError(
            source,
            f"is not TOML ({brief(str(error), 160)})",
            'correct that line: numbers need a point (6.0), text straight quotes ("deg")',
        ) from None
    except RecursionError:
        raise InputError(source, "is nested too deep", "give a plain TOML file") from None


def _deeper(value: Any, levels: int) -> bool:
    """Whether tables and lists are nested more than `levels` deep."""
    items = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    return levels < 0 or any(_deeper(item, levels - 1) for item in items)


def require_known(
    where: Callable[[str], str], table: Mapping[str, Any], known: Iterable[str], problem: str,
    place: tuple[str, ...] = (),
) -> None:  # fmt: skip
    """Reject keys that are not `known`; `where` makes a message's subject from a key."""
    names = list(known)
    for key in table:
        if key not in names:
            near = difflib.get_close_matches(key, names, n=1, cutoff=0.5)
            remedy = f"did you mean {near[0]}?" if near else f"known: {', '.join(names)}"
            raise InputError(where(brief(key, 80)), problem, remedy).at("", *place, key)


def converted(
    where: Callable[[str], str], table: Mapping[str, Any], kind: type[T], see: str = "correct it",
    place: tuple[str, ...] = (),
) -> T:  # fmt: skip
    """Convert `table` to type `kind` with msgspec, with error messages in this package's form.

    `where` makes the subject of a message from a path; `see` is the remedy for most faults.
    """
    try:
        return msgspec.convert(table, kind)
    except msgspec.ValidationError as error:
        said, _, path = str(error).partition(" - at `$")
    path = path.rstrip("`").lstrip(".")
    place += tuple(part for part in re.findall(r"[^.\[\]]+", path) if not part.isdigit())
    unknown = re.fullmatch("Object contains unknown field `(.*)`", said)
    if unknown:
        place = (*place, unknown[1])
        raise InputError(where(f"{path}.{unknown[1]}"), "is not a setting", see).at("", *place)
    limit = re.fullmatch("Expected `(?:int|float)` ([<>]=?) (.*)", said)
    if limit and "..." not in path:
        found: Any = table
        for part in re.findall(r"[^.\[\]]+", path):
            found = found[int(part)] if isinstance(found, list) else found[part]
        words = {">": "more than", ">=": "at least", "<": "less than", "<=": "at most"}
        raise InputError(
            where(path), f"got {brief(found)}", f"give {words[limit[1]]} {float(limit[2]):.6g}"
        ).at("", *place)
    problem = said.replace("Object missing required field", "lacks").replace("`", "'")
    problem = problem.replace("Expected 'array' of length >= 1", "is empty")
    allowed = get_args(get_type_hints(kind).get(path)) if "enum" in said else ()
    if allowed:
        see = f"give {' or '.join(map(str, allowed))}"
    raise InputError(where(path), problem, see).at("", *place)


def _convert(source: str, place: tuple[str, ...], table: Any, kind: type[S]) -> S:
    named = _named(place)
    if not isinstance(table, dict):
        raise InputError(f"{source}: {named}", "is not a table", f"write [{named}]").at("", *place)

    def where(path: str) -> str:
        return f"{source}: {named}.{path}" if path else f"{source}: {named}"

    require_known(where, table, kind.__struct_fields__, "is not known", place)
    return converted(where, table, kind, place=place)


def _named(place: tuple[str, ...]) -> str:
    return ".".join(brief(name, 80) for name in place)


def _check_recording(source: str, table: RecordingTable) -> None:
    def refuse(key: str, problem: str, remedy: str) -> InputError:
        error = InputError(f"{source}: recording.{key}", problem, remedy)
        return error.at("", "recording", key)

    if table.time is not None and table.rate is not None:
        raise refuse("rate", "is given in addition to recording.time", "keep one of the two")
    if table.start is not None and table.stop is not None and table.stop <= table.start:
        raise refuse("stop", f"is {table.stop:g} s, start {table.start:g} s", "make it later")
    place = ("recording", "time_unit")
    if table.time_unit is not None and _unit(source, place, table.time_unit) != "second":
        raise refuse(
            "time_unit",
            f"{brief(table.time_unit, 80)!r} is not a unit of time",
            'write "s", "ms" or "us"',
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
            "pattern", f"is not a regular expression ({brief(str(error), 80)})", "correct it"
        ) from None
    if not groups or not set(groups) <= set(_LABELS):
        named = ", ".join(f"(?P<{name}>...)" for name in _LABELS)
        raise refuse(
            "pattern",
            f"has the named groups {brief(str(list(groups)), 80)}",
            f"use at least one of {named}, and no others",
        )
    for name in groups:
        if getattr(table, name):
            raise refuse(name, "is given here and in recording.pattern", "keep one of the two")


def _unit(source: str, place: tuple[str, ...], written: str) -> str:
    try:
        return si_unit(written).base
    except InputError as error:
        problem = f"{error.subject} {error.problem}"
        raise InputError(f"{source}: {_named(place)}", problem, error.remedy).at(
            "", *place
        ) from None
