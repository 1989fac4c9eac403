"""Estimate the input limit, or report that the recordings do not reveal one.

For a limit L the gain, initial states and parameters are refitted; m(L) is the misfit, m(inf) that
without a limit. With the residual variance s^2 and the factor f by which autocorrelation widens the
variance of L (f = 1 for white residuals),

    D(L) = (m(L)^2 - m(L*)^2) / (s^2 f)

is chi-squared with one degree of freedom at the true limit. If D(inf) is below its quantile the
recordings do not identify whether there is a limit; they still give a lower end, the least L that D
allows.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.special

from impc.arrays import Array, Frozen, frozen
from impc.assess.assessments import simulated_vaf
from impc.assess.covariance import by_trial
from impc.assess.fit_curve import FitCurve
from impc.assess.long_run_covariance import residual_noise, spread_of_sum, white_noise
from impc.assess.printed_gain import LEVEL
from impc.checking import replace
from impc.errors import InputError
from impc.inverse.laws import GainLaw
from impc.inverse.noisy_fit import fit_controller
from impc.inverse.problem import simulated
from impc.inverse.residuals import along_bounds
from impc.inverse.search import refine_gain
from impc.inverse.unknowns import Unknowns, linear_at
from impc.model.bounds import Bounds, bound_rows

if TYPE_CHECKING:
    from impc.inverse.estimates import Estimate
    from impc.inverse.problem import Problem
    from impc.inverse.unknowns import Fitted

# Relative accuracy of the limit, also the first step towards an end of its interval.
_RESOLUTION = 1e-4
_GRID, _NEAR = np.geomspace(0.3, 1.05, 10), np.array([0.8, 0.9, 1.0, 1.1, 1.25])
# Largest number of rounds of limit and controller, and of evaluations of a point.
_ROUNDS, _EVALUATIONS = 5, 30
# Points of a curve for figures, relative to the limit of the fit, neighbours first. More
# evaluations change the unexplained variance by a tenth and take three times as long.
_SHARES, _FEW = (0.9, 0.75, 1.15, 1.5), 6


@dataclass(frozen=True)
class LimitEstimate(Frozen):
    """Estimate of the limit of one input."""

    value: float | None  # Limit that fits best; None if not identified
    low: float  # Interval; `high` is infinite if no limit is identified
    high: float
    level: float  # Confidence level between 0 and 1
    # D(inf): loss of fit without a limit; compare with `quantile`
    against_none: float
    quantile: float  # Chi-squared quantile at that level
    reason: str  # Result in words
    # Limits tried (t,), in the unit of the input, and D at each (t,), for figures
    limits: Array
    distances: Array


def with_limit(problem: Problem, limit: float, control: int = 0) -> Problem:
    """Problem with |u_control| <= limit, or without that bound for an infinite limit."""
    bounds = problem.bounds
    u_min, u_max = np.array(bounds.u_min), np.array(bounds.u_max)
    u_min[control], u_max[control] = -limit, limit
    changed = Bounds(
        problem.plant, x_min=bounds.x_min, x_max=bounds.x_max, u_min=u_min, u_max=u_max
    )
    return replace(problem, bounds=changed)


def input_limit(fitted: Estimate, control: int = 0) -> LimitEstimate:
    """Estimate the symmetric limit of one input; other limits stay fixed."""
    if not 0 <= control < fitted.problem.plant.m:
        raise InputError(
            "control",
            f"expected an index below {fitted.problem.plant.m}, got {control}",
            "choose an input of the plant",
        )
    curve, near = _searched(fitted, control)
    curve.at(np.inf)  # raises if nothing can be simulated without a limit
    best = curve.at(curve.best)
    top = max(_typical_peak(near, control), curve.best)
    unit = best.misfit**2 / near.problem.recorded_numbers * _colour_factor(best, control)
    quantile = float(scipy.special.chdtri(1, 1 - LEVEL))

    def sides(value: float) -> tuple[list[float], list[float]]:
        above = _towards(value, 1.5 * top) if curve.rise(np.inf) > quantile * unit else [np.inf]
        return _towards(value, 0.3 * value), above

    low, high = curve.ends(quantile * unit, sides, _RESOLUTION * curve.best)
    value, none = curve.best, curve.rise(np.inf) / unit
    determined = none > quantile
    if determined:
        reason = f"a limit of {value:.3g} explains the recordings better than none"
    else:
        reason = (
            f"the fit without a limit is not significantly worse; a limit, if there is one, is at "
            f"least {low:.3g}; without a limit the fitted command peaks at {top:.3g}"
        )
    return LimitEstimate(
        value if determined else None,
        low,
        high,
        LEVEL,
        none,
        quantile,
        reason,
        frozen(curve.finite),
        frozen([curve.rise(limit) / unit for limit in curve.finite]),
    )


def _towards(value: float, end: float) -> list[float]:
    """Values from one towards another, in steps that double."""
    steps = _RESOLUTION * value * (2.0 ** np.arange(1, 60) - 1)
    steps = steps[steps < abs(end - value)]
    return [*(value + np.sign(end - value) * steps).tolist(), end]


def _searched(fitted: Estimate, control: int) -> tuple[FitCurve, Estimate]:
    """Fits about the best limit, and the estimate at which they start.

    The search starts at the given limit, or if the command does not reach it at the best of a grid
    below the largest command. Each round searches near the last limit and refits the controller
    at the limit found, because a gain fitted under a wrong limit is a poor start.
    """

    def searched(near: Estimate, grid: Array) -> FitCurve:
        curve = _fits(near.problem, near.gain, near.metric, control, _EVALUATIONS)
        for limit in grid.tolist():
            curve.loss(limit)
        curve.refine(_RESOLUTION * curve.best)
        return curve

    limit, near = float(fitted.problem.bounds.u_max[control]), fitted
    peak = _typical_peak(fitted, control)
    if peak < (1 - 1e-6) * limit:
        limit = searched(near, peak * _GRID).best
        near = fit_controller(with_limit(fitted.problem, limit, control))
    for _ in range(_ROUNDS):
        curve = searched(near, limit * _NEAR)
        before, limit = limit, curve.best
        if abs(limit - before) < 0.01 * before:
            break
        near = fit_controller(with_limit(fitted.problem, limit, control))
    return curve, near


def _fits(problem: Problem, gain: Array, metric: Array, control: int, evaluations: int) -> FitCurve:
    """Fits at limits of one control."""

    def fit(limit: float, _near: float, start: Fitted) -> Fitted:
        posed, K, S = with_limit(start.problem, limit, control), start.K, start.S
        return refine_gain(posed, np.array(K), np.array(S), max_evaluations=evaluations, prior=1.0)

    space = Unknowns(problem, GainLaw(problem, np.array(gain), np.array(metric)))
    given = float(problem.bounds.u_max[control]), space.ended(space.start)
    return FitCurve(fit, given, lambda end: end.misfit**2)


def _typical_peak(fitted: Estimate, control: int) -> float:
    """99.5 % quantile of |command| under the fitted controller."""
    runs = simulated(fitted.problem, fitted.gain, fitted.metric)
    command = np.concatenate([np.abs(run.applied[:, control]) for run in runs])
    return float(np.quantile(command, 0.995))


def _colour_factor(fit: Fitted, control: int) -> float:
    """Variance of the limit for autocorrelated residuals, relative to white ones."""
    problem, K, S = fit.problem, np.array(fit.K), np.array(fit.S)
    law = GainLaw(problem, K, S)
    found = linear_at(problem, law, law.start)
    basis, _ = np.linalg.qr(found.parts(problem)[0][:, : K.size])
    column = on_limit(problem, K, S, float(problem.bounds.u_max[control]), control)
    column = column - basis @ (basis.T @ column)
    residuals, columns = by_trial(problem, found.residual), by_trial(problem, column[:, None])
    if not np.any(column):
        return 1.0
    coloured = spread_of_sum(residual_noise(residuals), columns)[0, 0]
    white = spread_of_sum(white_noise(residuals), columns)[0, 0]
    return float(max(coloured / white, 1.0)) if white > 0 else 1.0


def on_limit(problem: Problem, gain: Array, metric: Array, limit: float, control: int = 0) -> Array:
    """Derivative of the residual by the symmetric limit of one input (r,)."""
    rows = bound_rows(problem.bounds, problem.plant)
    of_input = np.isclose(np.abs(rows.b), limit) & ~np.any(rows.E, axis=1)
    moves = np.abs(rows.F[:, control]) * of_input
    return along_bounds(problem, gain, metric, moves[:, None])[:, 0]


@dataclass(frozen=True)
class LimitCurve(Frozen):
    """Unexplained variance against the limit of one control."""

    control: str
    given: float  # The limit of the fit
    limits: Array  # In the unit of the control (t,), ascending
    unexplained: Array  # 100 - VAF, % (t, p); NaN without a gain

    @property
    def left(self) -> Array:
        """Unexplained variance summed over outputs (t,); infinite without a gain."""
        return np.asarray(np.nan_to_num(self.unexplained, nan=np.inf).sum(axis=1))

    @property
    def best(self) -> int:
        """Index of the limit with the least unexplained variance."""
        return int(np.argmin(self.left))

    @property
    def own(self) -> int:
        """Index of the limit of the fit."""
        return int(np.argmin(np.abs(self.limits - self.given)))


def limit_curve(fitted: Estimate, control: int) -> LimitCurve | None:
    """Curve around a finite symmetric limit; None if there is none."""
    problem = fitted.problem.with_body_fixed()
    given = float(problem.bounds.u_max[control])
    if not np.isfinite(given) or problem.bounds.u_min[control] != -given or problem.plant.commands:
        return None
    curve = _fits(problem, fitted.gain, fitted.metric, control, _FEW)
    curve.tried[given] = curve.start[1]
    for share in _SHARES:
        curve.loss(share * given)
    unexplained = [_unexplained(curve.tried[limit], len(problem.plant.C)) for limit in curve.finite]
    name = problem.plant.controls[control]
    return LimitCurve(name, given, frozen(curve.finite), frozen(unexplained))


def _unexplained(found: Fitted | None, outputs: int) -> Array:
    """100 - VAF, % (p,); NaN if no gain stabilises with so low a limit."""
    if found is None:
        return np.full(outputs, np.nan)
    problem, K, S = found.problem, np.array(found.K), np.array(found.S)
    shares = simulated_vaf(problem.plant, problem.recordings, simulated(problem, K, S))
    return np.asarray(100 - shares)
