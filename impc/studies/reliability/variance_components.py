"""Variance of subjects, visits and trials behind scores, with intervals.

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

from dataclasses import dataclass

import numpy as np
import scipy.stats

from impc.arrays import Array
from impc.errors import DataError


@dataclass(frozen=True)
class VarianceComponent:
    """One component."""

    name: str  # "subject", "visit" or "trial"
    value: float  # Estimate and ends of the interval, in the score's unit squared
    low: float
    high: float


def variance_components(scores: Array, level: float = 0.95) -> tuple[VarianceComponent, ...]:
    """Components of subjects, visits and trials.

    `scores` (subjects, visits, trials).
    """
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
