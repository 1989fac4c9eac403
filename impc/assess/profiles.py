"""Fits with one number fixed: their least loss F, its minimum and its rise.

The number, an entry of the gain, a physical parameter or the limit of an input, is fixed at v and
everything else (rest of the gain, initial states, other parameters) is refitted. With F(v) the
least -2 log posterior and the factor f >= 1 by which autocorrelation widens the variance of the
number,

    D(v) = (F(v) - F(v*)) / f

is chi-squared with one degree of freedom at the true value, and {v : D(v) <= q} is an interval that
need not be symmetric. Without an end the recordings do not identify the number.

An entry of K and a log-parameter are linear in the unknowns z (`GainLaw`), so that the search runs
in the null space of their row. Each fit starts from that at the nearest v.
"""

from __future__ import annotations

import contextlib
import itertools
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Generic, Protocol, TypeVar

import numpy as np
import scipy.linalg
import scipy.optimize
import scipy.special

from impc.arrays import Array
from impc.assess.covariance import GainCovariance, gain_covariance
from impc.assess.long_run_covariance import residual_noise, white_noise
from impc.assess.printed_gain import LEVEL, GainEstimate, Interval, entry_names
from impc.errors import InputError, SolverError, WeightsError
from impc.inverse.laws import GainLaw
from impc.inverse.minimiser import PROMISE, Stop
from impc.inverse.problem import Problem
from impc.inverse.unknowns import Fitted, Unknowns

#: Chi-squared quantile of one degree of freedom at the level of the intervals.
QUANTILE = float(scipy.special.chdtri(1, 1 - LEVEL))
# 1 / SD of a prior, far beyond any possible gain, that keeps free directions from drifting.
_WEAK = 1e-2
# Values tried on each side, in standard errors; if D stays low there is no end.
_STEPS = np.array([1.0, 2.0, 3.0, 5.0, 8.0, 12.0, 20.0, np.inf])
# Accuracy of the minimum in standard errors, and evaluations of a point.
_MINIMUM, _EVALUATIONS = 0.02, 40
# Accuracy of an end relative to the last step towards it; rounds until the minimum stays.
_END, _ROUNDS = 1e-3, 6
# Loss of a value that no gain can be simulated with; offset that stands for an infinite one, of the
# logarithm of a limit.
_FAILED, _FAR = 1e12, 7.0


def profile_likelihood(estimate: GainEstimate, name: str) -> Interval:
    """Interval of an entry of the gain (K.<control>.<state>) or a fitted parameter."""
    require_numbers(estimate, [name])
    names, given = entry_names(estimate.problem.plant), (estimate.problem, estimate.K, estimate.S)
    curve, (error, factor) = FitCurve(*given, name), standard_error(*given, name)
    curve.loss(0.0)

    def number(offset: float) -> float:
        if name in names:
            return float(estimate.K.ravel()[names.index(name)]) + offset
        value = estimate.parameters[estimate.problem.parameter_names.index(name)]
        return float(value * np.exp(offset)) if offset < 700 else np.inf

    def sides(offset: float) -> tuple[list[float], list[float]]:
        return (offset - error * _STEPS).tolist(), (offset + error * _STEPS).tolist()

    low, high = curve.ends(QUANTILE * factor, sides, _MINIMUM * error, error)
    return Interval(name, "profile", LEVEL, number(curve.best), number(low), number(high))


def require_numbers(estimate: GainEstimate, names: Sequence[str]) -> None:
    """Raise InputError unless each name is an entry of K or a fitted parameter."""
    known = [*entry_names(estimate.problem.plant), *estimate.problem.parameter_names]
    for name in names:
        if name not in known:
            said = f"choose from: {', '.join(known)}"
            raise InputError(f"profile of {name}", "no such entry or parameter", said)


def standard_error(problem: Problem, gain: Array, metric: Array, name: str) -> tuple[float, float]:
    """Standard error of a number, and its ratio squared f to that for white residuals, or 1."""
    entries = entry_names(problem.plant)

    def error(covariance: GainCovariance) -> float:
        if name in entries:
            return float(np.ravel(covariance.entries)[entries.index(name)])
        return float(covariance.parameters[problem.parameter_names.index(name)])

    given = problem, np.array(gain), np.array(metric)
    coloured, white = (
        error(gain_covariance(*given, noise, curvature=True))
        for noise in (residual_noise, white_noise)
    )
    if not (np.isfinite(coloured) and white > 0):
        return np.inf, 1.0
    return coloured, max((coloured / white) ** 2, 1.0)


class Fit(Protocol):
    """A fit with one number fixed."""

    @property
    def objective(self) -> float:
        """Least loss F."""


F = TypeVar("F", bound=Fit)


