"""Repeated-measures analysis of variance and trend over visits.

One-way analysis, uncorrected and with the epsilon of Greenhouse and Geisser (1959); the trend
(learning) is a t-test of the subjects' slopes, for two visits the paired t-test.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import scipy

from impc.arrays import Array
from impc.errors import DataError
from impc.studies.reliability.icc import complete_rows, mean_squares


class Anova(NamedTuple):
    """F test of a difference between visits."""

    F: float  # Mean square of visits over that of visits by subjects
    p: float  # Uncorrected
    p_corrected: float  # Both degrees of freedom times Greenhouse and Geisser's epsilon


class Trend(NamedTuple):
    """Slope over visits."""

    slope: float  # Mean of the subjects' least-squares slopes, in the score's unit per visit
    low: float  # 95 % interval
    high: float
    p: float  # t-test of a mean slope of zero


def visit_anova(scores: Array) -> Anova:
    """Test for differences between visits; scores (subjects, visits), NaN if missing."""
    kept, _ = complete_rows(scores)
    squares = mean_squares(kept)
    if np.ptp(kept - kept.mean(axis=1, keepdims=True)) == 0:
        raise DataError("scores", "are the same at all visits", "check the recordings")
    F = squares.occasions / squares.error if squares.error else np.inf
    freedom = squares.k - 1
    p, corrected = (
        float(scipy.stats.f.sf(F, share * freedom, share * freedom * (squares.n - 1)))
        for share in (1, _greenhouse_geisser(kept))
    )
    return Anova(F, p, corrected)


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
