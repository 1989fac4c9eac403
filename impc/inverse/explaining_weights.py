"""Weights behind a fitted gain, judged by what they do: the second half of the reduced form.

See docs/theory.md, section 6, and docs/fitting.md for several inputs.

    all weights with the gain and, along what is told of it, the metric  ->  least condition number
                                                                         ->  simulated and compared

The fitted pair (K, S) is consistent (`consistent_pairs`), so that it has weights to the last digit
wherever positive definite ones exist.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from impc.errors import SolverError, WeightsError
from impc.inverse.equivalent_weights import least_condition_weights
from impc.inverse.gain_search import EXPLAINED
from impc.inverse.problem import recorded_size
from impc.inverse.residuals import residual_only
from impc.inverse.solution_set import gain_fibre
from impc.model.riccati import solve_lqr

if TYPE_CHECKING:
    from impc.inverse.equivalent_weights import EquivalentWeights
    from impc.inverse.gain_search import GainFit
    from impc.inverse.problem import Problem
    from impc.model.weights import Weights

__all__ = ["WeightsBehind", "weights_behind", "weights_misfit"]

# Shares of the largest singular value below which a condition on the weights counts as kept: exact,
# and what fits of weakly told metrics leave (1e-9 to 1e-6 in random problems with three inputs).
_RANKS = (1e-10, 1e-7, 1e-4)


@dataclass(frozen=True)
class WeightsBehind:
    """Result of `weights_behind`.

    Attributes
    ----------
    gain : GainFit
        The gain that the weights have: the given one, or the one next to it that has weights.
    equivalent : EquivalentWeights or None
        None when there are none.
    misfit : float
        2-norm of the residual of these weights; infinite without.
    explained : bool
        Whether that is at most 1e-9 of the recorded outputs.
    reason : str
        Why there are none, or why they do not explain; empty when they do.
    """

    gain: GainFit
    equivalent: EquivalentWeights | None
    misfit: float
    explained: bool
    reason: str


def weights_behind(fit: GainFit) -> WeightsBehind:
    """Find the weights of least condition number that reproduce the recordings as a gain does.

    Raises
    ------
    SolverError
        When the plant under the fitted gain cannot be simulated.
    """
    problem = fit.problem
    try:
        equivalent = least_condition_weights(gain_fibre(problem.plant, fit.K, fit.metrics))
    except (WeightsError, SolverError) as error:
        return WeightsBehind(fit, None, np.inf, explained=False, reason=str(error))
    misfit, size = weights_misfit(problem, equivalent.weights), recorded_size(problem)
    explained = misfit <= EXPLAINED * size
    reason = "" if explained else f"the weights miss the recordings by {misfit / size:.2g} of them"
    return WeightsBehind(fit, equivalent, misfit, explained, reason)


def weights_misfit(problem: Problem, weights: Weights) -> float:
    """2-norm of the residual of the constrained controller with these weights."""
    solution = solve_lqr(problem.plant, weights)
    return float(np.linalg.norm(residual_only(problem, solution.K, solution.S)))
