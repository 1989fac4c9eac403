"""Agreement between visits (McGraw and Wong 1996), with intervals, and change over visits.

n subjects are measured on k occasions. From the two-way analysis of variance

    MSR = k sum_i (m_i. - m)^2 / (n - 1)                      subjects
    MSC = n sum_j (m_.j - m)^2 / (k - 1)                      occasions
    MSE = sum_ij (x_ij - m_i. - m_.j + m)^2 / ((n - 1)(k - 1))
    MSW = sum_ij (x_ij - m_i.)^2 / (n (k - 1))                within subjects, one-way

    (A,1)   (MSR - MSE) / (MSR + (k - 1) MSE + k (MSC - MSE) / n)      single score
    (A,k)   (MSR - MSE) / (MSR + (MSC - MSE) / n)                      mean of k scores

The formulas are the same for random and fixed occasions. Negative estimates are not truncated.

McGraw and Wong's interval is too narrow if there are few and different occasions. The generalised
interval (Tian and Cappelleri, Statistics in Medicine 23, 2004, 2125) keeps its level: it is the
95 % range of the ICC of MSR / U_r, MSC / U_c and MSE / U_e, where each U is chi-squared over its
degrees of freedom.

The error of one measurement does not depend on the number of averaged scores. The difference of two
measurements of a subject contains two occasions and two errors, so

    SEM^2 = var(occasion) + var(error),  estimated by MSW = ((n - 1) MSE + MSC) / n,
    MDC   = t sqrt(2) SEM,

where t is Student's quantile with Satterthwaite's degrees of freedom of MSW. SEM equals
SD sqrt(1 - ICC(A,1)), not with ICC(A,k), which is the reliability of a mean.

A difference between visits is tested by MSC / MSE, uncorrected and with the epsilon of Greenhouse
and Geisser (1959); the trend (learning) by a t-test of the subjects' slopes, for two visits the
paired t-test.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
import scipy

from impc.arrays import Array, frozen, percentiles
from impc.errors import DataError

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

#: Lower end of a 95 % interval from which an ICC is called reliable: good by Cicchetti (1994).
GOOD = 0.60
_ALIKE = 1e-24  # Relative size of mean squares that is rounding error
_LEVEL = 0.95
#: ICC of a single score, or of the mean over all occasions.
Form = Literal["A,1", "A,k"]
#: Interval: McGraw and Wong's F, or the generalised one.
Method = Literal["F", "generalised"]
# Draws of a generalised interval: its ends then vary by 1 % of its width between seeds.
_DRAWS = 20_000


class MeanSquares(NamedTuple):
    """Mean squares of the two-way layout in the score's unit squared, and its size."""

    subjects: float  # MSR
    occasions: float  # MSC
    error: float  # MSE
    within: float  # MSW
    n: int  # Number of subjects
    k: int  # Number of occasions


class Icc(NamedTuple):
    """Intraclass correlation with its 95 % interval."""

    # NaN if all scores are equal or the denominator is not positive. An estimate of 1 has the
    # interval 1 to 1.
    value: float = np.nan
    low: float = np.nan
    high: float = np.nan
    subjects: int = 0
    left_out: int = 0  # Number of subjects without all scores


class MeasurementError(NamedTuple):
    """Error of one measurement of one subject, in the scores' unit."""

    sem: float = np.nan  # Standard error of measurement
    # Minimal detectable change: by error alone, 5 % of differences of two measurements exceed it
    mdc: float = np.nan


def icc(scores: ArrayLike, form: Form = "A,k", method: Method = "F") -> Icc:
    """Intraclass correlation of `scores` (subjects, occasions)."""
    complete, left_out = complete_rows(scores)
    squares = mean_squares(complete)
    value = _estimate(squares, form)
    # If all subjects have the same mean, there is no interval.
    alike = squares.subjects <= _ALIKE * (squares.within + squares.occasions)
    if alike or np.isnan(value):
        low, high = np.nan, np.nan
    elif value == 1:
        low, high = 1.0, 1.0
    else:
        low, high = _f_limits(squares) if method == "F" else _generalised(squares)
        if form == "A,k":
            low, high = (_stepped_up(end, squares.k) for end in (low, high))
        if method == "generalised":
            low, high = min(low, value), max(high, value)
    return Icc(value, low, high, squares.n, left_out)


def mean_squares(scores: Array) -> MeanSquares:
    """Mean squares of complete scores (subjects, occasions)."""
    n, k = scores.shape
    mean, rows, columns = scores.mean(), scores.mean(axis=1), scores.mean(axis=0)
    residual = scores - rows[:, None] - columns + mean
    return MeanSquares(
        float(k * np.sum((rows - mean) ** 2) / (n - 1)),
        float(n * np.sum((columns - mean) ** 2) / (k - 1)),
        float(np.sum(residual**2) / ((n - 1) * (k - 1))),
        float(np.sum((scores - rows[:, None]) ** 2) / (n * (k - 1))),
        n,
        k,
    )


