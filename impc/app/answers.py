"""Forms and the answers in subject.toml: columns with their questions, and changes by a form."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import tomlkit

from impc.app.subject import Subject
from impc.arrays import Array
from impc.errors import InputError
from impc.files.configuration import FILL_IN, SignalTable
from impc.files.draft import guess_of, questions
from impc.files.plant_sources import UNCERTAINTY
from impc.files.reading import unit_faults
from impc.files.table import Table
from impc.files.units import si_unit
from impc.model.plant import Plant
from impc.reporting.shown_units import signal_name

Changes = dict[tuple[str, ...], Any]  # new value by TOML path; None removes
CLOCK = "time"
#: Horizon in samples without another answer.
HORIZON = 20
# Number of stretches of a curve, each drawn from its least to its largest value.
_POINTS = 500


@dataclass(frozen=True)
class Role:
    """What a column can be."""

    words: str
    kind: str  # "clock", "output" or "other": which fields it has
    positive: str = ""  # Direction in words


@dataclass(frozen=True)
class Mark:
    """Whether a column needs a key: a code for missing values, or values that hold."""

    key: str
    line: str  # What is written if so
    asked: str
    answer: str  # "yes", "no", or empty


@dataclass(frozen=True)
class Column:
    """A column of the shown file, with the answers so far."""

    name: str
    role: str  # Key of `roles`; empty if it is not used
    unit: str
    entry: Mapping[str, Any]  # The other answers by their keys in subject.toml
    question: str  # To be answered; empty if there is none
    check: str  # A guess to be checked
    marks: tuple[Mark, ...]
    curve: tuple[list[float], list[float]]  # s (or samples), values
    spoken: str  # The curve for who cannot see it


def roles(plant: Plant) -> dict[str, Role]:
    """All that a column can be, by its name in the file."""
    said = [(name, "output", "{}") for name in plant.outputs]
    said += [(name, "other", "Push: {}") for name in plant.controls[1:]]
    said += [(name, "other", "Command: {}") for name in plant.controls[:1]]
    found = {CLOCK: Role("Time", "clock")}
    for name, kind, words in said:
        shown = words.format(signal_name(plant, name))
        found[name] = Role(shown[:1].upper() + shown[1:], kind, plant.direction(name))
    return found


def columns(text: str, table: Table, plant: Plant) -> list[Column]:
    """The columns of a file with their answers in `text` (subject.toml)."""
    document, known = tomlkit.parse(text), roles(plant)
    recording, signals = document.get("recording", {}), document.get("signals", {})
    taken = {entry.get("column"): name for name, entry in signals.items() if name in known}
    taken |= {recording.get("time"): CLOCK}
    time = _seconds(table, recording)
    found = []
    for name, values in table.columns.items():
        role = taken.get(name, "")
        entry = recording if role == CLOCK else signals.get(role, {})
        key, named = ("time_unit", "time") if role == CLOCK else ("unit", "column")
        unit = str(entry.get(key, table.units.get(name, "")))
        origin = guess_of(table, name, "").origin.rstrip(" ,.")
        comment = entry.item(named).trivia.comment.lstrip("# ") if named in entry else ""
        asked = f"Which unit is it in? {origin[0].upper()}{origin[1:]}."
        guessed = f"This is {comment[:1].lower()}{comment[1:].replace('GUESS', 'guess')}"
        shown = entry.get("sign", 1) * (values - float(entry.get("offset", 0)))
        found.append(Column(
            name, role, "" if unit == FILL_IN else unit, entry,
            asked if role and unit == FILL_IN else "",
            guessed if "guess" in comment.lower() else "",
            _marks(table, name, entry, known[role]) if role not in ("", CLOCK) else (),
            _curve(time, shown), _spoken(shown),
        ))  # fmt: skip
    return found


def _marks(table: Table, name: str, entry: Mapping[str, Any], role: Role) -> tuple[Mark, ...]:
    found = []
    for line, asked in questions(table, name, role.kind == "other"):
        key = line.partition(" ")[0]
        no = key in entry and not entry[key]
        found.append(Mark(key, line, asked, "no" if no else "yes" if key in entry else ""))
    return tuple(found)


def _seconds(table: Table, recording: Mapping[str, Any]) -> Array:
    """Time of each sample in s on the file's clock, or the number of the sample."""
    values = table.columns.get(str(recording.get("time")))
    if values is None:
        count = np.arange(table.samples, dtype=float)
        return count / float(recording.get("rate", table.rate or 1.0))
    return values * si_unit(str(recording.get("time_unit", "s"))).factor


