"""What a unit does not tell is no data of a comparison: against scipy on what is left."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
import scipy.stats

from impc.studies.cohort.comparison import compare_cohort
from impc.studies.cohort.told import not_told, not_told_sentences


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


def test_a_gain_about_zero_is_told_where_all_are_told_as_well() -> None:
    """A deviation above the size of every entry is no reason: twenty draws about zero, seed 3."""
    units = gains({})
    units["K.u.x"] = 20 * np.random.default_rng(3).standard_normal(10)
    assert not_told(units) == {}
