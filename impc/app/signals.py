"""The columns of a recording on the page: what each is taken for, its questions, its curve."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import tomlkit

from impc.app.subject import number, value_at
from impc.errors import InputError
from impc.files.configuration import FILL_IN
from impc.files.draft import guess_of
from impc.reporting.shown_units import signal_name

if TYPE_CHECKING:
    from collections.abc import Mapping

    from impc.arrays import Array
    from impc.files.table import Table
    from impc.model.plant import Plant

CLOCK = "time"
# Number of stretches of a curve, each drawn from its least to its largest value.
_POINTS = 500


@dataclass(frozen=True)
class Role:
    """What a column can be."""

    words: str
    unit: str  # of the plant
    kind: str  # "clock", "output" or "other": which fields it has
    positive: str = ""  # Direction in words


@dataclass(frozen=True)
class Question:
    """Something to be answered about a column, or only to be checked."""

    text: str
    must: bool


@dataclass(frozen=True)
class Column:
    """A column of the shown file, with the answers so far."""

    index: int
    name: str
    role: str  # Key of `roles`; empty if it is not used
    unit: str
    sign: int
    offset: str
    limit: str
    positive: str
    asked: tuple[Question, ...]
    curve: tuple[list[float], list[float]]
    spoken: str  # The curve for who cannot see it


def roles(plant: Plant) -> dict[str, Role]:
    """All that a column can be, by its name in the file."""
    found = {CLOCK: Role("Time", "s", "clock")}
    words = [(name, "output", "") for name in plant.outputs]
    words += [(name, "other", "Push: ") for name in plant.controls[1:]]
    words += [(name, "other", "Command: ") for name in plant.controls[:1]]
    for name, kind, before in words:
        said = signal_name(plant, name)
        shown = f"{before}{said}" if before else said[:1].upper() + said[1:]
        found[name] = Role(shown, plant.unit(name), kind, plant.direction(name))
    return found


def columns(text: str, table: Table, plant: Plant) -> list[Column]:
    """The columns of a file with their answers in `text` (subject.toml)."""
    document, known = tomlkit.parse(text), roles(plant)
    recording, signals = document.get("recording", {}), document.get("signals", {})
    taken = {entry.get("column"): name for name, entry in signals.items() if name in known}
    clock = recording.get("time")
    found = []
    for index, (name, values) in enumerate(table.columns.items()):
        role = CLOCK if name == clock else taken.get(name, "")
        entry = recording if role == CLOCK else signals.get(role, {})
        unit = str(entry.get("time_unit" if role == CLOCK else "unit", table.units.get(name, "")))
        sign, offset = int(entry.get("sign", 1)), entry.get("offset", "")
        shown = sign * (values - float(offset or 0))
        found.append(
            Column(
                *(index, name, role, "" if unit == FILL_IN else unit, sign),
                *(_typed(offset), _typed(entry.get("limit", ""))),
                known[role].positive if role else "",
                _asked(entry, role, unit, guess_of(table, name, "").origin),
                _curve(table.columns.get(str(clock)), shown),
                _spoken(shown),
            )
        )
    return found


def _typed(value: Any) -> str:
    return f"{float(value):g}" if isinstance(value, int | float) else ""


def _asked(entry: Any, role: str, unit: str, origin: str) -> tuple[Question, ...]:
    """Questions about a used column: guesses of the draft that stand, and a missing unit.

    `origin` is what the draft says about the unit.
    """
    if not role:
        return ()
    asked = []
    key = "time_unit" if role == CLOCK else "column"
    comment = entry.item(key).trivia.comment.lstrip("# ") if key in entry else ""
    if "guess" in comment.lower():
        asked.append(Question(f"This is {comment[0].lower()}{comment[1:]}", must=False))
    if unit == FILL_IN:
        asked.append(
            Question(
                f"Which unit is it in? {origin[0].upper()}{origin[1:].rstrip('.')}.", must=True
            )
        )
    return tuple(asked)


def _curve(clock: Array | None, values: Array) -> tuple[list[float], list[float]]:
    """Least and largest value of each stretch, against the clock."""
    time = np.arange(len(values), dtype=float) if clock is None else clock
    known = np.flatnonzero(np.isfinite(values) & np.isfinite(time))
    parts = np.array_split(known, max(1, min(_POINTS, len(known) // 2)))
    picks = [sorted({int(p[np.argmin(values[p])]), int(p[np.argmax(values[p])])})
             for p in parts if len(p)]  # fmt: skip
    at = [place for pick in picks for place in pick]
    return [float(f"{x:.6g}") for x in time[at]], [float(f"{x:.5g}") for x in values[at]]


def _spoken(values: Array) -> str:
    known = values[np.isfinite(values)]
    if not len(known):
        return "no values"
    missing = f", {len(values) - len(known)} missing" if len(known) < len(values) else ""
    return f"from {known.min():.4g} to {known.max():.4g}, mean {known.mean():.4g}{missing}"


def answers(
    form: Mapping[str, str], table: Table, plant: Plant, content: Mapping[str, Any]
) -> dict[tuple[str, ...], Any]:
    """Changes of subject.toml, which has the `content`, by the fields of the page."""
    names, known = list(table.columns), roles(plant)
    chosen: dict[str, int] = {}
    for index, name in enumerate(names):
        role = form.get(f"role.{index}", "")
        if role in chosen:
            words = f"is chosen for {names[chosen[role]]!r} and {name!r}"
            raise InputError(known[role].words, words, "choose it for one column")
        if role in known:
            chosen[role] = index
    found: dict[tuple[str, ...], Any] = {
        ("recording", "subject"): form.get("subject", "").strip(),
        ("recording", "rate"): number(form.get("rate", ""), "samples per second", 0.0),
        **{("recording", key): number(form.get(key, ""), key) for key in ("start", "stop")},
        **{("recording", key): None for key in (CLOCK, "time_unit")},
    }
    sure: set[tuple[str, ...]] = set()
    for role, one in known.items():
        if role not in chosen:
            if role != CLOCK:
                found["signals", role] = None
            continue
        index = chosen[role]
        unit = form.get(f"unit.{index}", "").strip()
        keys: dict[tuple[str, ...], Any]
        if role == CLOCK:
            keys = {("recording", CLOCK): names[index], ("recording", "time_unit"): unit or "s"}
            found |= keys | {("recording", "rate"): None}
        else:
            entry = _signal(form, index, names[index], one, command=role == plant.controls[0])
            keys = {("signals", role, key): value for key, value in entry.items()}
            found |= keys
        if f"sure.{index}" in form:
            sure |= {key for key, value in keys.items() if value not in (None, FILL_IN)}
    return {key: new for key, new in found.items() if key in sure or new != value_at(content, key)}


def _signal(
    form: Mapping[str, str], index: int, column: str, role: Role, *, command: bool
) -> dict[str, Any]:
    """The table of a signal; None for what is not given."""
    stop = form.get(f"limit.{index}", "") if role.kind == "output" else ""
    return {
        "column": column,
        "unit": form.get(f"unit.{index}", "").strip() or FILL_IN,
        "sign": -1 if form.get(f"sign.{index}") == "-1" else None,
        "offset": number(form.get(f"offset.{index}", ""), f"zero of {column}"),
        "limit": number(stop, f"stop of {column}", 0.0),
        "command": True if command else None,
    }
