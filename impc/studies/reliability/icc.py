"""Intraclass correlation in all forms of McGraw and Wong (1996), with F-based intervals.

n subjects are measured on k occasions. From the two-way analysis of variance

    MSR = k sum_i (m_i. - m)^2 / (n - 1)                      subjects
    MSC = n sum_j (m_.j - m)^2 / (k - 1)                      occasions
    MSE = sum_ij (x_ij - m_i. - m_.j + m)^2 / ((n - 1)(k - 1))
    MSW = sum_ij (x_ij - m_i.)^2 / (n (k - 1))                within subjects, one-way

    (1)     (MSR - MSW) / (MSR + (k - 1) MSW)                 one-way, single score
    (k)     (MSR - MSW) / MSR                                 one-way, mean of k
    (C,1)   (MSR - MSE) / (MSR + (k - 1) MSE)                 consistency
    (C,k)   (MSR - MSE) / MSR
    (A,1)   (MSR - MSE) / (MSR + (k - 1) MSE + k (MSC - MSE) / n)      absolute agreement
    (A,k)   (MSR - MSE) / (MSR + (MSC - MSE) / n)

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

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np
import scipy.stats

from impc.arrays import Array, frozen, percentiles
from impc.errors import DataError, InputError

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

_ALIKE = 1e-24  # of mean squares: round-off of means
#: One of `FORMS`, for annotations.
Form = Literal["1", "k", "C,1", "C,k", "A,1", "A,k"]
#: Names of the forms, as above.
FORMS: tuple[Form, ...] = ("1", "k", "C,1", "C,k", "A,1", "A,k")

#: How an interval is made: McGraw and Wong's, or the generalised one (absolute agreement only).
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


@dataclass(frozen=True)
class Icc:
    """One intraclass correlation."""

    form: Form  # One of `FORMS`
    # Estimate and ends of the interval; NaN when all scores are equal, or the denominator is not
    # positive. An estimate of 1 has the interval 1 to 1.
    value: float
    low: float
    high: float
    level: float  # Of the interval
    subjects: int  # How many there were of each
    occasions: int
    left_out: int  # Subjects that lacked a score on some occasion


@dataclass(frozen=True)
class MeasurementError:
    """Error of one measurement of one subject."""

    sem: float  # Standard error of measurement, in the scores' unit
    freedom: float  # Satterthwaite's degrees of freedom of its square; NaN when it is zero
    # Minimal detectable change: what the difference of two measurements exceeds by error alone in 1
    # - level of all subjects, in the scores' unit
    mdc: float
    level: float  # Of the MDC


def icc(scores: ArrayLike, form: Form = "A,k", level: float = 0.95, method: Method = "F") -> Icc:
    """Intraclass correlation of scores; `scores` (subjects, occasions)."""
    if form not in FORMS:
        raise InputError(f"ICC form {form!r}", "is not known", f"known: {', '.join(FORMS)}")
    if method != "F" and form not in ("A,1", "A,k"):
        raise InputError(f"interval {method!r}", f"is not one of ICC({form})", "take 'F'")
    if not 0 < level < 1:
        raise InputError("level", f"got {level}", "give a share between 0 and 1")
    complete, left_out = _complete(scores)
    squares = mean_squares(complete)
    value = _estimate(squares, form)
    limits = _interval if method == "F" else _generalised
    # Of subjects whose means are the same number nothing says how far others might differ.
    alike = squares.subjects <= _ALIKE * (squares.within + squares.occasions)
    low, high = (np.nan, np.nan) if alike else limits(squares, form, value, level)
    return Icc(form, value, low, high, level, squares.n, squares.k, left_out)


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


def measurement_error(scores: ArrayLike, level: float = 0.95) -> MeasurementError:
    """Error of one measurement, and the change that it hides; `scores` (subjects, occasions)."""
    if not 0 < level < 1:
        raise InputError("level", f"got {level}", "give a share between 0 and 1")
    complete = _complete(scores)[0]
    squares = mean_squares(complete)
    parts = np.array([(squares.n - 1) * squares.error, squares.occasions])
    if np.ptp(complete - complete[:, :1]) == 0:
        return MeasurementError(0.0, float("nan"), 0.0, level)
    each = np.array([(squares.n - 1) * (squares.k - 1), squares.k - 1])
    freedom = float(np.sum(parts) ** 2 / np.sum(parts**2 / each))
    sem = float(np.sqrt(squares.within))
    quantile = float(scipy.stats.t.ppf(0.5 + level / 2, freedom))
    return MeasurementError(sem, freedom, quantile * np.sqrt(2) * sem, level)


def _complete(scores: ArrayLike) -> tuple[Array, int]:
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
    r, c, e, w, n, k = squares
    error = w if form in ("1", "k") else e
    denominator = {
        "1": r + (k - 1) * w,
        "k": r,
        "C,1": r + (k - 1) * e,
        "C,k": r,
        "A,1": r + (k - 1) * e + k * (c - e) / n,
        "A,k": r + (c - e) / n,
    }[form]
    # Where subjects differ less than error makes them differ, the ratio for a mean can lose its
    # denominator, and with it its meaning.
    return float((r - error) / denominator) if denominator > 0 else float("nan")


def _interval(squares: MeanSquares, form: Form, value: float, level: float) -> tuple[float, float]:
    if np.isnan(value):
        return float("nan"), float("nan")
    if value == 1:
        return 1.0, 1.0
    single = {"k": "1", "C,k": "C,1", "A,k": "A,1"}
    if form in single:  # Spearman and Brown's step-up of the limits for a single score
        k = squares.k
        base: Form = single[form]  # type: ignore[assignment]
        ends = _interval(squares, base, _estimate(squares, base), level)
        low, high = (_stepped_up(end, k) for end in ends)
        return low, high
    tail = 0.5 + level / 2
    if form == "A,1":
        return _agreement_limits(squares, value, tail)
    r, _, e, w, n, k = squares
    error, freedom = (w, n * (k - 1)) if form == "1" else (e, (n - 1) * (k - 1))
    if error == 0:
        return 1.0, 1.0
    ratio = r / error
    low = ratio / scipy.stats.f.ppf(tail, n - 1, freedom)
    high = ratio * scipy.stats.f.ppf(tail, freedom, n - 1)
    return float((low - 1) / (low + k - 1)), float((high - 1) / (high + k - 1))


def _generalised(
    squares: MeanSquares, form: Form, value: float, level: float
) -> tuple[float, float]:
    """Tian and Cappelleri's limits; the same draws for every table, so that nothing is random."""
    if np.isnan(value):
        return float("nan"), float("nan")
    if value == 1:
        return 1.0, 1.0
    n, k = squares.n, squares.k
    rng = np.random.default_rng(0)
    r, c, e = (
        square / (rng.chisquare(freedom, _DRAWS) / freedom)
        for square, freedom in (
            (squares.subjects, n - 1),
            (squares.occasions, k - 1),
            (squares.error, (n - 1) * (k - 1)),
        )
    )
    # Occasions whose variance would be negative have none.
    drawn = (r - e) / (r + (k - 1) * e + k * np.maximum(c - e, 0.0) / n)
    low, high = map(float, percentiles(drawn, level))
    if form == "A,k":
        low, high = (_stepped_up(end, k) for end in (low, high))
    return min(low, value), max(high, value)


def _stepped_up(limit: float, k: int) -> float:
    """Spearman and Brown; no single score's ICC is below -1/(k-1), where the mean's is -inf."""
    if 1 + (k - 1) * limit <= 0:
        return -np.inf
    return float(k * limit / (1 + (k - 1) * limit))


def _agreement_limits(squares: MeanSquares, rho: float, tail: float) -> tuple[float, float]:
    """McGraw and Wong's limits of ICC(A,1), with Satterthwaite's degrees of freedom."""
    r, c, e, _, n, k = squares
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
