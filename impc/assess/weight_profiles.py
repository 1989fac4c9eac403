"""Profile-likelihood intervals of cost weights and of their ratios.

The recordings identify a gain; the nonlinear part is the map from cost weights to gains. Near a fit
the misfit is therefore a quadratic form of gain and metric, computed from one simulation,

    m^2(z) = |q + R (k(z) - k)|^2 + rest,       k = (K, S),

R and q the triangular factor and residual in the columns of k after projection on initial states
and parameters (to first order); `rest` is the part that no nearby gain explains.

With a combination a'z of the unknowns fixed at v, all other cost weights are refitted: in the form
of the nearest fit, then in that at its end, until it stays. With the least misfit m(v),

    D(v) = (m^2(v) - m^2(v*)) / (s^2 f),

s^2 the residual variance and f the factor by which autocorrelation widens the variance of a'z. The
interval is {v : D(v) <= q}, q a chi-squared quantile. Without a lower end the cost weight may be
zero, and the statement is "at most" (docs/howto/weights.md).
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy.linalg
import scipy.optimize

from impc.arrays import Array
from impc.assess.profiles import QUANTILE, Curve
from impc.assess.structured_weights import Tangent, WeightCovariance, tangent
from impc.errors import WeightsError
from impc.inverse.laws import regulator_slopes
from impc.inverse.residuals import scaled_changes
from impc.model.riccati import solve_lqr

# Prior SD of a log cost weight about the fit: far wider than any finite interval.
_SPREAD, _TRIES = 20.0, 30
# Largest change of a log cost weight that is tried: beyond a factor of e^12 there is no end.
_FARTHEST = 12.0
# A fit has converged where it falls short of its form by this share of D; largest number of forms.
_STAYS, _ROUNDS = 0.02, 8


class LocalQuadratic:
    """Quadratic form of gain and metric that approximates the misfit near a tangent."""

    def __init__(self, at: Tangent) -> None:
        self.structure, self.problem = at.structure, at.problem.with_nuisance_fixed()
        self.noise, self.law, self.here = at.noise, at.law, at.solution
        seen = at.without_nuisance(np.array(at.on_law))
        residual = at.without_nuisance(np.array(at.residual)[:, None])[:, 0]
        self.triangle: Array = np.asarray(np.linalg.qr(seen, mode="r"), dtype=np.float64)
        # R'q = columns' residual.
        self.inside = np.linalg.pinv(self.triangle.T) @ (seen.T @ residual)
        self.rest = float(residual @ residual - self.inside @ self.inside)

    def least(self, z: Array, along: Array) -> tuple[float, Array]:
        """Least m^2 from z over steps along columns, and its minimiser."""
        moving, weight, rows = np.isfinite(z), self.noise / _SPREAD, len(self.triangle)

        def moved(step: Array) -> Array:
            there = z.copy()
            there[moving] += along @ step
            return there

        @functools.lru_cache(maxsize=1)  # scipy asks for residual and derivative separately
        def seen(numbers: tuple[float, ...]) -> tuple[Array, Array]:
            step = np.array(numbers)
            prior = weight * np.eye(len(step))
            try:
                value, slopes = self._form(moved(step), moving)
            except WeightsError:  # a derivative is used only at the start: the search ends there
                far = np.full(rows + len(step), 1e6 * self.noise)
                return far, np.vstack([np.zeros((rows, len(step))), prior])
            return np.append(self.inside + value, weight * step), np.vstack([slopes @ along, prior])

        def residual(step: Array) -> Array:
            return seen(tuple(step))[0]

        def derivative(step: Array) -> Array:
            return seen(tuple(step))[1]

        step: Array = np.zeros(along.shape[1])
        if len(step):
            step = scipy.optimize.least_squares(
                residual, step, jac=derivative, ftol=1e-6, max_nfev=_TRIES
            ).x
        data = residual(step)[:rows]
        return float(data @ data) + self.rest, moved(step)

    def _form(self, z: Array, moving: Array) -> tuple[Array, Array]:
        """R (k(z) - k) and its derivative by the free unknowns."""
        structure, S = self.structure, np.array(self.here.S)
        solution = solve_lqr(self.problem.plant, structure.weights(z))
        dK, dS = regulator_slopes(self.problem, structure, z, solution)
        # Metrics at the scale of that of the fit.
        own = np.array(solution.S)
        away = self.law.along(
            (solution.K - self.here.K)[None], (np.trace(S) / np.trace(own) * own - S)[None]
        )[0]
        turned = np.trace(S) / len(S) * scaled_changes(own, dS[moving])
        return self.triangle @ away, self.triangle @ self.law.along(dK[moving], turned).T


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
    """Profile-likelihood intervals of the unknowns of a structure."""

    def __init__(self, at: Tangent, covariance: WeightCovariance) -> None:
        self.at, self.covariance, self.form = at, covariance, LocalQuadratic(at)
        samples, every = at.problem.recorded_numbers, np.eye(int(np.sum(at.moving)))
        self.variance = at.noise**2 * samples / max(samples - covariance.rank, 1)
        self.base = self.form.least(np.array(at.cost_weights), every)[0] / self.variance

    def interval(self, combination: Array) -> WeightInterval:
        """Interval of a'z for a `combination` a (count,)."""
        deviation, wider = self.covariance.spread(combination)
        moving, cost_weights = self.at.moving, np.array(self.at.cost_weights)
        value = float(combination[moving] @ cost_weights[moving])
        if not np.isfinite(deviation):
            return WeightInterval(value, -np.inf, np.inf)
        curve, step = _Curve(self, combination, cost_weights), min(max(deviation, 1e-9), 1.0)
        low, high = (curve.outwards(side * step, wider) for side in (-1.0, 1.0))
        return WeightInterval(value, value + low, value + high)

    def zero(self, index: int) -> WeightInterval:
        """Interval of a cost weight `index` that is zero at the fit: only an upper end."""
        near = np.array(self.at.cost_weights)
        near[index] = self.smallest_seen(index)
        end = _Curve(self, np.eye(len(near))[index], near).outwards(0.5, 1.0)
        return WeightInterval(-np.inf, -np.inf, near[index] + end)

    def unknowns(self) -> tuple[WeightInterval, ...]:
        """Interval of each unknown; a normal one if products of features have cost weights."""
        structure, found = self.at.structure, self.covariance
        if structure.coupled or structure.input_coupled:
            half = np.sqrt(QUANTILE) * found.each
            ends = np.column_stack([found.values, found.values - half, found.values + half])
            return tuple(WeightInterval(*one) for one in ends.tolist())
        rows = enumerate(zip(np.eye(structure.count), self.at.moving, strict=True))
        return tuple(
            self.interval(row) if moving else self.zero(index) for index, (row, moving) in rows
        )

    def smallest_seen(self, index: int) -> float:
        """Log cost weight that moves the outputs by a tenth of a noise SD."""
        column = self.at.without_nuisance(np.array(self.at.on_cost_weights[:, index])[:, None])
        size = max(float(np.linalg.norm(column)), 1e-300)
        return float(np.log(0.1 * self.at.noise / size))