class Curve(ABC, Generic[F]):
    """Cached fits with one number at offsets from a start."""

    def __init__(self, start: F) -> None:
        self.start = 0.0, start
        self.tried: dict[float, F | None] = {}

    @abstractmethod
    def fit(self, value: float, near: tuple[float, F]) -> F | None:
        """Fit at a value, given another value with its fit; None if it cannot be simulated."""

    @property
    def finite(self) -> list[float]:
        """Finite values tried, ascending."""
        return sorted(value for value in self.tried if np.isfinite(value))

    @property
    def best(self) -> float:
        """Finite value with the least loss."""
        return min(self.finite, key=self.loss)

    def at(self, value: float) -> F:
        """Fit at a value; raises SolverError if it cannot be simulated."""
        found = self._at(value)
        if found is None:
            said = f"no stabilising gain can be simulated at {value:g}"
            raise SolverError("fit with a fixed number", said, "check the plant and the bounds")
        return found

    def loss(self, value: float) -> float:
        """F at a value."""
        found = self._at(value)
        return _FAILED if found is None else found.objective

    def rise(self, value: float) -> float:
        """F at a value above the least F."""
        return self.loss(value) - self.loss(self.best)

    def refine(self, accuracy: float, reach: float = 0.0) -> None:
        """Refine the minimum between the neighbours of the best value, or to `reach` beyond it."""
        values, best = self.finite, self.best
        below = max([value for value in values if value < best], default=best - reach)
        above = min([value for value in values if value > best], default=best + reach)
        if above - below > 3 * accuracy:
            scipy.optimize.minimize_scalar(
                self.loss, bounds=(below, above), method="bounded", options={"xatol": accuracy}
            )

    def ends(
        self,
        rise: float,
        sides: Callable[[float], Sequence[Sequence[float]]],
        accuracy: float,
        reach: float = 0.0,
    ) -> list[float]:
        """Values on each side of the minimum at which F has risen by `rise`.

        `sides` maps the minimum to the values to try on each side, outwards; without a rise the end
        is the last one, which may be infinite. A better minimum found on the way restarts this.
        """
        for _ in range(_ROUNDS):
            self.refine(accuracy, reach)
            origin = self.best
            found = [self.end(rise, [origin, *values]) for values in sides(origin)]
            if self.best == origin:
                break
        return found

    def end(self, rise: float, values: Sequence[float]) -> float:
        """Value at which F has risen by `rise`, between `values`; the last one without a rise."""

        def excess(value: float) -> float:  # the root of a rise is almost linear
            return float(np.sqrt(max(self.rise(value), 0.0)) - np.sqrt(rise))

        for inside, outside in itertools.pairwise(values):
            if np.isfinite(outside) and excess(outside) > 0:
                accuracy = _END * abs(outside - inside)
                return float(scipy.optimize.brentq(excess, inside, outside, xtol=accuracy))
        return values[-1]

    def _at(self, value: float) -> F | None:
        if value not in self.tried:
            known = [(other, fit) for other, fit in self.tried.items() if fit is not None]
            near = min(known, key=lambda one: abs(_far(one[0]) - _far(value)), default=self.start)
            self.tried[value] = self.fit(value, near) or self.fit(value, self.start)
        return self.tried[value]


class FitCurve(Curve["Fitted"]):
    """Fits with a number of a gain at offsets from its start; infinite offsets are far out."""

    def __init__(
        self,
        problem: Problem,
        gain: Array,
        metric: Array,
        name: str,
        evaluations: int = _EVALUATIONS,
    ) -> None:
        law = GainLaw(problem, np.array(gain), np.array(metric))
        self.space, row = Unknowns(problem, law), np.zeros(len(law.start) + len(problem.logarithms))
        entries = entry_names(problem.plant)
        if name in entries:
            row[: len(law.gains)] = law.gains.reshape(len(law.gains), -1)[:, entries.index(name)]
        else:
            index = problem.parameter_names.index(name)
            row[len(law.start) + index] = self.space.units[index]
        parts = np.split(row / float(row @ row), [len(law.start)])
        own = self.space.trials * self.space.own
        self.step = np.concatenate([parts[0], np.zeros(own), parts[1]])
        # Parameters stay columns of their own: the stated ones have a prior.
        first, last = np.flatnonzero(row)[[0, -1]] + [0, 1]
        null = scipy.linalg.null_space(row[None, first:last])
        self.along = scipy.linalg.block_diag(np.eye(first), null, np.eye(len(row) - last))
        self.stop = Stop(PROMISE, 0.0, evaluations)
        super().__init__(self.space.ended(self.space.start))

    def fit(self, value: float, near: tuple[float, Fitted]) -> Fitted | None:
        """Refit all else, from a nearby fit."""
        z = np.array(near[1].z) + (_far(value) - _far(near[0])) * self.step
        with contextlib.suppress(SolverError, WeightsError):  # it diverges from there
            return self.space.search(z, self.stop, shared=_WEAK, own=_WEAK, along=self.along)
        return None


def _far(offset: float) -> float:
    return _FAR if np.isinf(offset) else offset
