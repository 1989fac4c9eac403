"""Comparisons against SciPy; weighted means: uncertain gains, outliers, coverage."""

from __future__ import annotations

import itertools

import numpy as np
import pandas as pd
import pytest
import scipy.stats

import impc
from experiments.coverage import cart
from impc.inverse.noisy_fit import fit_controller
from impc.studies.cohort.comparison import (
    Comparison,
    compare_cohort,
    in_order,
    outlying,
    t_test,
    weighted_mean,
)
from tests.studies.cohort.carts import subject_trial

SEED = 15
SETTINGS = impc.FitSettings(horizon=10, u_max=1.0)


def compared(units: pd.DataFrame, reference: str = "") -> tuple[Comparison, ...]:
    """Comparisons of all gains and VAF."""
    measures = [name for name in units.columns if name.startswith(("K.", "vaf."))]
    return compare_cohort(units, measures, reference)


def table(subjects: int, visits: int, shift: float = 0.0, seed: int = SEED) -> pd.DataFrame:
    """Scores with subject and visit effects and a shifted second group."""
    rng = np.random.default_rng(seed)
    rows = []
    for number in range(subjects):
        group = "a" if number < subjects // 2 else "b"
        own = rng.standard_normal()
        for visit in range(visits):
            score = own + shift * (group == "b") + 0.5 * rng.standard_normal()
            rows.append((str(number), str(visit + 1), "", group, score, rng.standard_normal()))
    return pd.DataFrame(rows, columns=["subject", "visit", "condition", "group", "K.u.x", "vaf.y"])


def found_of(units: pd.DataFrame, question: str, reference: str = "") -> dict[str, Comparison]:
    """Comparisons of one question by measure."""
    found = compared(units, reference)
    return {item.measure: item for item in found if item.question == question}


def test_groups_are_welch_on_subject_means() -> None:
    """A value without a number changes no weights."""
    units = table(20, 2, 1.0)
    units.loc[0, "vaf.y"] = np.nan
    for measure, found in found_of(units, "group").items():
        means = units.groupby(["group", "subject"])[measure].mean()
        a, b = means["a"].to_numpy(), means["b"].to_numpy()
        assert found.p == pytest.approx(scipy.stats.ttest_ind(b, a, equal_var=False).pvalue)
        assert found.estimate == pytest.approx(b.mean() - a.mean())
        assert found.low < found.estimate < found.high
        pooled = np.sqrt((a.var(ddof=1) + b.var(ddof=1)) / 2)
        hedges = (b.mean() - a.mean()) / pooled * (1 - 3 / (4 * 18 - 1))
        assert found.effect == pytest.approx(hedges)


def test_visits_and_conditions_are_paired_and_the_reference_comes_first() -> None:
    units = table(12, 2)
    named = units.assign(condition=units["visit"].map({"1": "EC", "2": "EO"}), visit="1")
    for given, question, first, second in (
        (units, "visit", "1", "2"), (named, "condition", "EO", "EC"),
    ):  # fmt: skip
        found = found_of(given, question)
        wide = given.pivot_table(index="subject", columns=question, values="K.u.x")
        expected = scipy.stats.ttest_rel(wide[second], wide[first])
        gain = found["K.u.x"]
        assert (gain.first, gain.second, gain.n) == (first, second, 12)
        assert gain.p == pytest.approx(expected.pvalue)
        least = min(item.p for item in found.values())
        assert min(item.p_holm for item in found.values()) == pytest.approx(min(2 * least, 1))
        other = found_of(given, question, second)["K.u.x"]
        assert (other.first, other.estimate) == (second, -gain.estimate)


def test_a_different_change_is_found_and_reliability_too() -> None:
    units = table(40, 2)
    changed = (units["group"] == "b") & (units["visit"] == "2")
    units.loc[changed, "K.u.x"] += 2.0
    found = {(item.question, item.measure): item for item in compared(units)}
    assert found["change", "K.u.x"].p < 1e-6
    assert found["change", "vaf.y"].p > 1e-3
    assert found["reliability", "vaf.y"].low < 0 < found["reliability", "vaf.y"].high


def cohort_p(seed: int, difference: float, subjects: int = 10) -> float:
    """p of the gain's first entry between two groups of carts, fitted."""
    rng = np.random.default_rng([SEED, seed])
    rows = []
    for number in range(subjects):
        group = "a" if number < subjects // 2 else "b"
        cost_weight = (
            4.0 * (difference if group == "b" else 1.0) * np.exp(0.2 * rng.standard_normal())
        )
        trial = subject_trial(int(rng.integers(2**31)), float(cost_weight))
        fitted = fit_controller(impc.fit_problem(cart(), [trial], SETTINGS))
        rows.append((str(number), "1", "", group, fitted.gain[0, 0]))
    units = pd.DataFrame(rows, columns=["subject", "visit", "condition", "group", "K.force.x"])
    (found,) = compared(units)
    return found.p


@pytest.mark.full
def test_a_planted_difference_is_found() -> None:
    assert cohort_p(0, 3.0) < 0.01


