"""Profile-likelihood intervals of cost weights and of their ratios.

With a combination a'z of the unknowns fixed at v, all other cost weights are refitted: in the
quadratic approximation of the misfit near the fit, then in that near the end. With the least misfit
m(v),

    D(v) = (m^2(v) - m^2(v*)) / (s^2 f),

s^2 the residual variance and f the factor by which autocorrelation widens the variance of a'z. The
interval is {v : D(v) <= q}, q a chi-squared quantile. Without a lower end the cost weight may be
zero, and the statement is "at most" (docs/howto/weights.md).

The recordings identify a gain; the nonlinear part is the map from cost weights to gains. Near a fit
the misfit is therefore a quadratic form of gain and metric, computed from one simulation,

    m^2(z) = |q + R (k(z) - k)|^2 + rest,       k = (G^-1 K T, S),

R and q the triangular factor and residual in the columns of k after projection on initial states
and parameters (to first order); `rest` is the part that no nearby gain explains.
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
from impc.inverse.residuals import scaled_changes
from impc.inverse.solution_set import natural_coordinates
from impc.inverse.structured_search import regulator_slopes
from impc.model.riccati import solve_lqr

if TYPE_CHECKING:
    from impc.assess.structured_weights import Tangent, WeightCovariance
    from impc.model.riccati import LqrSolution

# Prior SD of a log cost weight about the fit: far wider than any finite interval.
_SPREAD = 20.0
_TRIES = 30


class NearFit:
    """Quadratic approximation of the misfit near a fit."""

    def __init__(self, at: Tangent) -> None:
        self.at = at
        size, m = len(at.residual), at.problem.plant.m
        # Whitened units of the gain: best conditioned.
        T, G = natural_coordinates(at.problem.plant, np.array(at.solution.K))
        self.right, self.left = T, np.linalg.inv(G)
        units = np.eye(at.solution.K.size).reshape(-1, *at.solution.K.shape)
        unit = np.linalg.inv(self._natural(units).reshape(len(units), -1))
        columns = [at.found.dK.reshape(size, -1) @ unit.T]
        columns += [at.found.dS.reshape(size, -1)] if m > 1 else []
        seen = at.without_nuisance(np.hstack(columns))
        self.triangle: Array = np.asarray(np.linalg.qr(seen, mode="r"), dtype=np.float64)
        self.here = self._place(at.solution)
        # R'q = columns' residual.
        residual = at.without_nuisance(np.array(at.residual)[:, None])[:, 0]
        self.inside = np.linalg.pinv(self.triangle.T) @ (seen.T @ residual)
        self.rest = float(residual @ residual - self.inside @ self.inside)

    def least(self, z: Array, along: Array, aim: LqrSolution | None = None) -> tuple[float, Array]:
        """Least m^2 from z over steps along columns, and its minimiser."""
        moving = np.isfinite(z)
        offset, rest = self.inside, self.rest
        if aim is not None:
            offset, rest = self.triangle @ (self.here - self._place(aim)), 0.0
        weight = self.at.noise / _SPREAD
        kept: dict[bytes, tuple[Array, Array]] = {}

        def seen(step: Array) -> tuple[Array, Array]:
            key = step.tobytes()
            if key not in kept:
                kept.clear()
                value, slopes = self._form(_moved(z, moving, along @ step), moving)
                kept[key] = offset + value, slopes @ along
            return kept[key]

        def residual(step: Array) -> Array:
            try:
                return np.concatenate([seen(step)[0], weight * step])
            except WeightsError:
                return np.full(len(self.triangle) + len(step), 1e6 * self.at.noise)

        def derivative(step: Array) -> Array:
            try:
                slopes = seen(step)[1]
            except WeightsError:  # only at the start: the search ends there
                slopes = np.zeros((len(self.triangle), along.shape[1]))
            return np.vstack([slopes, weight * np.eye(along.shape[1])])

        step: Array = np.zeros(along.shape[1])
        if len(step):
            step = scipy.optimize.least_squares(
                residual, step, jac=derivative, ftol=1e-6, max_nfev=_TRIES
            ).x
        data = residual(step)[: len(self.triangle)]
        return float(data @ data) + rest, _moved(z, moving, along @ step)

    def _natural(self, gains: Array) -> Array:
        """G^-1 K T (..., m, n) of gains K (..., m, n)."""
        return np.asarray(self.left @ gains @ self.right)

    def _place(self, solution: LqrSolution) -> Array:
        """k of a regulator."""
        gain = self._natural(np.array(solution.K)).ravel()
        if solution.plant.m == 1:
            return np.asarray(gain)
        S = np.array(solution.S)
        return np.concatenate([gain, (S * len(S) / np.trace(S)).ravel()])

    def _form(self, z: Array, moving: Array) -> tuple[Array, Array]:
        """R (k(z) - k) and its derivative by the free unknowns."""
        problem, structure = self.at.problem.with_nuisance_fixed(), self.at.structure
        solution = solve_lqr(problem.plant, structure.weights(z))
        dK, dS = regulator_slopes(problem, structure, z, solution)
        slopes = self._natural(dK[moving]).reshape(int(np.sum(moving)), -1)
        if problem.plant.m > 1:
            turned = scaled_changes(np.array(solution.S), dS[moving])
            slopes = np.hstack([slopes, turned.reshape(len(slopes), -1)])
        return self.triangle @ (self._place(solution) - self.here), self.triangle @ slopes.T


def _moved(z: Array, moving: Array, step: Array) -> Array:
    there = z.copy()
    there[moving.astype(bool)] += step
    return there


# Largest log cost weight searched: beyond a factor of e^12 the interval has no end.
_FARTHEST = 12.0
# Accuracy of an end, relative to the step.
_END = 1e-2
# Accept an end if refitting there moves it by less than this share of a standard error.
_STAYS, _ROUNDS = 0.05, 12
# D without a Riccati solution.
_HUGE = 1e12


@dataclass(frozen=True)
class WeightInterval:
    """Interval of a log cost weight or of the log ratio of two."""

    value: float  # Logarithm at the fit; minus infinity: cost weight zero
    # Ends of the logarithm; minus infinity if the cost weight may be zero
    low: float
    high: float
    level: float  # Confidence level between 0 and 1

    def holds(self, value: float) -> bool:
        """Whether a logarithm `value` lies in the interval."""
        return self.low <= value <= self.high


class WeightProfiles:
    """Profile-likelihood intervals from quadratic approximations at the fit and at each end."""

    def __init__(self, at: Tangent, covariance: WeightCovariance) -> None:
        self.at, self.covariance, self.near = at, covariance, NearFit(at)
        samples = len(at.residual)
        self.variance = at.noise**2 * samples / max(samples - covariance.rank, 1)
        self.base = self.near.least(np.array(at.cost_weights), np.eye(int(np.sum(at.moving))))[0]

    def interval(self, combination: Array, level: float = LEVEL) -> WeightInterval:
        """Interval of a'z for a `combination` a (count,)."""
        deviation, wider = self.covariance.spread(combination)
        quantile = float(scipy.stats.chi2.ppf(level, 1)) * wider**2
        moving, cost_weights = self.at.moving, np.array(self.at.cost_weights)
        value = float(combination[moving] @ cost_weights[moving])
        if not np.isfinite(deviation):
            return WeightInterval(value, -np.inf, np.inf, level)
        step = min(max(deviation, 1e-9), 1.0)
        low, high = (
            self._end(_Line(combination, cost_weights, value, sign * step), quantile)
            for sign in (-1.0, 1.0)
        )
        return WeightInterval(value, low, high, level)

    def zero(self, index: int, level: float = LEVEL) -> WeightInterval:
        """Interval of a cost weight `index` that is zero at the fit: only an upper end."""
        near = np.array(self.at.cost_weights)
        near[index] = self._smallest_seen(index)
        line = _Line(np.eye(len(near))[index], near, float(near[index]), 0.5)
        high = self._end(line, float(scipy.stats.chi2.ppf(level, 1)))
        return WeightInterval(-np.inf, -np.inf, high, level)

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
        near, inside, outside = _STAYS * abs(line.step), line.cost_weights, None
        end, there = self._passing(self.near, line, line.cost_weights, quantile)
        for _ in range(_ROUNDS):
            before, form = end, self._form(there)
            more, further = True, None
            if form is not None:
                distance, there = self._distance(form, line.row, line.at(there), there)
                more = distance > quantile
                end, further = self._passing(form, line, there, quantile)
                if end == before or abs(end - before) < near:
                    break
            inside, outside = (inside, there) if more else (there, outside)
            if further is None or not line.between(inside, end, outside):
                assert outside is not None
                further = _middle(inside, outside)
                end = line.at(further)
                if abs(end - before) < near:
                    break
            there = further
        return end

    def _form(self, cost_weights: Array) -> NearFit | None:
        """Quadratic approximation elsewhere, noise of the fit; None if infeasible."""
        try:
            at = self.at
            there = tangent(at.structure, at.problem, cost_weights, at.noise)
        except WeightsError:
            return None
        if there.found.reason:
            return None
        return NearFit(there)

    def _passing(
        self, form: NearFit, line: _Line, here: Array, quantile: float
    ) -> tuple[float, Array]:
        """Crossing of D and the quantile for one approximation, bracketed by growing steps.

        Outwards if D is smaller at the starting point, else inwards. sqrt(D) is almost linear; each
        point starts from the nearest known one.
        """
        known = {line.value: line.cost_weights, line.at(here): here}

        @functools.cache  # a second search from another start may end elsewhere
        def excess(value: float) -> float:
            if value == line.value:
                return -float(np.sqrt(quantile))
            near = known[min(known, key=lambda other: abs(other - value))]
            distance, known[value] = self._distance(form, line.row, value, near)
            return float(np.sqrt(np.clip(distance, 0.0, _HUGE)) - np.sqrt(quantile))

        value = line.at(here)
        outwards = excess(value) <= 0
        step = line.step if outwards else -line.step
        while not outwards or abs(value - line.value) < _FARTHEST:
            beyond = value + step
            if not outwards and (beyond - line.value) * line.step <= 0:
                beyond = line.value
            if (excess(beyond) > 0) == outwards:
                end = float(scipy.optimize.brentq(excess, value, beyond, xtol=_END * abs(step)))
                return end, known[min(known, key=lambda other: abs(other - end))]
            value, step = beyond, 1.6 * step
        return float(np.sign(line.step) * np.inf), known[value]

    def _distance(
        self, form: NearFit, row: Array, value: float, near: Array
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

    def between(self, inside: Array, value: float, outside: Array | None) -> bool:
        """Whether a value lies between those of two points (or beyond `inside`)."""
        side = np.sign(self.step)
        nearest = side * self.at(inside) <= side * value
        return bool(nearest and (outside is None or side * value < side * self.at(outside)))


def _middle(one: Array, other: Array) -> Array:
    """Midpoint of two sets of unknowns; the first where either is infinite."""
    both = np.isfinite(one) & np.isfinite(other)
    return np.where(both, (one + np.where(both, other, 0.0)) / 2, one)
