"""Weights behind a fitted gain, judged by what they do: the second half of the reduced form.

See docs/theory.md, section 6, and docs/fitting.md for several inputs.

    all weights with the gain and, along what is told of it, the metric  ->  least condition number
                                                                         ->  simulated and compared

With one input the weights of the program reproduce the recordings as the gain does. With several
the fitted pair (K, S) is that of weights only up to the fit's own error, and a program that is
given such a pair has no members or far ones. So weights that miss the recordings are refined
(`search_weights`), and the program is run again from the pair that they make, which has members to
the last digit.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from impc.checking import replace
from impc.errors import SolverError, WeightsError
from impc.inverse.equivalent_weights import least_condition_weights
from impc.inverse.gain_search import EXPLAINED, describe_gain
from impc.inverse.problem import recorded_size
from impc.inverse.residuals import residual_only
from impc.inverse.solution_set import gain_fibre
from impc.inverse.weights_search import search_weights
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
    found = _with_gain(fit)
    if found.explained or len(fit.S) == 1 or not fit.explained:
        return found
    start = _near(fit)
    if start is None:
        return found
    refined = search_weights(fit.problem, start)
    exact = describe_gain(fit, refined.solution.K, refined.solution.S)
    if not exact.explained:
        return found
    return _with_gain(exact, refined.weights)


def weights_misfit(problem: Problem, weights: Weights) -> float:
    """2-norm of the residual of the constrained controller with these weights."""
    solution = solve_lqr(problem.plant, weights)
    return float(np.linalg.norm(residual_only(problem, solution.K, solution.S)))


def _with_gain(fit: GainFit, member: Weights | None = None) -> WeightsBehind:
    """The best of: metric in the span of those that are not told apart, or exactly the fitted."""
    best = WeightsBehind(fit, None, np.inf, explained=False, reason="")
    spans = [fit.metrics] if len(fit.metrics) == 1 else [fit.metrics, fit.metrics[:1]]
    for metrics in spans:
        try:
            equivalent = least_condition_weights(
                gain_fibre(fit.problem.plant, fit.K, metrics), member
            )
        except (WeightsError, SolverError) as error:
            best = best if best.reason else replace(best, reason=str(error))
            continue
        misfit = weights_misfit(fit.problem, equivalent.weights)
        if misfit < best.misfit:
            best = _judged(fit, equivalent, misfit)
        if best.explained:
            break
    return best


def _judged(fit: GainFit, equivalent: EquivalentWeights, misfit: float) -> WeightsBehind:
    size = recorded_size(fit.problem)
    explained = misfit <= EXPLAINED * size
    reason = "" if explained else f"the weights miss the recordings by {misfit / size:.2g} of them"
    return WeightsBehind(fit, equivalent, misfit, explained, reason)


def _near(fit: GainFit) -> Weights | None:
    """Weights whose gain and metric come near the fitted ones, or None."""
    plant, found = fit.problem.plant, []
    for rank in _RANKS:
        for metrics in (fit.metrics, None):
            try:
                weights = least_condition_weights(gain_fibre(plant, fit.K, metrics, rank)).weights
                found.append((weights_misfit(fit.problem, weights), weights))
            except (WeightsError, SolverError):  # none at this rank; another may have
                continue
    return min(found, key=lambda item: item[0])[1] if found else None
