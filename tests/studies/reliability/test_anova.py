"""Analysis of variance and trends against statsmodels and scipy."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
import scipy.stats
import statsmodels.api as sm
from statsmodels.formula.api import ols

from impc.arrays import Array
from impc.errors import DataError
from impc.studies.reliability.icc import learning_trend, visit_anova

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


def test_greenhouse_geisser_of_a_published_matrix() -> None:
    """epsilon = k^2 (mean diagonal - mean)^2 / ((k-1)(sum s^2 - 2k sum rows^2 + k^2 mean^2))."""
    table = scores(subjects=9)
    S = np.cov(table, rowvar=False)
    k = 3
    above = k**2 * (np.mean(np.diag(S)) - S.mean()) ** 2
    below = (k - 1) * (np.sum(S**2) - 2 * k * np.sum(S.mean(axis=1) ** 2) + k**2 * S.mean() ** 2)
    found, epsilon = visit_anova(table), above / below
    expected = scipy.stats.f.sf(found.F, 2 * epsilon, 16 * epsilon)
    assert found.p_corrected == pytest.approx(expected)


def test_learning_trend() -> None:
    found = learning_trend(scores(200, 3, 0.4))
    assert found.low < 0.4 < found.high
    assert found.p < 1e-10
    two = scores(10, 2)
    expected = scipy.stats.ttest_rel(two[:, 1], two[:, 0])
    assert learning_trend(two).p == pytest.approx(expected.pvalue)


def test_scores_that_never_change_have_no_test() -> None:
    with pytest.raises(DataError, match="same at all visits"):
        visit_anova(np.ones((4, 3)))
