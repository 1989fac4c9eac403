"""Rules of the verdicts of all studies: every word is known, and amber has its reason in a box."""

from __future__ import annotations

from string import Formatter
from typing import Any

import pytest

from impc.levels import Level
from impc.nonlinear import page
from impc.reporting.rules import Line, Rules
from impc.studies.compare import verdict as compare
from impc.studies.example import report as example
from impc.studies.plan import sentences as plan
from impc.studies.reliability import verdict as reliability
from impc.studies.selection.verdict import KEY_RULES, SELECT_RULES

RULES: dict[str, Rules[Any]] = {
    "select": SELECT_RULES,
    "key-parameters": KEY_RULES,
    "reliability": reliability.RULES,
    "compare": compare.RULES,
    "plan": plan.RULES,
    "example": example.RULES,
    "optimal control": page.RULES,
}


@pytest.mark.parametrize("rules", RULES.values(), ids=RULES)
def test_an_amber_badge_has_its_reason_in_a_box(rules: Rules[Any]) -> None:
    for kind in rules.kinds:
        if kind.level is Level.AMBER:
            assert all((kind.title, kind.found, kind.means, kind.todo)), kind.headline


@pytest.mark.parametrize("rules", RULES.values(), ids=RULES)
def test_every_word_of_a_template_is_known(rules: Rules[Any]) -> None:
    texts = [
        text
        for kind in rules.kinds
        for text in (kind.headline, kind.sentence, kind.title, kind.found, kind.means, *kind.todo)
    ]
    for row in (*rules.may, *rules.may_not):
        texts += [row.text, row.why] if isinstance(row, Line) else []
    used = {name for text in texts for _, name, _, _ in Formatter().parse(text) if name}
    assert used <= set(rules.words), used - set(rules.words)
