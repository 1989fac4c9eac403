"""A fit beside the truth of a simulated subject: truth.json, which lies beside its recordings."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import numpy as np

from impc.assess.intervals import entry_names
from impc.files.disk import LARGEST
from impc.reporting.finding import Finding, table_of
from impc.reporting.rendering import number
from impc.studies.fit.gain_findings import number_name

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from impc.arrays import Array
    from impc.assess.intervals import Interval
    from impc.model.plant import Plant
    from impc.studies.fit.result import FitResult


def read_truth(recordings: Iterable[Path], plant: Plant) -> Array | None:
    """The gain of the truth.json that lies beside recordings.

    Returns (m, n).
    """
    folders = {path.absolute().parent for path in recordings}
    path = folders.pop() / "truth.json" if len(folders) == 1 else None
    if path is None or not path.is_file() or path.stat().st_size > LARGEST:
        return None
    try:
        told = json.loads(path.read_text(encoding="utf-8"))
        states, gain = tuple(told["states"]), np.array(told["K"], dtype=np.float64)
    except (OSError, ValueError, KeyError, TypeError):  # a file of somebody else's
        return None
    return gain if states == plant.states and gain.shape == (plant.m, plant.n) else None


def truth_sentence(result: FitResult, truth: Array) -> str:
    """How many entries of a `truth` (m, n) lie inside their intervals, and which is farthest off.

    Of the gain of a `result`, and of that of its person who senses with noise.
    """
    pairs = _pairs(result, truth)
    level = pairs[0][0].level
    off = [pair for pair in pairs if not _inside(*pair)]
    text = (
        f"The recordings are simulated: {len(pairs) - len(off)} of the {len(pairs)} entries of "
        f"their true gain lie inside their {100 * level:.0f} % intervals"
    )
    person = _of_person(result, truth)
    if not off:
        return f"{text}.{person}"
    item, value = max(off, key=lambda pair: _distance(*pair))
    name = number_name(result.given.plant, item.name)
    return (
        f"{text}; farthest off is the {name}, {number(item.low, 4)} to {number(item.high, 4)} "
        f"where the truth is {number(value, 4)}.{person}"
    )


def _of_person(result: FitResult, truth: Array) -> str:
    """The same of the person who senses with noise, where one was found."""
    if result.person is None or result.person.fit is None:
        return ""
    ends = np.array(result.person.entries)  # NaN of what is not told by itself
    told = ~np.isnan(ends[:, 0])
    inside = np.count_nonzero((ends[:, 0] <= truth.ravel()) & (truth.ravel() <= ends[:, 1]))
    return (
        f" Of the gain of the person who senses with noise {inside} of {np.count_nonzero(told)} "
        "lie inside theirs."
    )


def truth_finding(result: FitResult, truth: Array) -> Finding:
    """Every entry of the gain of a `result` with its interval beside the `truth` (m, n)."""
    table = table_of(
        _pairs(result, truth),
        {
            "number": lambda pair: number_name(result.given.plant, pair[0].name),
            "estimate": lambda pair: np.nan if pair[0].value is None else float(pair[0].value),
            "low": lambda pair: float(pair[0].low),
            "high": lambda pair: float(pair[0].high),
            "truth": lambda pair: float(pair[1]),
            "inside": lambda pair: _inside(*pair),
        },
    )
    caption = "The truth that lies beside the recordings (truth.json), and what the fit says of it."
    said = [truth_sentence(result, truth)]
    return Finding("truth", table, caption, said, folded="The true gain, entry by entry")


def _pairs(result: FitResult, truth: Array) -> list[tuple[Interval, float]]:
    """The interval of each entry, that for the residuals' colour, with its true value."""
    first: dict[str, Interval] = {}
    for item in result.certainty.intervals:
        first.setdefault(item.name, item)
    values = zip(entry_names(result.given.plant), truth.ravel(), strict=True)
    return [(first[name], float(value)) for name, value in values]


def _inside(item: Interval, value: float) -> bool:
    return item.low <= value <= item.high


def _distance(item: Interval, value: float) -> float:
    """From the middle of the interval, in its halves."""
    half = (item.high - item.low) / 2
    return abs(value - (item.low + item.high) / 2) / half if half else np.inf
