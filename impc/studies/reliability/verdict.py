"""Verdict of a reliability study.

A measure is called reliable if the lower end of the 95 % interval of its ICC is good or better
after Cicchetti (1994), whatever the estimate (docs/howto/reliability_selection.md).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from impc.reporting.finding import Level
from impc.reporting.rendering import number
from impc.reporting.shown_units import shown_angle
from impc.reporting.verdict import Alert, Claim, Verdict

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from impc.studies.reliability.analysis import MeasureResult, Reliability

#: Upper ends and names of the bands of an ICC (Cicchetti 1994).
BANDS = ((0.40, "poor"), (0.60, "fair"), (0.75, "good"), (np.inf, "excellent"))
_GOOD = 0.60
_COUNTS = {2: "both", 3: "all three", 4: "all four"}


def interval_band(low: float, high: float) -> str:
    """Band of an interval from `low` to `high`, for example "good to excellent"."""
    first, last = (
        next((word for most, word in BANDS if end < most), "not defined") for end in (low, high)
    )
    return first if first == last else f"{first} to {last}"


def shown_score(item: MeasureResult) -> tuple[float, str]:
    """Factor to the shown unit of a score, and that unit."""
    factor, unit = shown_angle()
    return (factor, unit) if item.measure == "rms" else (factor**2, f"{unit}²")


def word_of(output: str, words: Mapping[str, str]) -> str:
    """Name of an output in words."""
    return words.get(output, output.replace("_", " "))


def measure_name(item: MeasureResult, words: Mapping[str, str]) -> str:
    """Name of a measure of a signal; the RMS of a tilt is called sway."""
    signal = word_of(item.output, words)
    if item.measure == "energy":
        return f"band energy of {signal}"
    return f"{signal[:-5]} sway" if signal.endswith(" tilt") else f"RMS of {signal}"


def icc_text(item: MeasureResult) -> str:
    """ICC with its interval."""
    assert item.icc is not None
    value, low, high = (f"{end:.2f}".replace("-", "\u2212") for end in item.icc[:3])
    return f"ICC {value} (95 % CI {low} to {high})"


def change_text(item: MeasureResult) -> str:
    """Smallest detectable change of a person in the shown unit."""
    factor, unit = shown_score(item)
    return "-" if item.error is None else f"{number(factor * item.error.mdc)} {unit}"


def known(result: Reliability) -> list[MeasureResult]:
    """Measures with an ICC, RMS first, sorted by signal."""
    found = [item for item in result.measures if item.icc is not None]
    order = result.outputs.index
    return sorted(found, key=lambda item: (item.measure != "rms", order(item.output)))


def _reaches(item: MeasureResult, *, low: bool = True) -> bool:
    """Whether the lower or the upper end of its interval is good or better."""
    return item.icc is not None and (item.icc.low if low else item.icc.high) >= _GOOD


def reliability_verdict(result: Reliability, words: Mapping[str, str]) -> Verdict:
    """Verdict of a reliability study."""
    sways = [item for item in known(result) if item.measure == "rms"]
    people, visits = len(result.subjects), len(result.visits)
    if not sways:
        headline = "These recordings cannot show whether the test is reliable."
        said = ("An ICC needs at least two people with scores at all of two or more visits: "
                "measure the same people again, in the same conditions.")  # fmt: skip
        return Verdict(Level.AMBER, headline, said, badge="Undecided")
    good, least = sum(map(_reaches, sways)), lowest(sways)
    sentence = (
        "A measure is called reliable if the 95 % CI of its ICC begins at 0.60 or above. Lowest: "
        f"{icc_text(least)}, {measure_name(least, words)}, {least.condition}."
    )
    level, badge, headline = Level.AMBER, "Reliable in part", _headline(sways, words)
    if good == len(sways):
        level, badge = Level.GREEN, "Reliable"
    elif not good and any(_reaches(item, low=False) for item in sways):
        badge = "Undecided"
        headline = f"{people} people and {visits} visits do not show whether sway is reliable."
    elif not good:
        level, badge = Level.RED, "Not reliable"
    bad = [item for item in known(result) if not _reaches(item)]
    alert = Alert(
        Level.AMBER, "Not all measures are shown to be reliable",
        f"In {len(bad)} of {len(known(result))} cases the interval of the ICC begins below 0.60.",
        "In these cases the order of the people may differ at the next visit. A wide interval "
        f"means that {people} people and {visits} visits are too few.",
        ("Measure more people, or the same people at more visits.",
         "Average over more trials or visits before you compare people."),
    )  # fmt: skip
    others = Claim("That the test is reliable for other people, tasks or times between visits.",
                   "An ICC is lower in people who differ less from each other.")  # fmt: skip
    may = _claims([item for item in known(result) if _reaches(item)], words)
    alerts = [] if level is Level.GREEN else [alert]
    return Verdict(level, headline, sentence, alerts, may, [*_claims(bad, words), others], badge)


def lowest(items: Sequence[MeasureResult]) -> MeasureResult:
    """Measure whose interval begins lowest."""
    return min(items, key=lambda item: np.nan_to_num(item.icc.low if item.icc else 1, nan=-np.inf))


def _by_name(
    items: Sequence[MeasureResult], words: Mapping[str, str]
) -> dict[str, list[MeasureResult]]:
    found: dict[str, list[MeasureResult]] = {}
    for item in items:
        found.setdefault(measure_name(item, words), []).append(item)
    return found


def _headline(sways: Sequence[MeasureResult], words: Mapping[str, str]) -> str:
    """Headline: reliable signals and conditions first."""
    parts: dict[str, list[str]] = {}
    for name, own in _by_name(sways, words).items():
        good = [item.condition for item in own if _reaches(item)]
        where = f" in {' and '.join(good)}"
        if len(good) == len(own):
            where = f" in {_COUNTS.get(len(own), 'all')} conditions" if len(own) > 1 else ""
        open_still = any(_reaches(item, low=False) for item in own)
        no = "not shown to be reliable" if open_still else "not reliable"
        parts.setdefault(f"reliable{where}" if good else no, []).append(name)
    said = "; ".join(
        f"{' and '.join(names)} {'is' if len(names) == 1 else 'are'} {what}"
        for what, names in sorted(parts.items(), key=lambda item: item[0][:3] == "not")
    )
    return f"{said[:1].upper()}{said[1:]}."


def _claims(items: Sequence[MeasureResult], words: Mapping[str, str]) -> list[Claim]:
    """One claim per measure, with its conditions."""
    found = []
    for name, own in _by_name(items, words).items():
        text = ", ".join([name, *(item.condition for item in own if item.condition)])
        each = "; ".join(f"{item.condition} {icc_text(item)}".strip() for item in own)
        found.append(Claim(f"{text[:1].upper()}{text[1:]}.", f"{each}."))
    return found
