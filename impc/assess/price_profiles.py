"""Intervals of prices, and of ratios of two, by profile likelihood.

With a combination a'z of the unknowns held at v, all other prices are fitted again, near the fit
(`near_fit`). With m(v) the least misfit,

    D(v) = (m^2(v) - m^2(v*)) / (s^2 f),

s^2 the variance of a residual and f the factor by which their colour widens the variance of a'z.
The interval is {v : D(v) <= q}, q chi-squared's quantile. It has no lower end where the price may
be zero: the answer is "at most" (docs/structures.md).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.linalg
import scipy.stats

from impc.arrays import Array
from impc.assess.intervals import LEVEL
from impc.assess.near_fit import NearFit

if TYPE_CHECKING:
    from impc.assess.structured_weights import PriceCovariance, Tangent

__all__ = ["PriceInterval", "PriceProfiles"]

# Logarithms: beyond a factor of e^12 in price there is no end.
_FARTHEST = 12.0
# Of a deviation: how near to its end an interval ends.
_END = 2e-2
_TRIES = 12
# D where there is no regulator.
_HUGE = 1e12


@dataclass(frozen=True)
class PriceInterval:
    """An interval of a price or of a ratio of two.

    Attributes
    ----------
    value : float
        Its logarithm in the fit; minus infinity for a price of zero.
    low, high : float
        Ends of the logarithm: minus infinity where the price may be zero, or sets no end.
    level : float
        Between 0 and 1.
    """

    value: float
    low: float
    high: float
    level: float

    def holds(self, value: float) -> bool:
        """Whether a logarithm, `value`, lies in it."""
        return self.low <= value <= self.high


class PriceProfiles:
    """Intervals from the misfit near a fit.

    Parameters
    ----------
    at : Tangent
        Of a structure whose features are priced one by one.
    covariance : PriceCovariance
        Of the same fit.
    """

    def __init__(self, at: Tangent, covariance: PriceCovariance) -> None:
        self.at, self.covariance, self.near = at, covariance, NearFit(at)
        samples = len(at.residual)
        self.variance = at.noise**2 * samples / max(samples - covariance.rank, 1)
        self.base = self.near.least(np.array(at.prices), np.eye(int(np.sum(at.moving))))[0]

    def interval(self, combination: Array, level: float = LEVEL) -> PriceInterval:
        """Interval of a'z.

        Parameters
        ----------
        combination : Array
            a (count,), of unknowns that are not zero in the fit.
        level : float
            Between 0 and 1.
        """
        deviation, wider = self.covariance.spread(combination)
        quantile = float(scipy.stats.chi2.ppf(level, 1)) * wider**2
        moving = self.at.moving
        value = float(combination[moving] @ self.at.prices[moving])
        if not np.isfinite(deviation):
            return PriceInterval(value, -np.inf, np.inf, level)
        step = min(max(deviation, 1e-9), 1.0)
        low, high = (
            self._walk(combination, np.array(self.at.prices), (value, sign * step), quantile)
            for sign in (-1.0, 1.0)
        )
        return PriceInterval(value, low, high, level)

    def zero(self, index: int, level: float = LEVEL) -> PriceInterval:
        """Interval of the price `index` that is zero in the fit: at most its upper end.

        Parameters
        ----------
        index : int
            Of the unknown.
        level : float
            Between 0 and 1.
        """
        near = np.array(self.at.prices)
        near[index] = self._smallest_seen(index)
        row = np.eye(len(near))[index]
        quantile = float(scipy.stats.chi2.ppf(level, 1))
        high = self._walk(row, near, (float(near[index]), 0.5), quantile)
        return PriceInterval(-np.inf, -np.inf, high, level)

    def _smallest_seen(self, index: int) -> float:
        """Logarithm of the price that moves the outputs by a tenth of a deviation."""
        column = self.at.without_nuisance(np.array(self.at.on_prices[:, index])[:, None])
        size = max(float(np.linalg.norm(column)), 1e-300)
        return float(np.log(0.1 * self.at.noise / size))

    def _walk(self, row: Array, near: Array, begin: tuple[float, float], quantile: float) -> float:
        """Where D passes the quantile on the way from a value in growing steps, or infinity."""
        inside, step = begin
        here, before = near, 0.0
        while abs(inside - begin[0]) < _FARTHEST:
            outside = inside + step
            distance, there = self._distance(row, outside, here)
            if distance > quantile:
                return self._crossing(row, here, ((inside, before), (outside, distance)), quantile)
            inside, here, before, step = outside, there, distance, 1.6 * step
        return float(np.sign(step) * np.inf)

    def _crossing(
        self,
        row: Array,
        near: Array,
        bracket: tuple[tuple[float, float], tuple[float, float]],
        quantile: float,
    ) -> float:
        """Where D passes the quantile between two values: its root is all but linear."""
        (inside, less), (outside, more) = bracket
        wanted, step = np.sqrt(quantile), abs(outside - inside)
        for _ in range(_TRIES):
            roots = np.sqrt(max(less, 0.0)), np.sqrt(min(more, _HUGE))
            share = float(np.clip((wanted - roots[0]) / (roots[1] - roots[0]), 0.1, 0.9))
            middle = inside + share * (outside - inside)
            distance, there = self._distance(row, middle, near)
            if abs(np.sqrt(max(distance, 0.0)) - wanted) < _END:
                return middle
            if distance > quantile:
                outside, more = middle, distance
            else:
                inside, less, near = middle, distance, there
            if abs(outside - inside) < _END * step:
                break
        return inside

    def _distance(self, row: Array, value: float, near: Array) -> tuple[float, Array]:
        """D for white residuals with the combination held, and the unknowns there."""
        moving = np.isfinite(near)
        own = row[moving]
        z = near.copy()
        z[moving] += (value - float(own @ near[moving])) / float(own @ own) * own
        best, there = self.near.least(z, scipy.linalg.null_space(own[None]))
        for index in np.flatnonzero(~moving[: len(self.at.structure.labels)]):
            # A price of zero may be worth having once another is held elsewhere.
            other = z.copy()
            other[index] = self._smallest_seen(int(index))
            free = row[np.isfinite(other)]
            found, place = self.near.least(other, scipy.linalg.null_space(free[None]))
            if found < best:
                best, there = found, place
        return (best - self.base) / self.variance, there
