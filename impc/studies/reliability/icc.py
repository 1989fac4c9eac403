"""Intraclass correlation of agreement (McGraw and Wong 1996), with intervals.

n subjects are measured on k occasions. From the two-way analysis of variance

    MSR = k sum_i (m_i. - m)^2 / (n - 1)                      subjects
    MSC = n sum_j (m_.j - m)^2 / (k - 1)                      occasions
    MSE = sum_ij (x_ij - m_i. - m_.j + m)^2 / ((n - 1)(k - 1))
    MSW = sum_ij (x_ij - m_i.)^2 / (n (k - 1))                within subjects, one-way

    (A,1)   (MSR - MSE) / (MSR + (k - 1) MSE + k (MSC - MSE) / n)      of a single score
    (A,k)   (MSR - MSE) / (MSR + (MSC - MSE) / n)                      of the mean of k

Whether occasions are random or fixed changes the meaning and not the number. Estimates may be
negative, and are reported as they are.

McGraw and Wong's interval of (A,1) and (A,k) is too narrow where occasions differ and are few; the
generalised one (Tian and Cappelleri, Statistics in Medicine 23, 2004, 2125) covers there too. With
U chi-squared over its degrees of freedom it is the range of the ICC of MSR / U_r, MSC / U_c and
MSE / U_e (docs/reliability.md has how often each covers).

The error of one measurement does not depend on how many are averaged for an ICC. Two measurements
of a subject on two occasions differ by two occasions and two errors, so

    SEM^2 = var(occasion) + var(error),  estimated by MSW = ((n - 1) MSE + MSC) / n,
    MDC   = t sqrt(2) SEM,

t Student's with Satterthwaite's degrees of freedom of MSW. SEM is SD sqrt(1 - ICC(A,1)), and not
with ICC(A,k), the reliability of a mean.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np
import scipy.stats

from impc.arrays import Array, frozen, percentiles
from impc.errors import DataError, InputError

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

_ALIKE = 1e-24  # of mean squares: round-off of means
_LEVEL = 0.95
#: Of a single score, or of the mean over all occasions.
Form = Literal["A,1", "A,k"]
FORMS: tuple[Form, ...] = ("A,1", "A,k")

#: How an interval is made: McGraw and Wong's, or the generalised one.
Method = Literal["F", "generalised"]
# Draws behind a generalised interval: its ends then vary by .01 of its width from seed to seed.
_DRAWS = 20_000


class MeanSquares(NamedTuple):
    """Mean squares of the two-way layout, and its size."""

    subjects: float  # MSR, MSC, MSE and MSW, in the score's unit squared
    occasions: float
    error: float
    within: float
    n: int  # Number of subjects and of occasions
    k: int


class Icc(NamedTuple):
    """One intraclass correlation with its interval of 95 %."""

    # NaN when all scores are equal, or the denominator is not positive. An estimate of 1 has the
    # interval 1 to 1.
    value: float
    low: float
    high: float
    subjects: int
    left_out: int  # Subjects that lacked a score on some occasion


class MeasurementError(NamedTuple):
    """Error of one measurement of one subject, in the scores' unit."""

    sem: float  # Standard error of measurement
    # Minimal detectable change: what the difference of two measurements exceeds by error alone in
    # 5 % of all subjects
    mdc: float


def icc(scores: ArrayLike, form: Form = "A,k", method: Method = "F") -> Icc:
    """Intraclass correlation of scores; `scores` (subjects, occasions)."""
    if form not in FORMS:
        raise InputError(f"ICC form {form!r}", "is not one of agreement", "take 'A,1' or 'A,k'")
    complete, left_out = complete_rows(scores)
    squares = mean_squares(complete)
    value = _estimate(squares, form)
    # Of subjects whose means are the same number nothing says how far others might differ.
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
    """Error of one measurement, and the change that it hides; `scores` (subjects, occasions)."""
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
    """Scores (subjects, occasions) of the subjects who have all, and how many lack one."""
    table = np.asarray(scores, dtype=np.float64)
    if table.ndim != 2:
        raise DataError("scores", f"have {table.ndim} dimensions", "give (subjects, occasions)")
    if table.shape[1] < 2:
        raise DataError("scores", f"are of {table.shape[1]} occasion", "an ICC needs two or more")
    kept = table[np.all(np.isfinite(table), axis=1)]
    if len(kept) < 2:
        raise DataError(
            "scores", f"are complete for {len(kept)} subject", "an ICC needs two or more"
        )
    return frozen(kept), len(table) - len(kept)


def _estimate(squares: MeanSquares, form: Form) -> float:
    r, c, e, _, n, k = squares
    denominator = r + (c - e) / n if form == "A,k" else r + (k - 1) * e + k * (c - e) / n
    # Where subjects differ less than error makes them differ, the ratio for a mean can lose its
    # denominator, and with it its meaning.
    return float((r - e) / denominator) if denominator > 0 else float("nan")


def _generalised(squares: MeanSquares) -> tuple[float, float]:
    """Tian and Cappelleri's limits of ICC(A,1); the same draws for every table."""
    n, k = squares.n, squares.k
    rng = np.random.default_rng(0)
    r, c, e = (
        square / (rng.chisquare(freedom, _DRAWS) / freedom)
        for square, freedom in zip(squares[:3], (n - 1, k - 1, (n - 1) * (k - 1)), strict=True)
    )
    # Occasions whose variance would be negative have none.
    drawn = (r - e) / (r + (k - 1) * e + k * np.maximum(c - e, 0.0) / n)
    low, high = percentiles(drawn, _LEVEL)
    return float(low), float(high)


def _stepped_up(limit: float, k: int) -> float:
    """Spearman and Brown; no single score's ICC is below -1/(k-1), where the mean's is -inf."""
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
    if spread == 0:
        return 1.0, 1.0
    freedom = (a * c + b * e) ** 2 / spread
    lower = scipy.stats.f.ppf(tail, n - 1, freedom)
    upper = scipy.stats.f.ppf(tail, freedom, n - 1)
    if not np.isfinite(lower * upper):  # nearly no degree of freedom: nothing is excluded
        return -np.inf, 1.0
    rest = k * c + (k * n - k - n) * e
    low = n * (r - lower * e) / (lower * rest + n * r)
    high = n * (upper * r - e) / (rest + n * upper * r)
    return float(low), float(high)
