"""ICC, analysis of variance and trends against tables, pingouin, statsmodels and simulation."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
import scipy.stats
import statsmodels.api as sm
from statsmodels.formula.api import ols

import impc
from impc.arrays import Array
from impc.studies.reliability.icc import (
    Form,
    icc,
    learning_trend,
    mean_squares,
    measurement_error,
    visit_anova,
)

FORMS: tuple[Form, ...] = ("A,1", "A,k")

#: Shrout and Fleiss, Psychological Bulletin 86 (1979) 420, table 2: six targets, four judges.
SHROUT_FLEISS = np.array(
    [[9, 2, 5, 8], [6, 1, 3, 2], [8, 4, 6, 8], [7, 1, 2, 6], [10, 5, 6, 9], [6, 2, 4, 7]], float
)


def study(
    rng: np.random.Generator, subjects: int, visits: int, occasion: float, error: float = 0.6
) -> np.ndarray:
    """Scores of subjects with SD 1 and a common visit effect of SD `occasion`."""
    return np.asarray(
        rng.standard_normal((subjects, 1))
        + occasion * rng.standard_normal((1, visits))
        + error * rng.standard_normal((subjects, visits))
    )


def test_mean_squares_and_estimates_of_shrout_and_fleiss() -> None:
    """Tables 3 and 4 of Shrout and Fleiss."""
    found = mean_squares(SHROUT_FLEISS)
    squares = found.subjects, found.within, found.occasions, found.error
    assert squares == pytest.approx((11.24, 6.26, 32.49, 1.02), abs=5e-3)
    for form, value in zip(FORMS, (0.29, 0.62), strict=True):
        assert icc(SHROUT_FLEISS, form).value == pytest.approx(value, abs=5e-3)


@pytest.mark.parametrize("form", FORMS)
def test_intervals_cover(form: Form) -> None:
    """1000 tables of 15 subjects on 3 occasions with known variances; seed 3."""
    rng, inside = np.random.default_rng(3), 0
    single = 1 / (1 + 0.7**2)
    truth = single if form == "A,1" else 3 * single / (1 + 2 * single)
    for _ in range(1000):
        found = icc(study(rng, 15, 3, 0.0, 0.7), form)
        inside += found.low <= truth <= found.high
    assert 0.93 <= inside / 1000 <= 0.97


def test_negative_estimates_are_reported() -> None:
    scores = np.array([[1.0, 3.0], [3.0, 1.0], [2.0, 2.1]])
    assert icc(scores, "A,1").value < 0
    assert np.isnan(icc(scores, "A,k").value), "its denominator is negative"
    mild = np.array([
        [0.3, 0.8, 0.3], [-1.3, 0.9, 0.4], [-0.5, 0.6, 0.4], [0.3, 0.0, 0.5], [-0.7, -0.2, -0.5],
        [0.6, 0.0, -0.3],
    ])  # fmt: skip
    assert icc(mild, "A,k").value < 0


def test_missing_cells_leave_subjects_out() -> None:
    scores = np.vstack([SHROUT_FLEISS, [5.0, np.nan, 3.0, 4.0]])
    found = icc(scores, "A,1")
    assert found.left_out == 1
    assert found.value == icc(SHROUT_FLEISS, "A,1").value


def test_perfect_agreement_and_no_variance() -> None:
    same = np.repeat(np.arange(5.0)[:, None], 3, axis=1)
    for form in FORMS:
        found = icc(same, form)
        assert (found.value, found.low, found.high) == (1.0, 1.0, 1.0)
    assert icc(same, "A,k", method="generalised").low == 1.0
    assert np.isnan(icc(np.ones((4, 3)), "A,1").value)


@pytest.mark.parametrize("form", FORMS)
def test_subjects_that_are_alike_have_no_interval(form: Form) -> None:
    """No interval [1, 1] around 0 if all subjects have the same scores."""
    rows = np.tile([1.0, 2.0, 3.0], (5, 1))
    turned = np.array([[1.0, 2.0, 3.0], [3.0, 1.0, 2.0], [2.0, 3.0, 1.0]])
    for scores in (rows, turned):
        found = icc(scores, form)
        assert np.isnan([found.low, found.high]).all()
        assert not found.value > 0
    assert icc(rows, form).value == 0
    assert np.isnan(icc(rows, form, method="generalised").high)


@pytest.mark.parametrize("form", FORMS)
def test_limits_lie_about_the_estimate_for_few_subjects(form: Form) -> None:
    """With three subjects limits of (A,1) can be below -1/(k-1); those of (A,k) are -inf."""
    lows = []
    for seed in range(300):
        rng = np.random.default_rng(seed)
        scores = rng.standard_normal((3, 1)) + rng.standard_normal((3, 2))
        found = icc(scores, form)
        lows.append(found.low)
        if not np.isnan(found.value):
            assert found.low <= found.value + 1e-9, f"seed {seed}"
            assert found.value <= found.high + 1e-9, f"seed {seed}"
    if form == "A,k":
        assert np.any(np.isneginf(lows))


def exceeded(subjects: int, visits: int, occasion: float, studies: int, seed: int) -> float:
    """Share of 10 000 or more retests at new visits beyond the MDC of a study."""
    rng, retests = np.random.default_rng(seed), max(1, 10_000 // studies)
    beyond = 0
    for _ in range(studies):
        found = measurement_error(study(rng, subjects, visits, occasion))
        pairs = rng.standard_normal((retests, 2)) * occasion + 0.6 * rng.standard_normal(
            (retests, 2)
        )
        beyond += int(np.count_nonzero(np.abs(pairs[:, 1] - pairs[:, 0]) > found.mdc))
    return beyond / (studies * retests)


@pytest.mark.full
@pytest.mark.parametrize(
    ("subjects", "visits", "occasion"), [(30, 3, 0.0), (30, 3, 0.3), (30, 2, 0.3), (12, 2, 0.0)]
)
def test_retests_exceed_the_mdc_of_a_usual_study_in_one_of_twenty(
    subjects: int, visits: int, occasion: float
) -> None:
    """10 000 studies with one retest each, seed 6; two standard errors are 0.4 %."""
    assert 0.04 <= exceeded(subjects, visits, occasion, 10_000, 6) <= 0.06


def test_the_error_is_that_of_a_single_score() -> None:
    """SD of a subject's scores over all visits, and SD sqrt(1 - ICC(A,1)), large tables."""
    scores = study(np.random.default_rng(7), 400, 40, 0.5)
    found = measurement_error(scores)
    assert found.sem == pytest.approx(np.sqrt(np.mean(np.var(scores, axis=1, ddof=1))), rel=1e-12)
    single = np.std(scores, ddof=1) * np.sqrt(1 - icc(scores, "A,1").value)
    assert found.sem == pytest.approx(single, rel=2e-2)
    alike = measurement_error(np.repeat(scores[:, :1], 3, axis=1))
    assert (alike.sem, alike.mdc) == (0.0, 0.0)


