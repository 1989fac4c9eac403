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
import scipy.optimize
import scipy.special

from impc.arrays import Array, Frozen, frozen
from impc.assess.covariance import by_trial
from impc.assess.long_run_covariance import residual_noise, spread_of_sum, white_noise
from impc.assess.printed_gain import LEVEL
from impc.checking import replace
from impc.control.constraint_rows import directions
from impc.errors import InputError, SolverError, WeightsError
from impc.inverse.noisy_fit import fit_controller
from impc.inverse.problem import controller_for, simulated
from impc.inverse.residuals import evaluate, residual_along
from impc.inverse.search import refine_gain
from impc.model.bounds import Bounds, bound_rows

if TYPE_CHECKING:
    from collections.abc import Callable

    from impc.inverse.estimates import Estimate
    from impc.inverse.problem import Problem
    from impc.inverse.unknowns import Fitted

# Relative accuracy of the limit.
_RESOLUTION = 1e-4
# Growth of the steps towards an end, and accuracy of the end relative to the last step.
_GROWTH, _NEARLY = 2.0, 0.02
_GRID, _NEAR = np.geomspace(0.3, 1.05, 10), np.array([0.8, 0.9, 1.0, 1.1, 1.25])
_ROUNDS = 5


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
    search, best = _searched(fitted, control)
    free = search.fit(np.inf)
    top = max(_typical_peak(search.fitted, control), search.limit_of(best))
    noise = best.misfit**2 / search.samples
    factor = _colour_factor(best, search.limit_of(best), control)
    quantile = float(scipy.special.chdtri(1, 1 - LEVEL))
    unit = noise * factor

    def distance(limit: float) -> float:
        return (search.misfit(limit) ** 2 - search.least()[1].misfit ** 2) / unit

    for _ in range(_ROUNDS):  # the profile may find a better limit
        value, best = search.least()
        none = (free.misfit**2 - best.misfit**2) / unit
        determined = none > quantile
        low = _crossing(distance, value, 0.3 * value, quantile)
        high = _crossing(distance, value, 1.5 * top, quantile) if determined else np.inf
        if search.least()[0] == value:
            break
    limits = np.array(sorted(key for key in search.tried if np.isfinite(key)))
    distances = np.array([distance(limit) for limit in limits])
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
        float(high),
        LEVEL,
        none,
        quantile,
        reason,
        frozen(limits),
        frozen(distances),
    )


def _searched(fitted: Estimate, control: int) -> tuple[_Search, Fitted]:
    """Best limit, and the search that found it.

    The search starts at the given limit, or if the command does not reach it at the best of a grid
    below the largest command. Each round searches near the last limit and refits the controller
    at the limit found, because a gain fitted under a wrong limit is a poor start.
    """
    limit, near = float(fitted.problem.bounds.u_max[control]), fitted
    peak = _typical_peak(fitted, control)
    if peak < (1 - 1e-6) * limit:
        search = _Search(fitted, control)
        limit = search.limit_of(search.best(peak * _GRID))
        near = fit_controller(with_limit(fitted.problem, limit, control))
    for _ in range(_ROUNDS):
        search = _Search(near, control)
        best = search.best(limit * _NEAR)
        before, limit = limit, search.limit_of(best)
        if abs(limit - before) < 0.01 * before:
            break
        near = fit_controller(with_limit(fitted.problem, limit, control))
    return search, best


