"""What a unit does not tell is no data of a comparison: against scipy on what is left."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import scipy.stats

from impc.reporting.writer import owned
from impc.studies.cohort.comparison import compare_cohort
from impc.studies.cohort.engine import Failures, Store
from impc.studies.cohort.report import write_report
from impc.studies.cohort.told import not_told, not_told_sentences, only_told
from tests.studies.cohort.made_up import fit_of, made_up_study, tasks_of


def gains(deviations: dict[int, float]) -> pd.DataFrame:
    """Ten units with a gain of 700 to 880, and a deviation of 20 unless another is given."""
    rows = [
        (
            str(number), "1", "", "ab"[number % 2], 700.0 + 20 * number,
            deviations.get(number, 20.0),
        )
        for number in range(10)
    ]  # fmt: skip
    heads = ["subject", "visit", "condition", "group", "K.u.x", "K_deviation.u.x"]
    return pd.DataFrame(rows, columns=heads)


def test_a_gain_of_629_with_a_deviation_of_1700_is_not_tested() -> None:
    units = gains({3: 1700.0})
    units.loc[3, "K.u.x"] = 629.0
    (found,) = compare_cohort(units)
    rest = units.drop(index=3)
    a, b = (rest.loc[rest["group"] == group, "K.u.x"] for group in "ab")
    assert found.p == pytest.approx(scipy.stats.ttest_ind(b, a, equal_var=False).pvalue)
    assert found.n == 9
    assert not_told(units) == {"K.u.x": 1}


def test_a_gain_without_a_deviation_is_not_tested() -> None:
    units = gains({0: np.nan, 5: np.inf})
    (found,) = compare_cohort(units)
    assert found.n == 8
    assert not_told(units) == {"K.u.x": 2}
    (said,) = not_told_sentences(not_told(units), len(units))
    assert said.endswith("of 10 units the gain of x to u of 2.")


def test_nothing_told_is_nothing_compared() -> None:
    units = gains(dict.fromkeys(range(10), np.nan))
    (found,) = compare_cohort(units)
    assert np.isnan(found.p)
    assert found.note == "too few subjects (0)"
    both = compare_cohort(pd.concat([units, units.assign(visit="2")]))
    assert {item.note for item in both} == {"too few subjects (0)"}


def test_all_told_is_all_compared() -> None:
    units = gains({})
    pd.testing.assert_frame_equal(only_told(units), units)
    assert not_told(units) == {}
    assert not_told_sentences({}, len(units)) == []


def test_a_gain_about_zero_is_told_where_all_are_told_as_well() -> None:
    """A deviation above the size of every entry is no reason: twenty draws about zero, seed 3."""
    units = gains({})
    units["K.u.x"] = 20 * np.random.default_rng(3).standard_normal(10)
    assert not_told(units) == {}


@pytest.mark.full
def test_the_page_says_how_many_are_left_out(tmp_path: Path) -> None:
    study = made_up_study(8)
    digests = {name: task.digest for name, task in tasks_of(study).items()}
    store = Store(tmp_path, digests)
    with owned(tmp_path, "cohort"):
        for number, unit in enumerate(study.units):
            fit = fit_of(number)
            fit["readings"]["analytic centre (no units)"]["Q"] = [[1.0 + number, 0.0], [0.0, 2.0]]
            if number == 2:
                fit["K"], fit["K_deviation"] = [[0.6, 0.1]], [[1700.0, None]]
            store.cache.keep(f"{unit.name}/fit", digests[unit.name], fit)
        write_report(study, store, Failures({}, {}), "impc cohort study.toml")
    page = (tmp_path / "report.html").read_text()
    assert "of 8 units the gain of position to force of 1; the gain of position_rate" in page
    told = json.loads((tmp_path / "result.json").read_text())["not_told"]
    assert told == {"K.force.position": 1, "K.force.position_rate": 8}