class _Point(NamedTuple):
    """Fit with a combination of unknowns fixed."""

    objective: float  # m^2 over the residual variance
    z: Array  # Unknowns (count,)
    form: LocalQuadratic  # Near these


class _Curve(Curve[_Point]):
    """Fits with a combination `row` (count,) at offsets from that of `cost_weights` (count,)."""

    def __init__(self, profiles: WeightProfiles, row: Array, cost_weights: Array) -> None:
        super().__init__(_Point(profiles.base, cost_weights, profiles.form))
        self.profiles, self.row, self.tried = profiles, row, dict([self.start])

    def outwards(self, step: float, wider: float) -> float:
        """Offset of the end on one side, from a first `step`; standard errors `wider` by f."""
        steps = step * np.cumsum(1.6 ** np.arange(60))
        offsets = [0.0, *steps[np.abs(steps) < _FARTHEST].tolist(), float(step * np.inf)]
        return self.end(QUANTILE * wider**2, offsets)

    def fit(self, value: float, near: tuple[float, _Point]) -> _Point | None:
        """Refit all else in the form of a nearby fit, then in that at the end, until it stays."""
        offset, point = near
        moving, at = np.isfinite(point.z), self.profiles.at
        own, z = self.row[moving], point.z.copy()
        z[moving] += (value - offset) / float(own @ own) * own
        form, variance, best = point.form, self.profiles.variance, None
        for _ in range(_ROUNDS):
            predicted, z = self._least(form, z)
            try:
                there = tangent(at.structure, at.problem, z, at.noise)
            except WeightsError:
                break
            if there.reason:
                break
            form = LocalQuadratic(there)
            least = form.least(z, np.zeros((int(np.sum(np.isfinite(z))), 0)))[0] / variance
            if best is not None and least > best.objective:
                break
            best = _Point(least, z, form)
            if least - predicted / variance <= _STAYS * (QUANTILE + least):
                break
        return best

    def _least(self, form: LocalQuadratic, z: Array) -> tuple[float, Array]:
        """Least m^2 with the combination as at z (count,), and its minimiser."""
        found = [form.least(z, scipy.linalg.null_space(self.row[np.isfinite(z)][None]))]
        for index in np.flatnonzero(~np.isfinite(z[: len(form.structure.labels)])):
            # A zero cost weight may become positive when another is fixed elsewhere.
            other = z.copy()
            other[index] = self.profiles.smallest_seen(int(index))
            free = self.row[np.isfinite(other)]
            found.append(form.least(other, scipy.linalg.null_space(free[None])))
        return min(found, key=lambda one: one[0])
