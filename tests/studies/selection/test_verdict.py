"""What the pages of `impc select` and `impc key-parameters` say follows from their numbers."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

import impc
from impc.reporting.document import Checks, Copy, Report
from impc.reporting.rendering import number
from impc.studies.selection.analysis import key_parameters, select_study
from impc.studies.selection.key_report import key_report
from impc.studies.selection.model import Trial
from impc.studies.selection.report import selection_report
from impc.studies.selection.settings import SelectSettings
from tests.studies.selection.dosing import in_turn
from tests.studies.selection.heads import line_model

PEOPLE = [(subject, visit) for subject in ("1", "2", "3") for visit in ("1", "2")]
SETTINGS = SelectSettings(replicates=2, starts=1, size=2, draw="single")


MODEL = line_model(names=("gA", "b", "c"), deviation=[1, 1, 0.1], units=["mV"] * 3)


def recorded(
    values: Mapping[tuple[str, str], tuple[float, float]],
) -> dict[tuple[str, str], list[Trial]]:
    """Trials with the values of gA and b of each person and visit; c has no effect."""
    rng, found = np.random.default_rng(4), {}
    for key, (a, b) in values.items():
        u = rng.standard_normal((200, 3)) * [1, 1, 0]
        noise = 0.3 * rng.standard_normal((200, 1))
        found[key] = [Trial(u, (u @ [a, b, 0.0])[:, None] + noise)]
    return found


def selected(at_end: int) -> Report:
    """Page of three people with two visits; gA is at its end of the range in `at_end` fits."""
    cells = recorded({key: (5.1 if k < at_end else 2.0, 1.0) for k, key in enumerate(PEOPLE)})
    named = {" visit ".join(key): trials for key, trials in cells.items()}
    found = select_study(named, SETTINGS, in_turn(MODEL))
    assert found.free == (0, 1)
    return selection_report(MODEL, found, "impc select", None, {}, (3, 2))


def checks(report: Report) -> dict[str, str]:
    (block,) = [one for section in report.sections for one in section.blocks
                if isinstance(one, Checks)]  # fmt: skip
    return {check.name: check.text for check in block.checks}


def test_people_are_counted_not_visits() -> None:
    report = selected(0)
    assert report.meta[1:3] == ["3 people", "2 visits"]
    assert isinstance(report.copy, Copy)
    assert "recordings of 3 people with 2 visits" in report.copy.methods
    assert report.verdict.headline == (
        "2 of 3 parameters can be estimated, if the fixed one is as assumed."
    )
    assert checks(report)["Search range"].endswith("Estimates at a limit: none.")
    assert "impc key-parameters" in checks(report)["Another question"]


def test_an_interval_that_ends_at_the_search_range_is_no_estimate() -> None:
    report = selected(5)
    verdict = json.loads(report.files()["result.json"])["verdict"]
    assert verdict["level"] == "amber"
    assert verdict["headline"].startswith("1 of 3 parameters can be estimated")
    assert verdict["alerts"][0]["found"] == "5 of 6 intervals of gA end at the search range."
    assert "Values of gA." in verdict["may_not_report"][0]
    assert "gA in 5 of 6 fits" in checks(report)["Search range"]
    assert report.keys[0].value == "1"
    assert isinstance(report.copy, Copy)
    assert "5 of 6 intervals of gA ended at the search range" in report.copy.results


def keyed(spread: float, people: int) -> Report:
    """Key parameters of people who differ by 1 (SD) and change by `spread` between visits."""
    rng, values = np.random.default_rng(1), {}
    for subject in range(people):
        own = rng.standard_normal(2)
        for visit in ("1", "2"):
            values[str(subject), visit] = tuple(own + spread * rng.standard_normal(2))
    found = key_parameters(MODEL, recorded(values), SETTINGS, in_turn(MODEL), least_vaf=20.0)
    return key_report(MODEL, found, "impc key-parameters", None)


@pytest.mark.parametrize(
    ("spread", "people", "badge", "headline"),
    [
        (0.3, 3, "Undecided", "3 people and 2 visits do not show"),
        (3.0, 30, "Check before reporting", "No subset of parameters is shown to be repeatable"),
        (0.02, 30, "Check before reporting", "2 of 3 parameters are key parameters"),
    ],
)
def test_the_interval_of_an_icc_decides_not_the_icc(
    spread: float, people: int, badge: str, headline: str
) -> None:
    report = keyed(spread, people)
    verdict, table = report.verdict, report.findings()[1].table
    assert (verdict.words, verdict.headline[: len(headline)]) == (badge, headline)
    assert verdict.alerts  # an amber badge has its reason in a box
    assert table is not None
    best: Any = table.iloc[0]
    assert best["kept"] == (best["least_icc_low"] >= 0.6)
    assert isinstance(report.copy, Copy)
    assert f"ICC of at least {number(best['least_icc'])}" in report.copy.results
    if people == 3:
        assert best["least_icc"] > 0.75
        assert verdict.may == []
    assert any("impc select" in one for one in report.sections[1].blocks if isinstance(one, str))


def test_one_person_has_no_key_parameters() -> None:
    with pytest.raises(impc.DataError, match="1 subjects with all visits, and 2 visits"):
        keyed(0.1, 1)
