"""Repeated-measures analysis of variance over visits, and what follows it.

One-way, uncorrected and with the epsilon of Greenhouse and Geisser (1959); paired t between
visits, uncorrected and with the correction of Holm (1979); the trend over visits, the learning
effect.

Variance of subjects, visits and trials behind scores, with intervals.

    x_ijk = m + subject_i + visit_ij + trial_ijk          i = 1..n, j = 1..v, k = 1..t

a nested random model of complete tables. With the mean squares MS_s, MS_v, MS_t of the nested
analysis of variance (degrees of freedom n - 1, n (v - 1), n v (t - 1)) the components are

    trial    MS_t
    visit    (MS_v - MS_t) / t
    subject  (MS_s - MS_v) / (t v)

An interval of the trial's is chi-squared's. Those of the others, differences of mean squares, are
the modified large-sample intervals of Ting, Burdick, Graybill, Jeyaratnam and Lu (1990), which keep
their level far better than Satterthwaite's when the difference is small. Estimates may be negative,
and are reported as they are.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import scipy.stats
from statsmodels.stats.anova import AnovaRM

from impc.arrays import Array
from impc.assess.several_tests import holm
from impc.errors import DataError

if TYPE_CHECKING:
    from collections.abc import Sequence


@dataclass(frozen=True)
class Anova:
    """F test of a difference between visits."""

    F: float  # Mean square of visits over that of visits by subjects
    freedom: tuple[float, float]  # Of numerator and denominator, uncorrected
    p: float  # Uncorrected
    epsilon: float  # Greenhouse and Geisser's, between 1 / (k - 1) and 1
    p_corrected: float  # With both degrees of freedom times epsilon
    subjects: int  # With all visits, and without
    left_out: int


@dataclass(frozen=True)
class PairedTest:
    """Paired t between two visits."""

    first: str  # The visits
    second: str
    difference: float  # Mean of second minus first, in the score's unit
    p: float  # Without and with Holm's correction over all pairs
    p_holm: float


@dataclass(frozen=True)
class Trend:
    """Slope over visits."""

    slope: float  # Mean of the subjects' least-squares slopes, in the score's unit a visit
    low: float  # Ends of its interval
    high: float
    p: float  # Of Student's t that the mean slope is zero


def visit_anova(scores: Array) -> Anova:
    """Test of visits; scores (subjects, visits), NaN where missing."""
    kept, left_out = _complete(scores)
    n, k = kept.shape
    long = pd.DataFrame(
        {
            "subject": np.repeat(np.arange(n), k),
            "visit": np.tile(np.arange(k), n),
            "score": kept.ravel(),
        }
    )
    if np.ptp(kept - kept.mean(axis=1, keepdims=True)) == 0:
        raise DataError("scores", "are the same at every visit", "there is nothing to test")
    table = AnovaRM(long, "score", "subject", within=["visit"]).fit().anova_table
    F = float(table["F Value"].iloc[0])
    epsilon = _greenhouse_geisser(kept)
    freedom = (float(k - 1), float((n - 1) * (k - 1)))
    corrected = float(scipy.stats.f.sf(F, epsilon * freedom[0], epsilon * freedom[1]))
    return Anova(F, freedom, float(table["Pr > F"].iloc[0]), epsilon, corrected, n, left_out)


def paired_tests(scores: Array, visits: Sequence[str]) -> tuple[PairedTest, ...]:
    """Every pair of visits; subjects who lack one of the two are left out of that pair.

    `scores` (subjects, visits).
    """
    rows = []
    for i, j in itertools.combinations(range(len(visits)), 2):
        both = scores[np.all(np.isfinite(scores[:, [i, j]]), axis=1)]
        if len(both) < 2:
            raise DataError(
                f"visits {visits[i]} and {visits[j]}", f"share {len(both)} subjects", "two at least"
            )
        test: Any = scipy.stats.ttest_rel(both[:, j], both[:, i])
        p = float(test.pvalue)
        rows.append((visits[i], visits[j], float(np.mean(both[:, j] - both[:, i])), p))
    corrected = holm(np.array([row[3] for row in rows]))
    return tuple(PairedTest(*row, float(p)) for row, p in zip(rows, corrected, strict=True))


def learning_trend(scores: Array, level: float = 0.95) -> Trend:
    """Whether scores rise or fall from visit to visit; scores (subjects, visits).

    `level` is that of the interval, between 0 and 1.
    """
    kept, _ = _complete(scores)
    visit = np.arange(kept.shape[1]) - (kept.shape[1] - 1) / 2
    slopes = kept @ visit / float(visit @ visit)
    test: Any = scipy.stats.ttest_1samp(slopes, 0.0)
    interval = test.confidence_interval(level)
    return Trend(
        float(slopes.mean()), float(interval.low), float(interval.high), float(test.pvalue)
    )


def _greenhouse_geisser(scores: Array) -> float:
    """tr(S)^2 / ((k - 1) tr(S^2)), S the covariance of visits, doubly centred."""
    k = scores.shape[1]
    centring = np.eye(k) - 1 / k
    S = centring @ np.cov(scores, rowvar=False) @ centring
    below = (k - 1) * float(np.sum(S**2))
    return float(np.clip(np.trace(S) ** 2 / below, 1 / (k - 1), 1.0)) if below > 0 else 1.0


def _complete(scores: Array) -> tuple[Array, int]:
    table = np.asarray(scores, dtype=np.float64)
    if table.ndim != 2 or table.shape[1] < 2:
        raise DataError("scores", "are of one visit", "a test between visits needs two or more")
    kept = table[np.all(np.isfinite(table), axis=1)]
    if len(kept) < 2:
        raise DataError(
            "scores", f"are complete for {len(kept)} subject", "a test needs two or more"
        )
    return kept, len(table) - len(kept)


@dataclass(frozen=True)
class VarianceComponent:
    """One component."""

    name: str  # "subject", "visit" or "trial"
    value: float  # Estimate and ends of the interval, in the score's unit squared
    low: float
    high: float


def variance_components(scores: Array, level: float = 0.95) -> tuple[VarianceComponent, ...]:
    """Components of subjects, visits and trials; `scores` (subjects, visits, trials)."""
    table = np.asarray(scores, dtype=np.float64)
    if table.ndim != 3 or min(table.shape) < 2:
        raise DataError(
            "scores", f"are {' x '.join(map(str, table.shape))}",
            "give two or more subjects, visits and trials",
        )  # fmt: skip
    if not np.all(np.isfinite(table)):
        raise DataError("scores", "lack cells", "leave out subjects that are not complete")
    n, v, t = table.shape
    cells, subjects = table.mean(axis=2), table.mean(axis=(1, 2))
    squares = (
        t * v * float(np.sum((subjects - table.mean()) ** 2)) / (n - 1),
        t * float(np.sum((cells - subjects[:, None]) ** 2)) / (n * (v - 1)),
        float(np.sum((table - cells[..., None]) ** 2)) / (n * v * (t - 1)),
    )
    freedom = (n - 1, n * (v - 1), n * v * (t - 1))
    tail = (1 - level) / 2
    trial = squares[2]
    low = trial * freedom[2] / scipy.stats.chi2.ppf(1 - tail, freedom[2])
    high = trial * freedom[2] / scipy.stats.chi2.ppf(tail, freedom[2])
    return (
        _difference("subject", squares[:2], freedom[:2], t * v, tail),
        _difference("visit", squares[1:], freedom[1:], t, tail),
        VarianceComponent("trial", trial, float(low), float(high)),
    )


def _difference(
    name: str, squares: tuple[float, ...], freedom: tuple[int, ...], over: int, tail: float
) -> VarianceComponent:
    """(MS_1 - MS_2) / over with Ting's interval."""
    (first, second), (f1, f2) = squares, freedom
    chi2, F = scipy.stats.chi2.ppf, scipy.stats.f.ppf
    G1 = 1 - f1 / chi2(1 - tail, f1)
    H1 = f1 / chi2(tail, f1) - 1
    G2 = 1 - f2 / chi2(1 - tail, f2)
    H2 = f2 / chi2(tail, f2) - 1
    upper, lower = F(1 - tail, f1, f2), F(tail, f1, f2)
    G12 = ((upper - 1) ** 2 - (G1 * upper) ** 2 - H2**2) / upper
    H12 = ((1 - lower) ** 2 - (H1 * lower) ** 2 - G2**2) / lower
    below = (G1 * first) ** 2 + (H2 * second) ** 2 + G12 * first * second
    above = (H1 * first) ** 2 + (G2 * second) ** 2 + H12 * first * second
    value = (first - second) / over
    return VarianceComponent(
        name,
        value,
        value - float(np.sqrt(max(below, 0.0))) / over,
        value + float(np.sqrt(max(above, 0.0))) / over,
    )
