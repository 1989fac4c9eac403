"""Coverage and width of the interval of a difference between two weighted means."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
import scipy.stats

from impc.studies.cohort.comparison import Comparison, t_test, weighted_mean

ASKED = Comparison("group", "K.u.x", "", "a", "b")


def cohort(rng: np.random.Generator, n: int, between: float, near: float) -> list[pd.DataFrame]:
    """Values and variances of two groups of `n` without a difference.

    A third of the fits are 3 to 10 times less certain; their errors are `near` times what their
    variances say.
    """
    groups = []
    for _ in "ab":
        uncertain = np.arange(n) < round(n / 3)
        errors = np.where(uncertain, rng.uniform(3, 10, n), 1.0)
        own = errors * np.where(uncertain, near, 1.0) * rng.standard_normal(n)
        values = between * rng.standard_normal(n) + own
        groups.append(pd.DataFrame({"value": values, "variance": errors**2}))
    return groups


def differences(groups: list[list[pd.DataFrame]], weighted: bool) -> tuple[float, float]:
    """Share of intervals with the true difference of zero, and their median width."""
    found = [
        t_test(ASKED, [weighted_mean(one["value"], weighted * one["variance"]) for one in pair])
        for pair in groups
    ]
    covered = np.mean([item.low <= 0 <= item.high for item in found])
    return float(covered), float(np.median([item.high - item.low for item in found]))


@pytest.mark.full
@pytest.mark.parametrize("near", [1.0, 0.2])
@pytest.mark.parametrize("between", [0.5, 2.0])
@pytest.mark.parametrize("n", [5, 20])
def test_intervals_cover_and_are_narrow(n: int, between: float, near: float) -> None:
    """2000 cohorts: 93.7 to 97.2 %; with right variances at most 0.7 times the unweighted width."""
    rng = np.random.default_rng([1, n])
    drawn = [cohort(rng, n, between, near) for _ in range(2000)]
    covered, width = differences(drawn, weighted=True)
    assert 0.93 <= covered < 0.975
    if near == 1.0:
        assert width < 0.7 * differences(drawn[:200], weighted=False)[1]


def test_intervals_cover_in_a_small_simulation() -> None:
    """1000 cohorts of twice eight: the share covered has a standard error of 0.7 %."""
    rng = np.random.default_rng(0)
    drawn = [cohort(rng, 8, 1.0, 1.0) for _ in range(1000)]
    covered, width = differences(drawn, weighted=True)
    assert 0.93 <= covered < 0.975
    assert width < 0.7 * differences(drawn[:200], weighted=False)[1]


def test_undetermined_gains_that_agree_are_not_known_well() -> None:
    """Six values near the start of the search, each known to +- 2000: their mean is to +- 800."""
    values = pd.Series([470.0, 480.0, 460.0, 475.0, 465.0, 470.0])
    low, _, high = weighted_mean(values, pd.Series(np.full(6, 1000.0**2))).ends
    assert (high - low) / 2 == pytest.approx(1.96 * 1000 / np.sqrt(6), rel=1e-3)


def test_equal_errors_are_students_t() -> None:
    values = np.random.default_rng(2).standard_normal(7)
    for variances in (np.zeros(7), np.full(7, 0.01), np.full(7, 1e-30)):
        found = weighted_mean(pd.Series(values), pd.Series(variances))
        assert found.value == pytest.approx(values.mean())
        assert found.error == pytest.approx(scipy.stats.sem(values))
        assert found.freedom == pytest.approx(6.0)
        assert found.people == pytest.approx(7.0)


def test_shares_are_inverse_variances_plus_the_variance_between_people() -> None:
    """DerSimonian and Laird by hand; a negative variance between people is zero."""
    values, variances = np.array([0.0, 4.0, 2.0]), np.array([1.0, 4.0, 4.0])
    w = 1 / variances
    q = w @ (values - w @ values / w.sum()) ** 2
    between = (q - 2) / (w.sum() - w @ w / w.sum())
    found = weighted_mean(pd.Series(values), pd.Series(variances))
    assert found.between == pytest.approx(between)
    assert found.value == pytest.approx(np.average(values, weights=1 / (variances + between)))
    found = weighted_mean(pd.Series(values) / 4, pd.Series(variances))
    assert found.between == 0.0
    assert found.value == pytest.approx(np.average(values / 4, weights=w))
