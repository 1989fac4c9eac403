"""The answer that a test's users ask for: is it reliable, in which measure, and what change shows.

A word for an ICC (Cicchetti 1994) is that of its whole 95 % interval: where its ends have different
words the study does not say, however high the estimate (docs/reliability.md).

The dissertation's findings of chapter 2, each looked for in a study; and its own p-values.

The lower body is the first output, the upper body the second, as in the dissertation.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from impc.reporting.shown_units import shown_angle
from impc.studies.reliability.analysis import MEASURES

if TYPE_CHECKING:
    from impc.studies.reliability.analysis import MeasureResult, Reliability

_BANDS = ((0.40, "poor"), (0.60, "fair"), (0.75, "good"), (np.inf, "excellent"))


def band_of(value: float) -> str:
    """Cicchetti's (1994) word for a reliability of that `value`."""
    if np.isnan(value):
        return "not defined"
    return next(word for limit, word in _BANDS if value < limit)


def interval_band(low: float, high: float) -> str:
    """The word for an interval from `low` to `high`; of both ends where they differ."""
    ends = band_of(low), band_of(high)
    return ends[0] if ends[0] == ends[1] else f"not identified: {ends[0]} to {ends[1]}"


def shown_score(item: MeasureResult) -> tuple[float, str]:
    """Factor and unit in which a score is shown."""
    factor, unit = shown_angle()
    return (factor, unit) if item.measure == "rms" else (factor**2, f"{unit}²")


def answer(result: Reliability) -> tuple[str, ...]:
    """Sentences, the first of which says whether the test is reliable."""
    if len(result.visits) < 2:
        return (
            "Whether the test is reliable cannot be said of one visit: measure the same people "
            "again, at least once, in the same conditions.",
        )
    known = [(item, item.icc) for item in result.measures if item.icc is not None]
    if not known:
        return (
            "Whether the test is reliable cannot be said: no measure has a full set of scores.",
        )
    named: dict[str, list[str]] = {}
    for item, found in known:
        one = f"{MEASURES[item.measure]} of {item.output}, {item.condition}"
        named.setdefault(interval_band(found.low, found.high).partition(":")[0], []).append(one)
    lines = [
        f"Reliability between visits is {word} for {'; '.join(named[word])}."
        for _, word in reversed(_BANDS)
        if word in named
    ]
    if "not identified" in named:
        lines.append(
            f"For {'; '.join(named['not identified'])} {len(result.subjects)} subjects and "
            f"{len(result.visits)} visits do not decide: the interval reaches from one word to "
            "another. More subjects or visits narrow it."
        )
    # What a single person's score must change by, of the first measure in each condition.
    first = known[0][0].measure
    changes = []
    for item, _ in known:
        if item.measure == first and item.error is not None:
            factor, unit = shown_score(item)
            changes.append(
                f"{factor * item.error.mdc:.2g} {unit} ({item.output}, {item.condition})"
            )
    if changes:
        lines.append(
            f"A change of one person's {MEASURES[first]} between two visits is more than the "
            f"test's own scatter, at 95 %, from: {'; '.join(changes)}."
        )
    return tuple(lines)


#: p-values of tables 2.5 (RMS) and 2.6 (energy) that survive in the text, lower and upper body.
#: They are the dissertation's, of its own thirty subjects, and are never compared with as truth.
QUOTED = {
    "rms": {"EO": (0.05, 0.29), "EC": (0.14, 0.66), "VIB": (0.02, 0.71)},
    "energy": {"EO": (0.06, 0.37), "EC": (0.44, 0.57), "VIB": (0.05, 0.70)},
}


class Finding(NamedTuple):
    """A statement of the dissertation, and what this study says of it."""

    statement: str  # Of the dissertation, chapter 2
    found: bool  # Whether it holds here
    numbers: str  # Those of this study


def findings(result: Reliability) -> tuple[Finding, ...]:
    """Excellent between visits; lower body above upper; within visits above between."""
    values = {
        (item.measure, item.output, item.condition): item.icc.value
        for item in result.measures
        if item.icc is not None
    }
    verdicts = []
    if values:
        least = min(values.values())
        verdicts.append(
            Finding(
                "Between-visit reliability is excellent (ICC of 0.75 or more) for every measure.",
                least >= 0.75,
                f"least ICC {least:.2f}, {band_of(least)}",
            )
        )
    if len(result.outputs) > 1 and values:
        lower, upper = (
            float(np.mean([value for key, value in values.items() if key[1] == name]))
            for name in result.outputs[:2]
        )
        verdicts.append(
            Finding(
                "The lower body is more reliable than the upper body.",
                lower > upper,
                f"mean ICC {lower:.2f} ({result.outputs[0]}) and {upper:.2f} ({result.outputs[1]})",
            )
        )
    pairs = np.array(
        [
            (np.nanmean(item.within), np.nanmean(item.between))
            for item in result.cmc
            if np.any(np.isfinite(item.within)) and np.any(np.isfinite(item.between))
        ]
    )
    if len(pairs):
        within, between = pairs.T
        verdicts.append(
            Finding(
                "Transfer functions agree better within a visit than between visits (CMC).",
                bool(np.all(within > between)),
                f"mean CMC {within.mean():.3f} within, {between.mean():.3f} between",
            )
        )
    return tuple(verdicts)
