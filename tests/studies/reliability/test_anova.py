"""Analysis of variance, trends and variance components against statsmodels and simulation."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
import scipy.stats
import statsmodels.api as sm
from statsmodels.formula.api import ols

from impc.arrays import Array
from impc.errors import DataError
from impc.studies.reliability.anova import (
    learning_trend,
    variance_components,
    visit_anova,
)

SEED = 5


def scores(subjects: int = 12, visits: int = 3, shift: float = 0.4) -> Array:
    rng = np.random.default_rng(SEED)
    table = rng.standard_normal((subjects, 1)) + 0.5 * rng.standard_normal((subjects, visits))
    return np.asarray(table + shift * np.arange(visits))


def test_anova_is_that_of_a_two_way_model() -> None:
    """Against statsmodels' ordinary analysis of variance with subjects as a factor."""
    table = scores()
    long = pd.DataFrame(
        [(i, j, table[i, j]) for i in range(12) for j in range(3)], columns=["s", "v", "y"]
    )
    found = visit_anova(table)
    expected = sm.stats.anova_lm(ols("y ~ C(s) + C(v)", long).fit())
    assert pytest.approx(expected.loc["C(v)", "F"]) == found.F
    assert found.p == pytest.approx(expected.loc["C(v)", "PR(>F)"])
    assert found.freedom == (2, 22)


def test_greenhouse_geisser_of_a_published_matrix() -> None:
    """epsilon = k^2 (mean diagonal - mean)^2 / ((k-1)(sum s^2 - 2k sum rows^2 + k^2 mean^2))."""
    table = scores(subjects=9)
    S = np.cov(table, rowvar=False)
    k = 3
    above = k**2 * (np.mean(np.diag(S)) - S.mean()) ** 2
    below = (k - 1) * (np.sum(S**2) - 2 * k * np.sum(S.mean(axis=1) ** 2) + k**2 * S.mean() ** 2)
    assert visit_anova(table).epsilon == pytest.approx(above / below)


def test_learning_trend() -> None:
    found = learning_trend(scores(200, 3, 0.4))
    assert found.low < 0.4 < found.high
    assert found.p < 1e-10
    two = scores(10, 2)
    expected = scipy.stats.ttest_rel(two[:, 1], two[:, 0])
    assert learning_trend(two).p == pytest.approx(expected.pvalue)


def test_missing_cells_and_too_little() -> None:
    table = scores()
    table[3, 1] = np.nan
    assert visit_anova(table).left_out == 1
    for bad, match in (
        (scores(visits=1), "1 occasion"),
        (scores(1), "complete for 1 subject"),
        (np.ones((4, 3)), "same at all visits"),
    ):
        with pytest.raises(DataError, match=match):
            visit_anova(bad)


def covered(repetitions: int) -> dict[str, float]:
    """Coverage of 95 % intervals of the components: 30 subjects, 3 visits, 3 trials."""
    rng = np.random.default_rng(SEED)
    truth = {"subject": 1.0, "visit": 0.15, "trial": 0.3}
    inside = dict.fromkeys(truth, 0)
    for _ in range(repetitions):
        table = (
            np.sqrt(truth["subject"]) * rng.standard_normal((30, 1, 1))
            + np.sqrt(truth["visit"]) * rng.standard_normal((30, 3, 1))
            + np.sqrt(truth["trial"]) * rng.standard_normal((30, 3, 3))
        )
        for item in variance_components(table):
            inside[item.name] += item.low <= truth[item.name] <= item.high
    return {name: count / repetitions for name, count in inside.items()}


def test_components_are_inside_their_intervals() -> None:
    """500 repetitions, seed 5: 95 +- 2 % for each component."""
    for name, share in covered(500).items():
        assert 0.93 <= share <= 0.97, (name, share)


def test_components_are_those_of_the_mean_squares() -> None:
    """Compare with a nested analysis of variance by statsmodels."""
    rng = np.random.default_rng(SEED)
    table = rng.standard_normal((6, 1, 1)) + rng.standard_normal((6, 3, 1))
    table = table + 0.5 * rng.standard_normal((6, 3, 2))
    long = pd.DataFrame(
        [(i, j, table[i, j, k]) for i in range(6) for j in range(3) for k in range(2)],
        columns=["s", "v", "y"],
    )
    squares = sm.stats.anova_lm(ols("y ~ C(s) + C(s):C(v)", long).fit())["mean_sq"]
    found = {item.name: item.value for item in variance_components(table)}
    assert found["trial"] == pytest.approx(squares["Residual"])
    assert found["visit"] == pytest.approx((squares["C(s):C(v)"] - squares["Residual"]) / 2)
    assert found["subject"] == pytest.approx((squares["C(s)"] - squares["C(s):C(v)"]) / 6)