def measurement_error(scores: ArrayLike) -> MeasurementError:
    """SEM and minimal detectable change of one measurement; `scores` (subjects, occasions)."""
    complete = complete_rows(scores)[0]
    if np.ptp(complete - complete[:, :1]) == 0:
        return MeasurementError(0.0, 0.0)
    squares = mean_squares(complete)
    parts = np.array([(squares.n - 1) * squares.error, squares.occasions])
    each = np.array([(squares.n - 1) * (squares.k - 1), squares.k - 1])
    freedom = float(np.sum(parts) ** 2 / np.sum(parts**2 / each))
    sem = float(np.sqrt(squares.within))
    quantile = float(scipy.stats.t.ppf(0.5 + _LEVEL / 2, freedom))
    return MeasurementError(sem, quantile * np.sqrt(2) * sem)


def complete_rows(scores: ArrayLike) -> tuple[Array, int]:
    """Scores of the subjects with all occasions, and the number of the others."""
    table = np.asarray(scores, dtype=np.float64)
    if table.shape[1] < 2:
        raise DataError("scores", f"got {table.shape[1]} occasion", "give at least 2")
    kept = table[np.all(np.isfinite(table), axis=1)]
    if len(kept) < 2:
        raise DataError(
            "scores", f"are complete for {len(kept)} subject", "give at least 2 such subjects"
        )
    return frozen(kept), len(table) - len(kept)


def _estimate(squares: MeanSquares, form: Form) -> float:
    r, c, e, _, n, k = squares
    denominator = r + (c - e) / n if form == "A,k" else r + (k - 1) * e + k * (c - e) / n
    # If subjects differ less than by error alone, the denominator of (A,k) can be negative.
    return float((r - e) / denominator) if denominator > 0 else float("nan")


def _generalised(squares: MeanSquares) -> tuple[float, float]:
    """Tian and Cappelleri's limits of ICC(A,1), with a fixed seed."""
    n, k = squares.n, squares.k
    rng = np.random.default_rng(0)
    r, c, e = (
        square / (rng.chisquare(freedom, _DRAWS) / freedom)
        for square, freedom in zip(squares[:3], (n - 1, k - 1, (n - 1) * (k - 1)), strict=True)
    )
    # Negative variances of occasions are set to zero.
    drawn = (r - e) / (r + (k - 1) * e + k * np.maximum(c - e, 0.0) / n)
    low, high = percentiles(drawn, _LEVEL)
    return float(low), float(high)


def _stepped_up(limit: float, k: int) -> float:
    """Spearman-Brown formula; ICC(A,1) above -1/(k-1), at which ICC(A,k) is -inf."""
    if 1 + (k - 1) * limit <= 0:
        return -np.inf
    return float(k * limit / (1 + (k - 1) * limit))


def _f_limits(squares: MeanSquares) -> tuple[float, float]:
    """McGraw and Wong's limits of ICC(A,1), with Satterthwaite's degrees of freedom."""
    r, c, e, _, n, k = squares
    rho, tail = _estimate(squares, "A,1"), 0.5 + _LEVEL / 2
    a = k * rho / (n * (1 - rho))
    b = 1 + k * rho * (n - 1) / (n * (1 - rho))
    spread = (a * c) ** 2 / (k - 1) + (b * e) ** 2 / ((n - 1) * (k - 1))
    freedom = (a * c + b * e) ** 2 / spread
    lower = scipy.stats.f.ppf(tail, n - 1, freedom)
    upper = scipy.stats.f.ppf(tail, freedom, n - 1)
    if not np.isfinite(lower * upper):  # almost no degrees of freedom: no value is excluded
        return -np.inf, 1.0
    rest = k * c + (k * n - k - n) * e
    low = n * (r - lower * e) / (lower * rest + n * r)
    high = n * (upper * r - e) / (rest + n * upper * r)
    return float(low), float(high)


class Anova(NamedTuple):
    """F test of a difference between visits."""

    F: float = np.nan  # Mean square of visits over that of visits by subjects
    p: float = np.nan  # Uncorrected
    p_corrected: float = np.nan  # Both degrees of freedom times Greenhouse and Geisser's epsilon


class Trend(NamedTuple):
    """Slope over visits."""

    slope: float = np.nan  # Mean of the subjects' least-squares slopes, in scores per visit
    low: float = np.nan  # 95 % interval
    high: float = np.nan
    p: float = np.nan  # t-test of a mean slope of zero


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