def test_without_a_difference_p_values_are_uniform() -> None:
    """Two measures in 40 tables of two groups of five; seeds 0 to 39."""
    ps = [item.p for seed in range(40) for item in compared(table(10, 1, seed=seed))]
    assert scipy.stats.kstest(ps, "uniform").pvalue > 0.01


@pytest.mark.slow
def test_without_a_difference_p_values_of_fits_are_uniform() -> None:
    """200 cohorts of two groups of five, each subject fitted; seeds 0 to 199."""
    ps = [cohort_p(seed, 1.0) for seed in range(200)]
    assert scipy.stats.kstest(ps, "uniform").pvalue > 0.01


def gains(deviations: dict[int, float]) -> pd.DataFrame:
    """Ten units with a gain of 700 to 880 and a standard error of 20 by default."""
    rows = [
        (
            str(number), "1", "", "ab"[number % 2], 700.0 + 20 * number,
            deviations.get(number, 20.0),
        )
        for number in range(10)
    ]  # fmt: skip
    heads = ["subject", "visit", "condition", "group", "K.u.x", "K_deviation.u.x"]
    return pd.DataFrame(rows, columns=heads)


def test_two_wild_gains_do_not_carry_a_mean() -> None:
    """Gains known to -1500 to 4000 count little, and all ten people are counted."""
    units = gains({3: 1400.0, 5: 1400.0})
    units.loc[[3, 5], "K.u.x"] = 3000.0
    (found,) = compared(units)
    rest = units.drop(index=[3, 5])
    a, b = (rest.loc[rest["group"] == group, "K.u.x"] for group in "ab")
    assert found.n == 10
    assert found.estimate == pytest.approx(b.mean() - a.mean(), abs=10)
    assert found.high - found.low < 350
    (unweighted,) = compared(units.drop(columns="K_deviation.u.x"))
    assert unweighted.estimate > 850
    assert unweighted.high - unweighted.low > 2500


@pytest.mark.parametrize("error", [np.nan, np.inf])
def test_a_gain_without_an_error_is_counted_and_has_no_weight(error: float) -> None:
    (found,) = compared(gains({0: error, 5: error}))
    (rest,) = compared(gains({}).drop(index=[0, 5]))
    assert (found.n, rest.n) == (10, 8)
    assert (found.estimate, found.p) == (rest.estimate, rest.p)


def test_nothing_known_is_nothing_compared() -> None:
    units = gains(dict.fromkeys(range(10), np.nan))
    (found,) = compared(units)
    assert np.isnan(found.p)
    assert found.note == "too few subjects (0)"
    both = compared(pd.concat([units, units.assign(visit="2")]))
    assert {item.note for item in both} == {"too few subjects (0)"}
    (found,) = compared(gains(dict.fromkeys((0, 2, 4, 6), 1e5)))
    assert found.note == "one subject counts for more than all others together"


@pytest.mark.parametrize(
    ("names", "reference", "first"),
    [
        (["EC", "EO"], "", "EO"),
        (["eyes closed", "Eyes Open"], "", "Eyes Open"),
        (["post", "pre-test"], "", "pre-test"),
        (["A", "Control"], "", "Control"),
        (["LBP", "Controls"], "", "LBP"),
        (["opened", "presbyopia"], "", "opened"),
        (["A", "control", "Z"], "Z", "Z"),
        (["", "week_4", "Baseline_1"], "", "Baseline_1"),
    ],
)
def test_the_reference(names: list[str], reference: str, first: str) -> None:
    assert in_order(names, reference)[0] == first


def test_far_gains_are_found_and_uncertain_small_ones_are_not() -> None:
    units = gains({1: 400.0, 3: 20.0})
    units.loc[[0, 1, 3], "K.u.x"] = 3000.0, 100.0, 100.0
    half = 1.96 * units["K_deviation.u.x"]
    units["K_low.u.x"], units["K_high.u.x"] = units["K.u.x"] - half, units["K.u.x"] + half
    far = outlying(units, ["K.u.x"])
    assert far.dropna().index.tolist() == [0, 3]
    assert far[0] == pytest.approx(3000 / 820)
    assert far[3] == pytest.approx(100 / 800)
    units["K.u.x"] = 20 * np.random.default_rng(3).standard_normal(10)
    assert outlying(units, ["K.u.x"]).notna().sum() == 0  # about zero no ratio has a meaning


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


@pytest.mark.parametrize(
    ("n", "between", "near", "cohorts"),
    [
        (8, 1.0, 1.0, 1000),  # the share covered has a standard error of 0.7 %
        *(
            pytest.param(*case, 2000, marks=pytest.mark.full)
            for case in itertools.product([5, 20], [0.5, 2.0], [1.0, 0.2])
        ),
    ],
)
def test_intervals_cover_and_are_narrow(n: int, between: float, near: float, cohorts: int) -> None:
    """93.7 to 97.2 %; with right variances at most 0.7 times the unweighted width."""
    rng = np.random.default_rng([1, n] if cohorts == 2000 else 0)
    drawn = [cohort(rng, n, between, near) for _ in range(cohorts)]
    covered, width = differences(drawn, weighted=True)
    assert 0.93 <= covered < 0.975
    if near == 1.0:
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
