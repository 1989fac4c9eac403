"""Weights with a fitted gain, checked by simulation: the second half of the reduced form.

    all weights with the gain and the identified part of the metric
        ->  least condition number  ->  simulated and compared

With several inputs the metric is the one that fits best among those that weights can have with the
gain (`metric_family`).
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from impc.arrays import Array
from impc.errors import SolverError, WeightsError
from impc.inverse.equivalent_weights import least_condition_weights
from impc.inverse.metric_family import fitted_metric, metric_family, unidentified_metrics
from impc.inverse.problem import EXPLAINED, Problem, recorded_size
from impc.inverse.residuals import residual_only
from impc.inverse.solution_set import gain_fibre
from impc.inverse.unknowns import Fitted
from impc.model.riccati import solve_lqr
from impc.model.weights import Weights

# Largest relative misfit at which weights of an exact gain are accepted. If few samples identify S,
# a rounding error of K is compensated by an S that no weights have.
_NEARLY = 1e-6


@dataclass(frozen=True)
class WeightsBehind:
    """Result of `weights_behind`."""

    gain: Fitted  # Fitted gain
    metrics: Array  # Metric, then directions in which it is not identified (k, m, m)
    weights: Weights | None  # With the gain, of least condition number; None if there are none
    misfit: float  # 2-norm of the residual of these weights; infinite without
    explained: bool  # Whether that is at most 1e-9 of the recorded outputs
    reason: str  # Why there are none, or why they do not explain; otherwise empty

    @property
    def accepted(self) -> bool:
        """Whether the recordings are of these weights, but for rounding of the gain."""
        return self.misfit <= _NEARLY * recorded_size(self.gain.problem)


@functools.lru_cache(maxsize=16)
def weights_behind(fit: Fitted) -> WeightsBehind:
    """Find the weights of least condition number with the gain and check that they explain."""
    problem = fit.problem
    metrics = np.array(fit.S)[None]
    try:
        metrics = _metrics(fit)
        weights = least_condition_weights(gain_fibre(problem.plant, fit.K, metrics)).weights
    except (WeightsError, SolverError) as error:
        return WeightsBehind(fit, metrics, None, np.inf, explained=False, reason=str(error))
    misfit, size = weights_misfit(problem, weights), recorded_size(problem)
    explained = misfit <= EXPLAINED * size
    reason = "" if explained else f"the weights have a relative misfit of {misfit / size:.2g}"
    return WeightsBehind(fit, metrics, weights, misfit, explained, reason)


def _metrics(fit: Fitted) -> Array:
    """Metric that fits best with the gain, then unidentified directions."""
    plant, K = fit.problem.plant, np.array(fit.K)
    if plant.m == 1:
        return np.array(fit.S)[None]
    family = metric_family(plant, K)
    if family is None:
        raise WeightsError(
            "gain",
            "no metric makes K A^-1 B self-adjoint, so no weights have this gain",
            "use inverse_lqr_gradient for the nearest gain",
        )
    z = fitted_metric(fit.problem, K, family, np.array(fit.S))
    return unidentified_metrics(fit.problem, K, family, z)


def weights_misfit(problem: Problem, weights: Weights) -> float:
    """2-norm of the residual of the constrained controller with these weights."""
    solution = solve_lqr(problem.plant, weights)
    return float(np.linalg.norm(residual_only(problem, solution.K, solution.S)))
