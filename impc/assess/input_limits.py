"""The input limit of a subject, fitted: what value explains the recordings, or that none shows.

For a limit L the gain, initial states and parameters are fitted again; m(L) is the misfit that is
left, m(inf) that without a limit. With s^2 the variance of a residual and f the factor by which the
colour of the residuals widens the deviation of L (f = 1 for white ones),

    D(L) = (m(L)^2 - m(L*)^2) / (s^2 f)

is chi-squared with one degree of freedom at the true limit. Where D(inf) is below its quantile the
recordings do not identify whether there is a limit at all; they still say that it is not below the
least L that D allows (docs/fitting.md).
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
from impc.inverse.gain_search import refine_gain
from impc.inverse.noisy_fit import fit_controller
from impc.inverse.problem import controller_for, simulated
from impc.inverse.residuals import evaluate, residual_along
from impc.model.bounds import Bounds, bound_rows

if TYPE_CHECKING:
    from collections.abc import Callable

    from impc.inverse.estimates import Estimate
    from impc.inverse.gain_search import GainFit
    from impc.inverse.problem import Problem

# The limit is searched to this share of itself.
_RESOLUTION = 1e-4
# Growth of the steps towards an end of the interval, and how exact the end is, of the last step.
_GROWTH, _NEARLY = 2.0, 0.02
_GRID, _NEAR = np.geomspace(0.3, 1.05, 10), np.array([0.8, 0.9, 1.0, 1.1, 1.25])
_ROUNDS = 5


@dataclass(frozen=True)
class LimitEstimate(Frozen):
    """What recordings say of the limit of one input."""

    value: float | None  # The limit that fits best; None when none is determined
    low: float  # Interval of the given level; `high` is infinite when no limit is determined
    high: float
    level: float  # Between 0 and 1, 0.95 for 95 %
    # D(inf): how much worse no limit explains the recordings; compare with the quantile
    against_none: float
    quantile: float  # Of chi-squared at that level
    reason: str  # In words
    # Limits that were tried (t,), in the input's unit, and D at each (t,), for a picture
    limits: Array
    distances: Array


def with_limit(problem: Problem, limit: float, control: int = 0) -> Problem:
    """The problem with |u_control| <= limit, or without that bound for an infinite limit."""
    bounds = problem.bounds
    u_min, u_max = np.array(bounds.u_min), np.array(bounds.u_max)
    u_min[control], u_max[control] = -limit, limit
    changed = Bounds(
        problem.plant, x_min=bounds.x_min, x_max=bounds.x_max, u_min=u_min, u_max=u_max
    )
    return replace(problem, bounds=changed)


def input_limit(fitted: Estimate, control: int = 0) -> LimitEstimate:
    """Fit the symmetric limit of one input; the others keep theirs."""
    if not 0 <= control < fitted.problem.plant.m:
        raise InputError("control", f"got {control}", f"there are {fitted.problem.plant.m} inputs")
    search, best = _searched(fitted, control)
    free = search.fit(np.inf)
    top = max(_typical_peak(search.fitted, control), search.limit_of(best))
    noise = best.misfit**2 / search.samples
    factor = _colour_factor(best, search.limit_of(best), control)
    quantile = float(scipy.special.chdtri(1, 1 - LEVEL))
    unit = noise * factor

    def distance(limit: float) -> float:
        return (search.misfit(limit) ** 2 - search.least()[1].misfit ** 2) / unit

    for _ in range(_ROUNDS):  # on its way the profile may pass a better limit
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
            f"no limit explains the recordings as well as any: if there is one it is at least "
            f"{low:.3g}; the command of the best regulator without one peaks at {top:.3g}"
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


def _searched(fitted: Estimate, control: int) -> tuple[_Search, GainFit]:
    """The best limit, and the search that found it.

    The first round goes over a grid below the largest command that the best regulator without a
    limit uses. The limit found then gets a controller of its own, fitted from the beginning, from
    which the next round searches nearby: a gain fitted under a wrong limit is a poor start.
    """
    loose = fit_controller(with_limit(fitted.problem, np.inf, control))
    search = _Search(loose, control)
    peak = _typical_peak(loose, control)
    limit = search.limit_of(search.best(peak * _GRID))
    for _ in range(_ROUNDS):
        search = _Search(fit_controller(with_limit(fitted.problem, limit, control)), control)
        best = search.best(limit * _NEAR)
        before, limit = limit, search.limit_of(best)
        if abs(limit - before) < 0.01 * before:
            break
    return search, best


class _Search:
    """Fits at limits, remembered: each starts from the nearest one before it."""

    def __init__(self, fitted: Estimate, control: int) -> None:
        self.fitted, self.control = fitted, control
        self.samples = fitted.problem.recorded_numbers
        self.tried: dict[float, GainFit | None] = {}

    def fit(self, limit: float) -> GainFit:
        found = self._try(limit)
        if found is None:
            raise SolverError("limit", f"no gain holds with {limit:g}", "check plant and bounds")
        return found

    def misfit(self, limit: float) -> float:
        found = self._try(limit)
        return 1e3 * np.sqrt(self.samples) if found is None else found.misfit

    def best(self, grid: Array) -> GainFit:
        """The best of a grid, refined by Brent's method between its neighbours."""
        values = [self.misfit(limit) for limit in grid]
        index = int(np.argmin(values))
        ends = grid[max(index - 1, 0)], grid[min(index + 1, len(grid) - 1)]
        scipy.optimize.minimize_scalar(
            self.misfit, bounds=ends, method="bounded", options={"xatol": _RESOLUTION * ends[1]}
        )
        return self.least()[1]

    def least(self) -> tuple[float, GainFit]:
        """The best of all finite limits that were tried."""
        fits = [fit for fit in self.tried.values() if fit is not None]
        finite = [fit for fit in fits if np.isfinite(self.limit_of(fit))]
        if not finite:
            raise SolverError("limit", "no gain holds with any limit tried", "check the plant")
        best = min(finite, key=lambda fit: fit.misfit)
        return self.limit_of(best), best

    def limit_of(self, fit: GainFit) -> float:
        return float(fit.problem.bounds.u_max[self.control])

    def _try(self, limit: float) -> GainFit | None:
        if limit not in self.tried:
            self.tried[limit] = self._fit(limit)
        return self.tried[limit]

    def _fit(self, limit: float) -> GainFit | None:
        """From the nearest fit that holds, or from the given one."""
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
            except (SolverError, WeightsError):  # it falls with that limit; the next may not
                continue
        return None


def _typical_peak(fitted: Estimate, control: int) -> float:
    """What the command of the weights' regulator exceeds at one sample in two hundred."""
    runs = simulated(fitted.problem, fitted.gain, fitted.metric)
    command = np.concatenate([np.abs(run.applied[:, control]) for run in runs])
    return float(np.quantile(command, 0.995))


def _colour_factor(fit: GainFit, limit: float, control: int) -> float:
    """Variance of the limit for the colour that the residuals show, over that for white ones."""
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
    """Derivative of the residual with respect to the symmetric limit of one input (r,)."""
    controller = controller_for(problem, gain, metric)
    rows = bound_rows(controller.bounds, problem.plant)
    of_input = np.isclose(np.abs(rows.b), limit) & ~np.any(rows.E, axis=1)
    moves = np.abs(rows.F[:, control]) * of_input
    along = directions(controller, 1, bounds=moves[:, None])
    return residual_along(problem, controller, along)[:, 0]


def _crossing(
    distance: Callable[[float], float], inside: float, outside: float, quantile: float
) -> float:
    """Limit between two at which D passes the quantile; the outer one when it does not."""
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
