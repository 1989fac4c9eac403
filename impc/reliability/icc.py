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
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np
import scipy.stats

from impc.arrays import Array, frozen
from impc.errors import DataError, InputError

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

__all__ = [
    "FORMS",
    "Form",
    "Icc",
    "MeanSquares",
    "icc",
    "mean_squares",
    "minimal_detectable_change",
    "standard_error_of_measurement",
]

#: One of `FORMS`, for annotations.
Form = Literal["1", "k", "C,1", "C,k", "A,1", "A,k"]
#: Names of the forms, as above.
FORMS: tuple[Form, ...] = ("1", "k", "C,1", "C,k", "A,1", "A,k")


class MeanSquares(NamedTuple):
    """Mean squares of the two-way layout, and its size.

    Attributes
    ----------
    subjects, occasions, error, within : float
        MSR, MSC, MSE and MSW, in the score's unit squared.
    n, k : int
        Number of subjects and of occasions.
    """

    subjects: float
    occasions: float
    error: float
    within: float
    n: int
    k: int


@dataclass(frozen=True)
class Icc:
    """One intraclass correlation.

    Attributes
    ----------
    form : str
        One of `FORMS`.
    value, low, high : float
        Estimate and ends of the interval; NaN when all scores are equal, or the denominator is
        not positive. An estimate of 1 has the interval 1 to 1.
    level : float
        Of the interval.
    subjects, occasions : int
        How many there were of each.
    left_out : int
        Subjects that lacked a score on some occasion.
    """

    form: Form
    value: float
    low: float
    high: float
    level: float
    subjects: int
    occasions: int
    left_out: int


def icc(scores: ArrayLike, form: Form = "A,k", level: float = 0.95) -> Icc:
    """Intraclass correlation of scores.

    Parameters
    ----------
    scores : array_like
        (subjects, occasions); NaN where there is none. Subjects with a missing score are left out.
    form : str
        One of `FORMS`. Chapter 5 uses (A,k); so does chapter 2 here.
    level : float
        Of the interval, between 0 and 1.

    Raises
    ------
    InputError
        When the form is unknown or the level out of range.
    DataError
        When fewer than two subjects or two occasions are complete.
    """
    if form not in FORMS:
        raise InputError(f"ICC form {form!r}", "is not known", f"known: {', '.join(FORMS)}")
    if not 0 < level < 1:
        raise InputError("level", f"got {level}", "give a share between 0 and 1")
    complete, left_out = _complete(scores)
    squares = mean_squares(complete)
    value = _estimate(squares, form)
    low, high = _interval(squares, form, value, level)
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


def standard_error_of_measurement(scores: ArrayLike, correlation: float) -> float:
    """SEM = SD sqrt(1 - ICC), SD that of all complete scores, in their unit; NaN for ICC > 1.

    Parameters
    ----------
    scores : array_like
        (subjects, occasions), NaN where missing.
    correlation : float
        The ICC.

    Raises
    ------
    DataError
        When there are fewer than two complete subjects or two occasions.
    """
    complete, _ = _complete(scores)
    return (
        float(np.std(complete, ddof=1) * np.sqrt(1 - correlation)) if correlation <= 1 else np.nan
    )


def minimal_detectable_change(sem: float, level: float = 0.95) -> float:
    """Change between two measurements that error alone exceeds in 1 - level: z sqrt(2) SEM.

    In the unit of the `sem`.
    """
    return float(scipy.stats.norm.ppf(0.5 + level / 2) * np.sqrt(2) * sem)


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
