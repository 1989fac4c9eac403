"""Rules of a verdict: the first kind that applies leads; a new kind is one row."""

from __future__ import annotations

import pytest

from impc.levels import Level
from impc.reporting.rendering import sentence_case
from impc.reporting.rules import Kind, Line, Rules, always
from impc.reporting.verdict import Claim

RED = Kind[int](
    Level.RED, lambda it: it > 9, "{size} is too much.", title="Too much", todo=("Take {less}.",),
    forbids=frozenset(["sum"]),
)  # fmt: skip
AMBER = Kind[int](
    Level.AMBER, lambda it: it > 5, "{size} is much.", title="Much", todo=("{empty}", "Look."),
    forbids=frozenset(["mean"]),
)  # fmt: skip
GREEN = Kind[int](Level.GREEN, always, "{size} is right.", "Go on.")
RULES = Rules[int](
    {"size": lambda it: f"{it} {{m}}", "less": lambda it: it - 1, "empty": lambda _: ""},
    (RED, AMBER, GREEN),
    may=(Line(lambda it: it < 6, "The size.", "It is {size}."),
         lambda it: [Claim(f"Part {part}.") for part in range(it % 3)]),
)  # fmt: skip


@pytest.mark.parametrize(
    ("size", "level", "headline", "titles", "forbidden", "claims"),
    [
        (10, Level.RED, "10 {m} is too much.", ["Too much"], {"sum", "mean"}, 1),
        (8, Level.AMBER, "8 {m} is much.", ["Much"], {"mean"}, 2),
        (3, Level.GREEN, "3 {m} is right.", [], set(), 1),
    ],
)
def test_the_first_kind_that_applies_leads(
    size: int, level: Level, headline: str, titles: list[str], forbidden: set[str], claims: int
) -> None:
    """Braces in facts are no templates; alerts are of the leading level only."""
    verdict = RULES.verdict(size)
    assert (verdict.level, verdict.headline) == (level, headline)
    assert [alert.title for alert in verdict.alerts] == titles
    assert RULES.forbidden(size) == forbidden
    assert len(verdict.may) == claims


def test_a_step_without_words_is_left_out() -> None:
    (alert,) = RULES.verdict(6).alerts
    assert list(alert.todo) == ["Look."]
    assert list(RULES.verdict(12).alerts[0].todo) == ["Take 11."]


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("seat tilt, 4 N m", "Seat tilt, 4 N m"),
        ("EMG left (mV)", "EMG left (mV)"),
        ("mV", "mV"),
        ("x[0]", "x[0]"),
        ("theta1 (rad)", "theta1 (rad)"),
        ("p, corrected", "p, corrected"),
        ("", ""),
    ],
)
def test_names_and_units_keep_their_case(text: str, shown: str) -> None:
    assert sentence_case(text) == shown