@pytest.mark.full
@pytest.mark.parametrize("form", FORMS)
def test_generalised_intervals_cover_where_visits_differ_much(form: Form) -> None:
    """700 studies of 30 subjects on 2 visits, visits as different as 0.7 of subjects; seed 8.

    McGraw and Wong's cover 87 % of such studies.
    """
    rng, inside, usual = np.random.default_rng(8), 0, 0
    single = 1 / (1 + 0.7**2 + 0.6**2)
    truth = single if form == "A,1" else 2 * single / (1 + single)
    for _ in range(700):
        scores = study(rng, 30, 2, 0.7)
        found, other = icc(scores, form, method="generalised"), icc(scores, form)
        inside += found.low <= truth <= found.high
        usual += other.low <= truth <= other.high
    assert 0.93 <= inside / 700 <= 0.975
    assert usual / 700 < 0.91


def test_generalised_intervals_are_not_random() -> None:
    found = icc(SHROUT_FLEISS, "A,1", method="generalised")
    assert found == icc(SHROUT_FLEISS, "A,1", method="generalised"), "nothing in it is random"


def test_too_little_is_a_sentence() -> None:
    for shape, match in (((5, 1), "1 occasion"), ((1, 3), "1 subject")):
        with pytest.raises(impc.DataError, match=match):
            icc(np.ones(shape))
    with pytest.raises(impc.DataError, match="same at all visits"):
        visit_anova(np.ones((4, 3)))


#: What pingouin 0.7.0 prints (GPL: not a dependency) for the tables of `pingouin_table`.
PINGOUIN = {
    (30, 3, 1): {"A,1": (0.665827, 0.42, 0.82), "A,k": (0.856680, 0.69, 0.93)},
    (12, 4, 2): {"A,1": (0.604051, 0.34, 0.84), "A,k": (0.859201, 0.67, 0.95)},
}


def pingouin_table(n: int, k: int, seed: int) -> np.ndarray:
    """Subjects with SD 1, error SD 0.6, and a shift of 0.3 between occasions."""
    own = np.random.default_rng(seed).standard_normal((n, 1))
    error = 0.6 * np.random.default_rng(seed + 100).standard_normal((n, k))
    return np.round(own + error + 0.3 * np.arange(k), 3)


@pytest.mark.parametrize("size", PINGOUIN, ids=str)
@pytest.mark.parametrize("form", FORMS)
def test_pingouin_prints_the_same(size: tuple[int, int, int], form: Form) -> None:
    """Compare printed digits: six of the estimate, two of the interval."""
    value, low, high = PINGOUIN[size][form]
    found = icc(pingouin_table(*size), form)
    assert found.value == pytest.approx(value, abs=5e-7)
    assert found.low == pytest.approx(low, abs=5.001e-3)
    assert found.high == pytest.approx(high, abs=5.001e-3)


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
