"""Intervals of prices, and of ratios of two, by profile likelihood.

With a combination a'z of the unknowns held at v, all other prices are fitted again: in the
quadratic form of the gain near the fit (`near_fit`), then in that near the end. With m(v) the
least misfit,

    D(v) = (m^2(v) - m^2(v*)) / (s^2 f),

s^2 the variance of a residual and f the factor by which their colour widens the variance of a'z.
The interval is {v : D(v) <= q}, q chi-squared's quantile. It has no lower end where the price may
be zero: the answer is "at most" (docs/structures.md).
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import scipy.linalg
import scipy.stats

from impc.arrays import Array
from impc.assess.intervals import LEVEL
from impc.assess.near_fit import NearFit
from impc.assess.structured_weights import tangent
from impc.errors import WeightsError

if TYPE_CHECKING:
    from impc.assess.structured_weights import PriceCovariance, Tangent

# Logarithms: beyond a factor of e^12 in price there is no end.
_FARTHEST = 12.0
# Of a deviation: how near to its end an interval ends.
_END = 2e-2
_TRIES = 12
# An end stays when new recordings there move it by less than this share of a deviation.
_STAYS, _ROUNDS = 0.05, 12
# D where there is no regulator.
_HUGE = 1e12


@dataclass(frozen=True)
class PriceInterval:
    """An interval of a price or of a ratio of two."""

    value: float  # Its logarithm in the fit; minus infinity for a price of zero
    low: float  # Ends of the logarithm: minus infinity where the price may be zero, or sets no end
    high: float
    level: float  # Between 0 and 1

    def holds(self, value: float) -> bool:
        """Whether a logarithm, `value`, lies in it."""
        return self.low <= value <= self.high


class PriceProfiles:
    """Intervals from the misfit near a fit, and near each end."""

    def __init__(self, at: Tangent, covariance: PriceCovariance) -> None:
        self.at, self.covariance, self.near = at, covariance, NearFit(at)
        samples = len(at.residual)
        self.variance = at.noise**2 * samples / max(samples - covariance.rank, 1)
        self.base = self.near.least(np.array(at.prices), np.eye(int(np.sum(at.moving))))[0]

    def interval(self, combination: Array, level: float = LEVEL) -> PriceInterval:
        """Interval of a'z.

        `combination` (count,).
        """
        deviation, wider = self.covariance.spread(combination)
        quantile = float(scipy.stats.chi2.ppf(level, 1)) * wider**2
        moving, prices = self.at.moving, np.array(self.at.prices)
        value = float(combination[moving] @ prices[moving])
        if not np.isfinite(deviation):
            return PriceInterval(value, -np.inf, np.inf, level)
        step = min(max(deviation, 1e-9), 1.0)
        low, high = (
            self._end(_Line(combination, prices, value, sign * step), quantile)
            for sign in (-1.0, 1.0)
        )
        return PriceInterval(value, low, high, level)

    def zero(self, index: int, level: float = LEVEL) -> PriceInterval:
        """Interval of the price `index` that is zero in the fit: at most its upper end."""
        near = np.array(self.at.prices)
        near[index] = self._smallest_seen(index)
        line = _Line(np.eye(len(near))[index], near, float(near[index]), 0.5)
        high = self._end(line, float(scipy.stats.chi2.ppf(level, 1)))
        return PriceInterval(-np.inf, -np.inf, high, level)

    def _smallest_seen(self, index: int) -> float:
        """Logarithm of the price that moves the outputs by a tenth of a deviation."""
        column = self.at.without_nuisance(np.array(self.at.on_prices[:, index])[:, None])
        size = max(float(np.linalg.norm(column)), 1e-300)
        return float(np.log(0.1 * self.at.noise / size))

    def _end(self, line: _Line, quantile: float) -> float:
        """Where D passes the quantile along a line, or infinity.

        Recordings answer a gain that is far from the fit's otherwise than one that is near: they
        are simulated again where the end is found, until it stays, between places with less and
        with more. Where the body falls, or there is no regulator, is more.
        """
        inside, outside = line.prices, None
        end, there = self._passing(self.near, line, line.prices, quantile)
        for _ in range(_ROUNDS):
            before, form = end, self._form(there)
            more, further = True, None
            if form is not None:
                distance, there = self._distance(form, line.row, line.at(there), there)
                more = distance > quantile
                end, further = self._passing(form, line, there, quantile)
            inside, outside = (inside, there) if more else (there, outside)
            if further is None or not line.between(inside, end, outside):
                assert outside is not None
                further = _middle(inside, outside)
                end = line.at(further)
            there = further
            if end == before or abs(end - before) < _STAYS * abs(line.step):
                break
        return end

    def _form(self, prices: Array) -> NearFit | None:
        """The quadratic form elsewhere, in the noise of the fit; None where there is none."""
        try:
            there = tangent(self.at.structure, self.at.problem, prices)
        except WeightsError:
            return None
        if there.found.reason:
            return None
        return NearFit(dataclasses.replace(there, noise=self.at.noise))

    def _passing(
        self, form: NearFit, line: _Line, here: Array, quantile: float
    ) -> tuple[float, Array]:
        """Where D of a form passes the quantile, looked for from a place in growing steps.

        Away from the fit where D is less there, towards it where it is more.
        """
        value = line.at(here)
        distance, here = self._distance(form, line.row, value, here)
        outwards = distance <= quantile
        step = line.step if outwards else -line.step
        while not outwards or abs(value - line.value) < _FARTHEST:
            beyond = value + step
            if not outwards and (beyond - line.value) * line.step <= 0:
                further, there, beyond = 0.0, line.prices, line.value
            else:
                further, there = self._distance(form, line.row, beyond, here)
            if (further > quantile) == outwards:
                ends = ((value, distance, here), (beyond, further, there))
                inside, outside = ends if outwards else ends[::-1]
                return self._crossing(form, line.row, (inside, outside), quantile)
            value, here, distance, step = beyond, there, further, 1.6 * step
        return float(np.sign(line.step) * np.inf), here

    def _crossing(
        self,
        form: NearFit,
        row: Array,
        bracket: tuple[tuple[float, float, Array], tuple[float, float, Array]],
        quantile: float,
    ) -> tuple[float, Array]:
        """Where D passes the quantile between two values: its root is all but linear."""
        (inside, less, near), (outside, more, _) = bracket
        wanted, step = np.sqrt(quantile), abs(outside - inside)
        for _ in range(_TRIES):
            roots = np.sqrt(max(less, 0.0)), np.sqrt(min(more, _HUGE))
            share = float(np.clip((wanted - roots[0]) / (roots[1] - roots[0]), 0.1, 0.9))
            middle = inside + share * (outside - inside)
            distance, there = self._distance(form, row, middle, near)
            if abs(np.sqrt(max(distance, 0.0)) - wanted) < _END:
                return middle, there
            if distance > quantile:
                outside, more = middle, distance
            else:
                inside, less, near = middle, distance, there
            if abs(outside - inside) < _END * step:
                break
        return inside, near

    def _distance(
        self, form: NearFit, row: Array, value: float, near: Array
    ) -> tuple[float, Array]:
        """D for white residuals with the combination held, and the unknowns there."""
        moving = np.isfinite(near)
        own = row[moving]
        z = near.copy()
        z[moving] += (value - float(own @ near[moving])) / float(own @ own) * own
        best, there = form.least(z, scipy.linalg.null_space(own[None]))
        for index in np.flatnonzero(~moving[: len(self.at.structure.labels)]):
            # A price of zero may be worth having once another is held elsewhere.
            other = z.copy()
            other[index] = self._smallest_seen(int(index))
            free = row[np.isfinite(other)]
            found, place = form.least(other, scipy.linalg.null_space(free[None]))
            if found < best:
                best, there = found, place
        return (best - self.base) / self.variance, there


class _Line(NamedTuple):
    """A combination of unknowns (count,), these and its value in the fit, a step to an end."""

    row: Array
    prices: Array
    value: float
    step: float

    def at(self, prices: Array) -> float:
        """Value of the combination elsewhere."""
        finite = np.isfinite(prices)
        return float(self.row[finite] @ prices[finite])

    def between(self, inside: Array, value: float, outside: Array | None) -> bool:
        """Whether a value lies between those of two places; with one, beyond that."""
        side = np.sign(self.step)
        nearest = side * self.at(inside) <= side * value
        return bool(nearest and (outside is None or side * value < side * self.at(outside)))


def _middle(one: Array, other: Array) -> Array:
    """Half-way between unknowns; as in the first where one of the two is no number."""
    both = np.isfinite(one) & np.isfinite(other)
    return np.where(both, (one + np.where(both, other, 0.0)) / 2, one)
