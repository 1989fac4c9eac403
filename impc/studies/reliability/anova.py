"""Repeated-measures analysis of variance, paired tests, trend, and variance components.

One-way analysis over visits, uncorrected and with the epsilon of Greenhouse and Geisser (1959);
paired t-tests between visits, uncorrected and with the correction of Holm (1979); trend over visits
(learning). Variance components of subjects, visits and trials:

    x_ijk = m + subject_i + visit_ij + trial_ijk          i = 1..n, j = 1..v, k = 1..t

a nested random model of complete tables. With the mean squares MS_s, MS_v, MS_t of the nested
analysis of variance (degrees of freedom n - 1, n (v - 1), n v (t - 1)) the components are

    trial    MS_t
    visit    (MS_v - MS_t) / t
    subject  (MS_s - MS_v) / (t v)

The interval of the trial component is from the chi-squared distribution. The others are differences
of mean squares and have the modified large-sample intervals of Ting, Burdick, Graybill, Jeyaratnam
and Lu (1990), whose coverage is better than that of Satterthwaite's if the difference is small.
Negative estimates are not truncated.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import scipy.stats
from scipy.stats import chi2

from impc.arrays import Array
from impc.errors import DataError
from impc.studies.reliability.icc import complete_rows, mean_squares

# Tail probability of a 95 % interval on each side.
_TAIL = 0.025


class Anova(NamedTuple):
    """F test of a difference between visits."""

    F: float  # Mean square of visits over that of visits by subjects
    freedom: tuple[int, int]  # Degrees of freedom of numerator and denominator, uncorrected
    p: float  # Uncorrected
    epsilon: float  # Greenhouse-Geisser epsilon, between 1 / (k - 1) and 1
    p_corrected: float  # Both degrees of freedom times epsilon
    left_out: int  # Number of subjects without all visits


class Trend(NamedTuple):
    """Slope over visits."""

    slope: float  # Mean of the subjects' least-squares slopes, in the score's unit per visit
    low: float  # 95 % interval
    high: float
    p: float  # t-test of a mean slope of zero


def visit_anova(scores: Array) -> Anova:
    """Test for differences between visits; scores (subjects, visits), NaN if missing."""
    kept, left_out = complete_rows(scores)
    squares = mean_squares(kept)
    if np.ptp(kept - kept.mean(axis=1, keepdims=True)) == 0:
        raise DataError("scores", "are the same at all visits", "check the recordings")
    F = squares.occasions / squares.error if squares.error else np.inf
    freedom = (squares.k - 1, (squares.n - 1) * (squares.k - 1))
    epsilon = _greenhouse_geisser(kept)
    p, corrected = (
        float(scipy.stats.f.sf(F, share * freedom[0], share * freedom[1])) for share in (1, epsilon)
    )
    return Anova(F, freedom, p, epsilon, corrected, left_out)


def learning_trend(scores: Array) -> Trend:
    """Trend of the scores over visits; scores (subjects, visits)."""
    kept, _ = complete_rows(scores)
    visit = np.arange(kept.shape[1]) - (kept.shape[1] - 1) / 2
    slopes = kept @ visit / float(visit @ visit)
    test: Any = scipy.stats.ttest_1samp(slopes, 0.0)
    low, high = test.confidence_interval(0.95)
    return Trend(float(slopes.mean()), float(low), float(high), float(test.pvalue))


def _greenhouse_geisser(scores: Array) -> float:
    """tr(S)^2 / ((k - 1) tr(S^2)), where S is the doubly centred covariance of visits."""
    k = scores.shape[1]
    centring = np.eye(k) - 1 / k
    S = centring @ np.cov(scores, rowvar=False) @ centring
    below = (k - 1) * float(np.sum(S**2))
    return float(np.clip(np.trace(S) ** 2 / below, 1 / (k - 1), 1.0)) if below > 0 else 1.0


class VarianceComponent(NamedTuple):
    """One variance component."""

    name: str  # "subject", "visit" or "trial"
    value: float  # In the score's unit squared
    low: float  # 95 % interval
    high: float


def variance_components(scores: Array) -> tuple[VarianceComponent, ...]:
    """Components of subjects, visits and trials; `scores` (subjects, visits, trials)."""
    table = np.asarray(scores, dtype=np.float64)
    if table.ndim != 3 or min(table.shape) < 2:
        raise DataError(
            "scores", f"got {' x '.join(map(str, table.shape))}",
            "give at least 2 subjects, visits and trials",
        )  # fmt: skip
    n, v, t = table.shape
    cells, subjects = table.mean(axis=2), table.mean(axis=(1, 2))
    squares = (
        t * v * float(np.sum((subjects - table.mean()) ** 2)) / (n - 1),
        t * float(np.sum((cells - subjects[:, None]) ** 2)) / (n * (v - 1)),
        float(np.sum((table - cells[..., None]) ** 2)) / (n * v * (t - 1)),
    )
    freedom = (n - 1, n * (v - 1), n * v * (t - 1))
    scaled = squares[2] * freedom[2]
    low, high = (scaled / float(chi2.ppf(share, freedom[2])) for share in (1 - _TAIL, _TAIL))
    return (
        VarianceComponent("subject", *_difference(squares[:2], freedom[:2], t * v)),
        VarianceComponent("visit", *_difference(squares[1:], freedom[1:], t)),
        VarianceComponent("trial", squares[2], low, high),
    )


def _difference(
    squares: tuple[float, ...], freedom: tuple[int, ...], over: int
) -> tuple[float, float, float]:
    """(MS_1 - MS_2) / over, and its interval after Ting et al."""
    first, second = squares
    f = np.array(freedom)
    (G1, G2), (H1, H2) = 1 - f / chi2.ppf(1 - _TAIL, f), f / chi2.ppf(_TAIL, f) - 1
    upper, lower = (scipy.stats.f.ppf(share, *freedom) for share in (1 - _TAIL, _TAIL))
    G12 = ((upper - 1) ** 2 - (G1 * upper) ** 2 - H2**2) / upper
    H12 = ((1 - lower) ** 2 - (H1 * lower) ** 2 - G2**2) / lower
    below = (G1 * first) ** 2 + (H2 * second) ** 2 + G12 * first * second
    above = (H1 * first) ** 2 + (G2 * second) ** 2 + H12 * first * second
    value, reach = (first - second) / over, np.sqrt(np.maximum([below, above], 0.0)) / over
    return value, value - float(reach[0]), value + float(reach[1])
