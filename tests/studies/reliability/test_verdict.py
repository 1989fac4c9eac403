"""Verdict of a reliability study."""

from __future__ import annotations

import numpy as np
import pytest

from impc.arrays import Array
from impc.levels import Level
from impc.reporting.verdict import Verdict
from impc.studies.reliability.analysis import Reliability, measured
from impc.studies.reliability.icc import icc
from impc.studies.reliability.measures import Passband
from impc.studies.reliability.report import reliability_findings
from impc.studies.reliability.verdict import RULES, Facts, change_text, interval_band
from tests.support import present

WORDS = {"theta1": "seat tilt", "theta2": "trunk tilt"}


def study(*scores: Array) -> Reliability:
    """RMS in degrees; scores (subjects, visits) of each output."""
    measures = tuple(
        measured("rms", output, WORDS[output], "EO", "°", one)
        for output, one in zip(WORDS, scores, strict=False)
    )
    subjects, visits = (tuple(str(k + 1) for k in range(count)) for count in scores[0].shape)
    band = Passband(0.1, 0.5, np.array([1, 5]))
    return Reliability(subjects, visits, ("EO",), band, measures, (), {}, ())


def verdict(*scores: Array) -> Verdict:
    return RULES.verdict(Facts(study(*scores)))


def scores(subjects: int, visits: int, spread: float, differ: float = 0.02) -> Array:
    rng = np.random.default_rng(3)
    person = 0.05 + differ * rng.standard_normal((subjects, 1))
    return np.asarray(person + spread * rng.standard_normal((subjects, visits)))


@pytest.mark.parametrize(
    ("low", "high", "word"),
    [(0.8, 0.9, "excellent"), (0.61, 0.7, "good"), (-3.22, 0.95, "poor to excellent"),
     (0.7, 0.8, "good to excellent"), (-1, 0.3, "poor"), (np.nan, np.nan, "not defined")],
)  # fmt: skip
def test_a_word_is_that_of_the_interval(low: float, high: float, word: str) -> None:
    assert interval_band(low, high) == word


def test_a_reliable_test_is_called_so_with_the_change_that_shows() -> None:
    made = scores(30, 3, 0.002)
    found = verdict(made)
    assert (found.level, found.headline) == (Level.GREEN, "Seat sway is reliable.")
    assert not found.alerts
    change = 1.96 * np.sqrt(2) * np.sqrt(np.mean(np.var(made, axis=1, ddof=1)))
    value, unit = change_text(study(made).measures[0]).split()
    assert float(value) == pytest.approx(change, rel=0.1)
    assert unit == "°"


def test_the_badge_goes_by_the_lower_end() -> None:
    """Reliable in one signal; no differences between people in the other."""
    found = verdict(scores(30, 3, 0.002), scores(30, 3, 0.02, 0.0))
    assert found.level is Level.AMBER
    assert found.headline.startswith("Seat sway is reliable; trunk sway is not")
    assert [claim.text for claim in found.may] == ["That seat sway is reliable in EO."]
    assert found.may_not[0].text == "That trunk sway is reliable in EO."


def test_few_subjects_decide_nothing_however_high_the_estimate() -> None:
    """No differences in many people are red; too few people, or one visit, are undecided."""
    none = verdict(0.05 + 0.02 * np.random.default_rng(0).standard_normal((200, 2)))
    assert (none.level, none.headline) == (Level.RED, "Seat sway is not reliable.")
    made = scores(4, 2, 0.01)
    assert icc(made, "A,k", method="generalised").value > 0.6
    found, single = verdict(made), verdict(made[:, :1])
    assert (found.level, found.badge) == (Level.AMBER, "Undecided")
    assert found.headline.startswith("4 people and 2 visits do not show")
    assert (single.badge, single.may) == ("Undecided", [])
    assert "at least two people" in single.alerts[0].found


def test_both_intervals_stand_in_columns_of_their_own() -> None:
    made = scores(10, 3, 0.01)
    found = reliability_findings(study(made))["icc-rms"]
    row = present(found.table).iloc[0]
    for ends, method in ((("low", "high"), "generalised"), (("low_f", "high_f"), "F")):
        expected = icc(made, "A,k", method=method)  # type: ignore[arg-type]
        assert tuple(row[list(ends)]) == pytest.approx((expected.low, expected.high))
    people = made.mean(axis=1)
    assert tuple(row[["mean", "sd", "people"]]) == pytest.approx(
        (people.mean(), people.std(ddof=1), 10)
    )
    assert {"Low (generalised)", "Mean", "SD", "n (people)"} <= set(found.heads)
    assert "output" not in found.shown  # name in code
