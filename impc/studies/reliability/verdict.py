"""Verdict of a reliability study.

A measure is called reliable if the lower end of the 95 % interval of its ICC is good or better
after Cicchetti (1994), whatever the estimate (docs/howto/reliability_selection.md).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from impc.levels import Level
from impc.reporting.rendering import number, sentence_case
from impc.reporting.rules import Kind, Line, Rules, always
from impc.reporting.verdict import Claim
from impc.studies.reliability.analysis import MeasureResult, Reliability
from impc.studies.reliability.icc import GOOD

#: Upper ends and names of the bands of an ICC (Cicchetti 1994).
BANDS = ((0.40, "poor"), (0.60, "fair"), (0.75, "good"), (np.inf, "excellent"))
_COUNTS = {2: "both", 3: "all three", 4: "all four"}


def interval_band(low: float, high: float) -> str:
    """Band of an interval from `low` to `high`, for example "good to excellent"."""
    first, last = (
        next((word for most, word in BANDS if end < most), "not defined") for end in (low, high)
    )
    return first if first == last else f"{first} to {last}"


def icc_text(item: MeasureResult) -> str:
    """ICC with its interval."""
    value, low, high = (f"{end:.2f}".replace("-", "\u2212") for end in item.icc[:3])
    return f"ICC {value} (95 % CI {low} to {high})"


def change_text(item: MeasureResult) -> str:
    """Smallest detectable change of a person."""
    return f"{number(item.error.mdc)} {item.unit}"


class Facts:
    """Cases with an ICC, by whether their intervals reach the band good."""

    def __init__(self, result: Reliability) -> None:
        cases = result.known
        self.people, self.visits = len(result.subjects), len(result.visits)
        self.sways = [item for item in cases if item.measure == "rms"]
        self.good = [item for item in cases if item.icc.low >= GOOD]
        self.poor = [item for item in cases if not item.icc.low >= GOOD]
        self.cases, self.bad = len(cases), len(self.poor)
        self.reliable = sum(item.icc.low >= GOOD for item in self.sways)
        # Whether an interval reaches the band good, so that more people may show it
        self.hopeful = any(item.icc.high >= GOOD for item in self.sways)
        self.lowest = ""
        if self.sways:
            least = lowest(self.sways)
            self.lowest = f"{icc_text(least)}, {least.name}, {least.condition}"


_EACH = Kind[Facts](
    Level.GREEN, always, "{each}",
    "A measure is called reliable if the 95 % CI of its ICC begins at 0.60 or above. Lowest: "
    "{lowest}.",
    badge="Reliable",
)  # fmt: skip
_PART = replace(
    _EACH, level=Level.AMBER, when=lambda it: 0 < it.reliable < len(it.sways),
    badge="Reliable in part", title="Not all measures are shown to be reliable",
    found="In {bad} of {cases} cases the interval of the ICC begins below 0.60.",
    means="In these cases the order of the people may differ at the next visit. A wide interval "
    "means that {people} people and {visits} visits are too few.",
    todo=("Measure more people, or the same people at more visits.",
          "Average over more trials or visits before you compare people."),
)  # fmt: skip
RULES = Rules[Facts](
    {"each": lambda it: _headline(it.sways)},
    kinds=(
        Kind(
            Level.AMBER, lambda it: not it.sways,
            "These recordings cannot show whether the test is reliable.", badge="Undecided",
            title="No ICC can be computed",
            found="An ICC needs at least two people with scores at all of two or more visits.",
            means="Whether people differ from each other by more than from visit to visit is open.",
            todo=("Measure the same people again, in the same conditions.",),
        ),
        replace(
            _PART, level=Level.RED, badge="Not reliable",
            when=lambda it: it.sways and not it.reliable and not it.hopeful,
        ),
        replace(
            _PART, badge="Undecided", when=lambda it: it.sways and not it.reliable and it.hopeful,
            headline="{people} people and {visits} visits do not show whether sway is reliable.",
        ),
        _PART,
        _EACH,
    ),
    may=(lambda it: _claims(it.good),),
    may_not=(
        lambda it: _claims(it.poor),
        Line(lambda it: it.sways,
             "That the test is reliable for other people, tasks or times between visits.",
             "An ICC is lower in people who differ less from each other."),
    ),
)  # fmt: skip


def lowest(items: Sequence[MeasureResult]) -> MeasureResult:
    """Measure whose interval begins lowest."""
    return min(items, key=lambda item: np.nan_to_num(item.icc.low, nan=-np.inf))


def _by_name(items: Sequence[MeasureResult]) -> dict[str, list[MeasureResult]]:
    names = dict.fromkeys(item.name for item in items)
    return {name: [item for item in items if item.name == name] for name in names}


def _headline(sways: Sequence[MeasureResult]) -> str:
    """Headline: reliable signals and conditions first."""
    parts: dict[str, list[str]] = {}
    for name, own in _by_name(sways).items():
        good = [item.condition for item in own if item.icc.low >= GOOD]
        what = "not reliable"
        if good:
            what = f"reliable in {' and '.join(good)}"
        elif any(item.icc.high >= GOOD for item in own):
            what = "not shown to be reliable"
        if len(good) == len(own):
            every = f" in {_COUNTS.get(len(own), 'all')} conditions"
            what = f"reliable{every if len(own) > 1 else ''}"
        parts.setdefault(what, []).append(name)
    said = "; ".join(
        f"{' and '.join(names)} {'is' if len(names) == 1 else 'are'} {what}"
        for what, names in sorted(parts.items(), key=lambda item: item[0][:3] == "not")
    )
    return f"{sentence_case(said)}."


def _claims(items: Sequence[MeasureResult]) -> list[Claim]:
    """One claim per measure, with its conditions and ICC."""
    found = []
    for name, own in _by_name(items).items():
        named = [item.condition for item in own if item.condition]
        where = " and ".join(", ".join(part) for part in (named[:-1], named[-1:]) if part)
        each = "; ".join(f"{item.condition} {icc_text(item)}".strip() for item in own)
        where = f" in {where}" if where else ""
        found.append(Claim(f"That {name} is reliable{where}.", f"{each}."))
    return found
