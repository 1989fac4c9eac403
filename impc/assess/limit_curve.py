"""Unexplained variance as a function of the command limit, gain refitted at each point."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Array, Frozen, frozen
from impc.assess.input_limits import with_limit
from impc.assess.variance_accounted_for import vaf
from impc.errors import SolverError, WeightsError
from impc.inverse.problem import simulated
from impc.inverse.search import refine_gain

if TYPE_CHECKING:
    from impc.inverse.estimates import Estimate
    from impc.inverse.problem import Problem

# Limits relative to that of the fit; each fit starts from its neighbour.
_BELOW, _ABOVE = (0.9, 0.75), (1.15, 1.5)
# More evaluations change the unexplained variance by a tenth and take three times as long.
_EVALUATIONS = 6


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
    limit = float(problem.bounds.u_max[control])
    if not np.isfinite(limit) or problem.bounds.u_min[control] != -limit or problem.plant.commands:
        return None
    start = problem, np.array(fitted.gain), np.array(fitted.metric)
    points = {limit: _unexplained(*start)}
    for side in (_BELOW, _ABOVE):
        here = start
        for share in side:
            try:
                found = refine_gain(
                    with_limit(here[0], share * limit, control),
                    *here[1:],
                    max_evaluations=_EVALUATIONS,
                    prior=1.0,
                )
            except (SolverError, WeightsError):  # no stabilising gain with so low a limit
                points[share * limit] = np.full(len(problem.plant.outputs), np.nan)
                break
            here = found.problem, np.array(found.K), np.array(found.S)
            points[share * limit] = _unexplained(*here)
    limits = sorted(points)
    name = problem.plant.controls[control]
    return LimitCurve(name, limit, frozen(limits), frozen([points[one] for one in limits]))


def _unexplained(problem: Problem, gain: Array, metric: Array) -> Array:
    """100 - VAF, % (p,)."""
    recorded = np.concatenate([trial.corrected for trial in problem.recordings])
    runs = simulated(problem, gain, metric)
    modelled = np.concatenate([run.x for run in runs]) @ problem.plant.C.T
    if not all(run.complete for run in runs):
        return np.full(recorded.shape[1], np.nan)
    return np.asarray(100 - vaf(recorded, modelled))
