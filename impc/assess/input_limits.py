"""Estimate the input limit, or report that the recordings do not reveal one.

A limit is one more physical parameter, so that its interval is a profile likelihood (`profiles`).
If D without a limit is below its quantile, the recordings do not identify whether there is one;
they still give a lower end, the least limit that D allows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from impc.assess.profiles import QUANTILE, FitCurve, standard_error
from impc.checking import replace
from impc.errors import InputError
from impc.inverse.estimates import Estimate
from impc.inverse.further_unknowns import with_free_limit
from impc.inverse.noisy_fit import fit_controller
from impc.inverse.problem import Problem, simulated
from impc.model.bounds import Bounds
from impc.model.plant_family import LIMIT

# Largest number of rounds of limit and controller, and a change of the limit that ends them.
_ROUNDS, _STAYS = 5, 0.01
# Relative accuracy of the limit, also the first step towards an end of its interval.
_RESOLUTION = 1e-4
_NEAR = np.array([1.25, 1.1, 1.0, 0.9, 0.8])
# Limits tried first, relative to the largest command: without a limit a seated subject's fitted
# command peaks at 200 times the true one. Each gain follows the one before.
_GRID = np.geomspace(1.05, 0.003, 20)


@dataclass(frozen=True)
class LimitEstimate:
    """Estimate of the limit of one input."""

    value: float | None  # Limit that fits best; None if not identified
    low: float  # 95 % interval; `high` is infinite if no limit is identified
    high: float
    against_none: float  # D without a limit; compare with `profiles.QUANTILE`


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
    """Estimate the symmetric limit of one input; other limits stay fixed.

    The search starts at the given limit, or at the largest command if that does not reach it.
    """
    plant = fitted.problem.plant
    if not 0 <= control < plant.m:
        raise InputError(
            "control",
            f"expected an index below {plant.m}, got {control}",
            "choose an input of the plant",
        )
    given, peak = float(fitted.problem.bounds.u_max[control]), _typical_peak(fitted, control)
    grid, start = (_NEAR, given) if peak >= (1 - 1e-6) * given else (_GRID, peak)
    name = f"{LIMIT}.{plant.controls[control]}"
    for _ in range(_ROUNDS):
        problem = with_free_limit(fitted.problem, control, start)
        curve = FitCurve(problem, fitted.gain, fitted.metric, name)
        for offset in np.log(grid).tolist():
            curve.loss(offset)
            if curve.tried[offset] is None:  # nor is a lower limit feasible
                break
        curve.refine(_RESOLUTION)
        if abs(curve.best) < _STAYS or curve.rise(np.inf) < QUANTILE:
            break
        # A gain fitted under a wrong limit is a poor start.
        grid, start = _NEAR, float(start * np.exp(curve.best))
        fitted = fit_controller(with_limit(fitted.problem, start, control))
    curve.at(np.inf)  # raises if nothing can be simulated without a limit
    best, top = (
        curve.at(curve.best),
        max(np.log(_typical_peak(fitted, control) / start), curve.best),
    )
    factor = standard_error(best.problem, best.K, best.S, name)[1]

    def sides(offset: float) -> tuple[list[float], list[float]]:
        known = curve.rise(np.inf) > QUANTILE * factor
        above = _outwards(offset, top + np.log(1.5)) if known else [np.inf]
        return _outwards(offset, offset + np.log(0.3)), above

    low, high = curve.ends(QUANTILE * factor, sides, _RESOLUTION, float(np.log(_NEAR[0])))
    none, ends = curve.rise(np.inf) / factor, [float(start * np.exp(end)) for end in (low, high)]
    value = float(start * np.exp(curve.best)) if none > QUANTILE else None
    return LimitEstimate(value, ends[0], ends[1], none)


def _outwards(offset: float, end: float) -> list[float]:
    """Offsets towards an end, in steps that double."""
    steps = _RESOLUTION * (2.0 ** np.arange(1, 60) - 1)
    steps = steps[steps < abs(end - offset)]
    return [*(offset + np.sign(end - offset) * steps).tolist(), end]


def _typical_peak(fitted: Estimate, control: int) -> float:
    """99.5 % quantile of |command| under the fitted controller."""
    runs = simulated(fitted.problem, fitted.gain, fitted.metric)
    command = np.concatenate([np.abs(run.applied[:, control]) for run in runs])
    return float(np.quantile(command, 0.995))
