"""Profile-likelihood intervals of cost weights and of their ratios.

With a combination a'z of the unknowns fixed at v, all other cost weights are refitted: in the
quadratic approximation of the misfit near the fit (`structured_weights`), then in that near the
end. With the least misfit m(v),

    D(v) = (m^2(v) - m^2(v*)) / (s^2 f),

s^2 the residual variance and f the factor by which autocorrelation widens the variance of a'z. The
interval is {v : D(v) <= q}, q a chi-squared quantile. Without a lower end the cost weight may be
zero, and the statement is "at most" (docs/howto/weights.md).
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import scipy.linalg
import scipy.optimize
import scipy.stats

from impc.arrays import Array
from impc.assess.printed_gain import LEVEL
from impc.assess.structured_weights import tangent
from impc.errors import WeightsError

if TYPE_CHECKING:
    from impc.assess.structured_weights import LocalQuadratic, Tangent, WeightCovariance

# Largest log cost weight searched: beyond a factor of e^12 the interval has no end.
_FARTHEST = 12.0
# Accuracy of an end, relative to the step.
_END = 1e-2
# Accept an end if refitting there moves it by less than this share of a standard error.
_STAYS, _ROUNDS = 0.05, 13
# D without a Riccati solution.
_HUGE = 1e12
_QUANTILE = float(scipy.stats.chi2.ppf(LEVEL, 1))


@dataclass(frozen=True)
class WeightInterval:
    """95 % interval of a log cost weight or of the log ratio of two."""

    value: float  # Logarithm at the fit; minus infinity: cost weight zero
    # Ends of the logarithm; minus infinity if the cost weight may be zero
    low: float
    high: float

    def shifted(self, by: float) -> WeightInterval:
        """Interval of the logarithm plus a constant."""
        return WeightInterval(self.value + by, self.low + by, self.high + by)

    def holds(self, value: float) -> bool:
        """Whether a logarithm `value` lies in the interval."""
        return self.low <= value <= self.high


class WeightProfiles:
    """Profile-likelihood intervals from quadratic approximations at the fit and at each end."""

    def __init__(self, at: Tangent, covariance: WeightCovariance) -> None:
        self.at, self.covariance = at, covariance
        samples, every = len(at.residual), np.eye(int(np.sum(at.moving)))
        self.variance = at.noise**2 * samples / max(samples - covariance.rank, 1)
        self.base = at.quadratic.least(np.array(at.cost_weights), every)[0]

    def interval(self, combination: Array) -> WeightInterval:
        """Interval of a'z for a `combination` a (count,)."""
        deviation, wider = self.covariance.spread(combination)
        quantile = _QUANTILE * wider**2
        moving, cost_weights = self.at.moving, np.array(self.at.cost_weights)
        value = float(combination[moving] @ cost_weights[moving])
        if not np.isfinite(deviation):
            return WeightInterval(value, -np.inf, np.inf)
        step = min(max(deviation, 1e-9), 1.0)
        low, high = (
            self._end(_Line(combination, cost_weights, value, sign * step), quantile)
            for sign in (-1.0, 1.0)
        )
        return WeightInterval(value, low, high)

    def zero(self, index: int) -> WeightInterval:
        """Interval of a cost weight `index` that is zero at the fit: only an upper end."""
        near = np.array(self.at.cost_weights)
        near[index] = self._smallest_seen(index)
        line = _Line(np.eye(len(near))[index], near, float(near[index]), 0.5)
        return WeightInterval(-np.inf, -np.inf, self._end(line, _QUANTILE))

    def unknowns(self) -> tuple[WeightInterval, ...]:
        """Interval of each unknown; a normal one if products of features have cost weights."""
        structure, found = self.at.structure, self.covariance
        if structure.coupled or structure.input_coupled:
            half = np.sqrt(_QUANTILE) * found.each
            ends = np.column_stack([found.values, found.values - half, found.values + half])
            return tuple(WeightInterval(*one) for one in ends.tolist())
        rows = enumerate(zip(np.eye(structure.count), self.at.moving, strict=True))
        return tuple(
            self.interval(row) if moving else self.zero(index) for index, (row, moving) in rows
        )

    def _smallest_seen(self, index: int) -> float:
        """Log cost weight that moves the outputs by a tenth of a noise SD."""
        column = self.at.without_nuisance(np.array(self.at.on_cost_weights[:, index])[:, None])
        size = max(float(np.linalg.norm(column)), 1e-300)
        return float(np.log(0.1 * self.at.noise / size))

    def _end(self, line: _Line, quantile: float) -> float:
        """Value at which D crosses the quantile along a line, or infinity.

        The approximation is recomputed at its own crossing until that stays; a crossing outside the
        points with smaller and larger D is replaced by their midpoint. Divergence and a missing
        Riccati solution count as larger.
        """
        side, near = np.sign(line.step), _STAYS * abs(line.step)
        form: LocalQuadratic | None = self.at.quadratic
        here, inside, outside, end = line.cost_weights, line.cost_weights, None, line.value
        for _ in range(_ROUNDS):
            before, beyond, further = end, True, None
            if form is not None:
                beyond, here, end, further = self._crossing(form, line, here, quantile)
                if end == before or abs(end - before) < near:
                    break
            inside, outside = (inside, here) if beyond else (here, outside)
            left = further is None or side * end < side * line.at(inside)
            if outside is not None and (left or side * end >= side * line.at(outside)):
                further = _middle(inside, outside)
                end = line.at(further)
                if abs(end - before) < near:
                    break
            assert further is not None  # without an approximation `outside` is known
            here, form = further, self._form(further)
        return end

    def _form(self, cost_weights: Array) -> LocalQuadratic | None:
        """Quadratic approximation elsewhere, noise of the fit; None if infeasible."""
        try:
            there = tangent(self.at.structure, self.at.problem, cost_weights, self.at.noise)
        except WeightsError:
            return None
        return None if there.reason else there.quadratic

    def _crossing(
        self, form: LocalQuadratic, line: _Line, here: Array, quantile: float
    ) -> tuple[bool, Array, float, Array]:
        """Whether D is above the quantile, its minimiser here, the crossing, and that there.

        Steps grow outwards if D is smaller here, else inwards, until they bracket the crossing.
        sqrt(D) is almost linear; each point starts from the nearest known one.
        """
        value = line.at(here)
        known = {line.value: line.cost_weights, value: here}

        @functools.cache  # a second search from another start may end elsewhere
        def excess(value: float) -> float:
            if value == line.value:
                return -float(np.sqrt(quantile))
            near = known[min(known, key=lambda other: abs(other - value))]
            distance, known[value] = self._distance(form, line.row, value, near)
            return float(np.sqrt(np.clip(distance, 0.0, _HUGE)) - np.sqrt(quantile))

        beyond = excess(value) > 0
        start, step = known[value], -line.step if beyond else line.step
        while beyond or abs(value - line.value) < _FARTHEST:
            further = value + step
            if beyond and (further - line.value) * line.step <= 0:
                further = line.value
            if (excess(further) > 0) != beyond:
                end = float(scipy.optimize.brentq(excess, value, further, xtol=_END * abs(step)))
                return beyond, start, end, known[min(known, key=lambda other: abs(other - end))]
            value, step = further, 1.6 * step
        return beyond, start, float(np.sign(line.step) * np.inf), known[value]

    def _distance(
        self, form: LocalQuadratic, row: Array, value: float, near: Array
    ) -> tuple[float, Array]:
        """D for white residuals with the combination fixed, and the minimiser."""
        moving = np.isfinite(near)
        own = row[moving]
        z = near.copy()
        z[moving] += (value - float(own @ near[moving])) / float(own @ own) * own
        best, there = form.least(z, scipy.linalg.null_space(own[None]))
        for index in np.flatnonzero(~moving[: len(self.at.structure.labels)]):
            # A zero cost weight may become positive when another is fixed elsewhere.
            other = z.copy()
            other[index] = self._smallest_seen(int(index))
            free = row[np.isfinite(other)]
            found, place = form.least(other, scipy.linalg.null_space(free[None]))
            if found < best:
                best, there = found, place
        return (best - self.base) / self.variance, there


class _Line(NamedTuple):
    """Combination of unknowns, unknowns and value at the fit, and a signed step."""

    row: Array
    cost_weights: Array
    value: float
    step: float

    def at(self, cost_weights: Array) -> float:
        """Value of the combination at other unknowns."""
        finite = np.isfinite(cost_weights)
        return float(self.row[finite] @ cost_weights[finite])


def _middle(one: Array, other: Array) -> Array:
    """Midpoint of two sets of unknowns; the first where either is infinite."""
    both = np.isfinite(one) & np.isfinite(other)
    return np.where(both, (one + np.where(both, other, 0.0)) / 2, one)