class _Search:
    """Cached fits at limits; each starts from the nearest previous one."""

    def __init__(self, fitted: Estimate, control: int) -> None:
        self.fitted, self.control = fitted, control
        self.samples = fitted.problem.recorded_numbers
        self.tried: dict[float, Fitted | None] = {}

    def fit(self, limit: float) -> Fitted:
        found = self._try(limit)
        if found is None:
            raise SolverError(
                "limit",
                f"no stabilising gain found with the limit {limit:g}",
                "check plant and bounds",
            )
        return found

    def misfit(self, limit: float) -> float:
        found = self._try(limit)
        return 1e3 * np.sqrt(self.samples) if found is None else found.misfit

    def best(self, grid: Array) -> Fitted:
        """Best of a grid, refined by Brent's method between its neighbours."""
        values = [self.misfit(limit) for limit in grid]
        index = int(np.argmin(values))
        ends = grid[max(index - 1, 0)], grid[min(index + 1, len(grid) - 1)]
        scipy.optimize.minimize_scalar(
            self.misfit, bounds=ends, method="bounded", options={"xatol": _RESOLUTION * ends[1]}
        )
        return self.least()[1]

    def least(self) -> tuple[float, Fitted]:
        """Best of all finite limits tried."""
        fits = [fit for fit in self.tried.values() if fit is not None]
        finite = [fit for fit in fits if np.isfinite(self.limit_of(fit))]
        if not finite:
            raise SolverError(
                "limit", "no stabilising gain found with any limit tried", "check the plant"
            )
        best = min(finite, key=lambda fit: fit.misfit)
        return self.limit_of(best), best

    def limit_of(self, fit: Fitted) -> float:
        return float(fit.problem.bounds.u_max[self.control])

    def _try(self, limit: float) -> Fitted | None:
        if limit not in self.tried:
            self.tried[limit] = self._fit(limit)
        return self.tried[limit]

    def _fit(self, limit: float) -> Fitted | None:
        """Refit from the nearest previous fit, or from the given one."""
        known = [(key, fit) for key, fit in self.tried.items() if fit is not None]
        near = sorted(known, key=lambda item: abs(min(item[0], 1e9) - min(limit, 1e9)))
        starts = [(np.array(fit.K), np.array(fit.S), fit.problem) for _, fit in near[:1]]
        own = np.array(self.fitted.gain), np.array(self.fitted.metric)
        starts.append((*own, self.fitted.problem))
        for K, metric, problem in starts:
            try:
                return refine_gain(
                    with_limit(problem, limit, self.control),
                    K,
                    metric,
                    max_evaluations=30,
                    prior=1.0,
                )
            except (SolverError, WeightsError):  # diverges with that limit; try the next start
                continue
        return None


def _typical_peak(fitted: Estimate, control: int) -> float:
    """99.5 % quantile of |command| under the fitted controller."""
    runs = simulated(fitted.problem, fitted.gain, fitted.metric)
    command = np.concatenate([np.abs(run.applied[:, control]) for run in runs])
    return float(np.quantile(command, 0.995))


def _colour_factor(fit: Fitted, limit: float, control: int) -> float:
    """Variance of the limit for autocorrelated residuals, relative to white ones."""
    problem, K, S = fit.problem, np.array(fit.K), np.array(fit.S)
    found = evaluate(problem, K, S)
    others = found.dK.reshape(len(found.residual), -1)
    basis, _ = np.linalg.qr(others)
    column = on_limit(problem, K, S, limit, control)
    column = column - basis @ (basis.T @ column)
    residuals, columns = by_trial(problem, found.residual), by_trial(problem, column[:, None])
    if not np.any(column):
        return 1.0
    coloured = spread_of_sum(residual_noise(residuals), columns)[0, 0]
    white = spread_of_sum(white_noise(residuals), columns)[0, 0]
    return float(max(coloured / white, 1.0)) if white > 0 else 1.0


def on_limit(problem: Problem, gain: Array, metric: Array, limit: float, control: int = 0) -> Array:
    """Derivative of the residual by the symmetric limit of one input (r,)."""
    controller = controller_for(problem, gain, metric)
    rows = bound_rows(controller.bounds, problem.plant)
    of_input = np.isclose(np.abs(rows.b), limit) & ~np.any(rows.E, axis=1)
    moves = np.abs(rows.F[:, control]) * of_input
    along = directions(controller, 1, bounds=moves[:, None])
    return residual_along(problem, controller, along)[:, 0]


def _crossing(
    distance: Callable[[float], float], inside: float, outside: float, quantile: float
) -> float:
    """Limit between two at which D crosses the quantile; the outer one if it does not."""
    step = _RESOLUTION * inside
    while step < abs(outside - inside):
        there = inside + np.sign(outside - inside) * step
        if distance(there) > quantile:
            outside = there
            break
        inside, step = there, _GROWTH * step
    if distance(outside) <= quantile:
        return outside
    width = abs(outside - inside)
    found = scipy.optimize.brentq(
        lambda limit: distance(limit) - quantile, inside, outside, xtol=_NEARLY * width
    )
    return float(found)