def _curve(time: Array, values: Array) -> tuple[list[float], list[float]]:
    """Least and largest value of each stretch."""
    known = np.flatnonzero(np.isfinite(values) & np.isfinite(time))
    parts = np.array_split(known, max(1, min(_POINTS, len(known) // 2)))
    picks = [{part[np.argmin(values[part])], part[np.argmax(values[part])]}
             for part in parts if len(part)]  # fmt: skip
    at = [place for pick in picks for place in sorted(pick)]
    return [float(f"{x:.6g}") for x in time[at]], [float(f"{x:.5g}") for x in values[at]]


def _spoken(values: Array) -> str:
    known = values[np.isfinite(values)]
    if not len(known):
        return "no values"
    missing = f", {len(values) - len(known)} missing" if len(known) < len(values) else ""
    return f"from {known.min():.4g} to {known.max():.4g}, mean {known.mean():.4g}{missing}"


def signal_changes(form: Mapping[str, str], table: Table, subject: Subject) -> Changes:
    """Changes of subject.toml by the fields of the signals."""
    plant, names = subject.plant(), list(table.columns)
    known, chosen = roles(plant), dict[str, int]()
    for index, name in enumerate(names):
        role = form.get(f"role.{index}", "")
        if role in chosen:
            words = f"is chosen for {names[chosen[role]]!r} and {name!r}"
            raise InputError(known[role].words, words, "choose it for one column")
        if role in known:
            chosen[role] = index
    found: Changes = {("signals", role): None for role in known if role not in {CLOCK, *chosen}}
    found |= {("recording", key): None for key in (CLOCK, "time_unit")}
    for key, words in (("rate", "samples per second"), ("start", "begin"), ("stop", "end")):
        found["recording", key] = number(form.get(key, ""), words)
    found["recording", "subject"] = form.get("subject", "").strip()
    found["recording", "sheet"] = form.get("sheet", "").strip() or None
    sure = set[tuple[str, ...]]()
    for role, index in chosen.items():
        unit, keys = form.get(f"unit.{index}", "").strip(), Changes()
        if role == CLOCK:
            keys["recording", CLOCK], keys["recording", "time_unit"] = names[index], unit or "s"
            found["recording", "rate"] = None
        else:
            entry = _signal(form, index, names[index], known[role])
            given = SignalTable(column=names[index], unit=unit)
            fault = next(unit_faults(role, given, plant.unit(role), names[index]), None)
            if unit and fault is not None:
                raise fault
            for mark in _marks(table, names[index], {}, known[role]):
                value = tomllib.loads(mark.line)[mark.key]
                no: Any = [] if mark.key == "missing" else False
                answer = form.get(f"{mark.key}.{index}", "")
                entry[mark.key] = {"yes": value, "no": no}.get(answer)
            entry |= {"unit": unit or FILL_IN, "command": role == plant.controls[0] or None}
            keys = {("signals", role, key): value for key, value in entry.items()}
        found |= keys
        if f"sure.{index}" in form:
            sure |= {key for key, value in keys.items() if value not in (None, FILL_IN)}
    return _changed(found, subject, sure)


def _signal(form: Mapping[str, str], index: int, column: str, role: Role) -> dict[str, Any]:
    """The table of a signal; None for what is not given."""
    stop = form.get(f"limit.{index}", "") if role.kind == "output" else ""
    return {
        "column": column,
        "sign": -1 if form.get(f"sign.{index}") == "-1" else None,
        "offset": number(form.get(f"offset.{index}", ""), f"zero of {column}") or None,
        "limit": number(stop, f"stop of {column}", 0.0),
    }


def body_changes(form: Mapping[str, str], subject: Subject) -> Changes:
    """Changes of subject.toml by the fields of body and limit; an empty field is no answer yet."""
    found = Changes()
    for one in subject.source.parameters():
        text = form.get(f"plant.{one.name}", "").strip()
        value: Any = text or None
        if not one.choices and not isinstance(one.value, str):
            value = number(text, one.words)
            if isinstance(one.value, int) and value is not None and value == int(value):
                value = int(value)
        if value is None and one.own and not one.choices and f"typical.{one.name}" not in form:
            value = FILL_IN
        found["plant", one.name] = value
        deviation = form.get(f"sd.{one.name}", "").strip().replace(",", ".")
        exact = deviation if "%" in deviation else number(deviation, f"uncertainty, {one.words}")
        found["plant", UNCERTAINTY, one.name] = exact or None
    limit = number(form.get("u_max", ""), "largest command", 0.0)
    found["fit", "u_max"] = None if "no_limit" in form else FILL_IN if limit is None else limit
    horizon = number(form.get("horizon", ""), "horizon", 0.0) or HORIZON
    if horizon != int(horizon):
        raise InputError("horizon", f"got {horizon:g}", "give a whole number of samples")
    found["fit", "horizon"] = int(horizon)
    return _changed(found, subject)


def _changed(found: Changes, subject: Subject, sure: set[tuple[str, ...]] | None = None) -> Changes:
    """What is not in subject.toml yet; with the keys whose comments are answered."""

    def before(place: tuple[str, ...]) -> Any:
        content: Any = subject.content
        for key in place:
            content = content.get(key) if isinstance(content, dict) else None
        return content

    return {key: new for key, new in found.items() if key in (sure or ()) or new != before(key)}


def number(text: str, what: str, least: float = -1e300) -> float | None:
    """A number that was typed, with a decimal point or comma; None for an empty field."""
    given = text.strip().replace(",", ".")
    try:
        found = float(given) if given else None
    except ValueError:
        found = float("nan")
    if found is not None and not least < found < 1e300:
        kind = "positive number" if least == 0 else "number"
        raise InputError(what, f"got {text.strip()[:40]!r}", f"give a {kind} such as 12.5")
    return found
