"""Inverse MPC: the weights of the constrained controller that made the recordings.

`infer_weights` is Table 3.1 from end to end. Its last line is the direct form (3.6); the reduced
form reaches the same weights through the gain: what the recordings determine is K (and S), and the
weights of least condition number among all those with that gain are one semidefinite program.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Array
from impc.checking import checked, replace
from impc.errors import SolverError
from impc.inverse.explaining_weights import weights_behind
from impc.inverse.gain_search import GainFit, fit_gain, refine_gain, regulators
from impc.inverse.inverse_lqr import inverse_lqr_gradient, inverse_lqr_lmi
from impc.inverse.problem import EXPLAINED, recorded_size, typical_output, with_or_without_set
from impc.inverse.proximal_search import (
    AUXILIARY_CONDITION_WEIGHT,
    ConditionedFit,
    Objective,
    Residual,
    auxiliary_weights,
    conditioned_fit,
    definite,
)
from impc.inverse.residuals import evaluate, keeps_hard
from impc.model.riccati import solve_lqr
from impc.model.weights import Weights

if TYPE_CHECKING:
    from collections.abc import Callable

    from impc.control.terminal_set import TerminalSet
    from impc.inverse.equivalent_weights import EquivalentWeights
    from impc.inverse.explaining_weights import WeightsBehind
    from impc.inverse.inverse_lqr import InverseLqr
    from impc.inverse.problem import Problem
    from impc.model.riccati import LqrSolution

# c of (3.5) to (3.7) is lost. Small enough that the exact fit wins in the 2-norm (docs/theory.md).
#: Weight of the condition number in (3.6) and (3.16), against 1 for a misfit of a typical output.
CONDITION_WEIGHT = 1e-4
# Steps of the direct form inside the reduced one: it need not end, only change the valley.
_DETOUR = 60


@dataclass(frozen=True)
class DirectFit(ConditionedFit):
    """Result of `inverse_mpc`: what every `ConditionedFit` says, and whether it explains."""

    # Whether the constrained controller of the weights reproduces the recordings to 1e-9 of them.
    # Where `converged` is true and this is not, the search ended in a minimum of its objective that
    # leaves a misfit: noise, a model that is wrong, or a local minimum.
    explained: bool


@dataclass(frozen=True)
class ReducedFit:
    """Result of `inverse_mpc_reduced`."""

    gain: GainFit  # What the recordings determine
    metrics: Array  # The metric, then directions along which they do not identify it (k, m, m)
    # Weights of least condition number with exactly that gain; None when there are none
    equivalent: EquivalentWeights | None
    # Weights of the direct form, when none have exactly that gain, or those that do fit worse
    direct: DirectFit | None
    # Whether the constrained controller of these weights reproduces the recordings to 1e-9 of them
    explained: bool
    reason: str  # Why not; empty when it does
    # Whether the controller found reaches every sample with hard state bounds and terminal set,
    # which the search had softened; see `verify_hard`
    kept_hard: bool

    @property
    def misfit(self) -> float:
        """2-norm of the residual of the direct form, or of the gain."""
        return self.gain.misfit if self.direct is None else self.direct.misfit

    @property
    def weights(self) -> Weights:
        """The weights found, scaled to R[0, 0] = 1."""
        found = self.equivalent if self.direct is None else self.direct
        assert found is not None  # one of the two is always there: see `inverse_mpc_reduced`
        return found.weights


@dataclass(frozen=True)
class Start:
    """Lines 1 to 8 of Table 3.1; what the branch taken did not need is None."""

    gain: GainFit  # Line 1: feedback gain without bounds
    lmi: InverseLqr  # Line 2; whether it is feasible decides the branch
    gradient: InverseLqr | None  # Line 4
    auxiliary: ConditionedFit | None  # Line 5
    weights: Weights  # Line 5 or 7: where (3.6) starts


@dataclass(frozen=True)
class Inference:
    """Table 3.1 from end to end."""

    start: Start  # Lines 1 to 8
    fit: DirectFit  # Line 9


@checked
def infer_weights(problem: Problem) -> Inference:
    """Table 3.1: from recordings to the weights of the constrained controller behind them.

    Parameters
    ----------
    problem : Problem

    Raises
    ------
    WeightsError, SolverError
        When no starting weights can be found, or the recordings cannot be simulated from them.

    Examples
    --------
    >>> import impc
    >>> from plants import yalmip_example
    >>> plant = impc.Plant(yalmip_example())
    >>> bounds, weights = impc.Bounds(plant, u_min=-1, u_max=1), impc.Weights([[1, 0], [0, 1]], 1)
    >>> truth = impc.Controller(plant, weights, bounds, horizon=3)
    >>> trial = impc.Recording(plant, truth.simulate([1, 3], steps=20).x)
    >>> found = impc.infer_weights(impc.Problem(plant, bounds, 3, [trial])).fit
    >>> found.explained, impc.weight_error(found.weights, weights) < 1e-6
    (True, True)
    """
    start = starting_point(problem)
    return Inference(start, inverse_mpc(problem, start.weights))


@checked
def starting_point(problem: Problem) -> Start:
    """Lines 1 to 8 of Table 3.1: a feedback gain, and the weights of a regulator like it."""
    plant = problem.plant
    gain = fit_gain(problem.without_bounds())
    lmi = inverse_lqr_lmi(plant, gain.K)
    if lmi.weights is not None:
        return Start(gain, lmi, None, None, lmi.weights)
    gradient = inverse_lqr_gradient(plant, gain.K)
    weight = AUXILIARY_CONDITION_WEIGHT * (float(np.linalg.norm(gain.K)) or 1.0)
    auxiliary = auxiliary_weights(plant, gain.K, gradient.weights, condition_weight=weight)
    return Start(gain, lmi, gradient, auxiliary, auxiliary.weights)


@checked(condition_weight=0, max_iterations=1)
def inverse_mpc(
    problem: Problem,
    start: Weights,
    *,
    condition_weight: float | None = None,
    squared: bool = False,
    max_iterations: int = 200,
    explain: bool = True,
) -> DirectFit:
    """Direct inverse MPC (3.6): misfit of the constrained closed loop plus condition number.

    Terminal weight and terminal set follow (Q, R) at every iterate.

    Parameters
    ----------
    start : Weights
        Positive definite, from Table 3.1 for example.
    condition_weight : float, optional
        Against a fit weight of 1. By default 1e-4 of a typical output (over its scale), so that the
        answer does not depend on units.
    squared : bool
        Whether the misfit is the square of its 2-norm; see `Objective`.
    max_iterations : int
        Steps that are solved at most.
    explain : bool
        Whether weights that explain the recordings are looked for where the minimum does not, and
        taken instead: the minimum at every condition weight that is small enough (docs/theory.md,
        section 6). Only in the 2-norm, and without a condition weight of the caller's.

    Raises
    ------
    WeightsError, SolverError
        As `conditioned_fit`.

    Examples
    --------
    >>> import impc
    >>> from plants import yalmip_example
    >>> plant = impc.Plant(yalmip_example())
    >>> bounds, weights = impc.Bounds(plant, u_min=-1, u_max=1), impc.Weights([[1, 0], [0, 1]], 1)
    >>> truth = impc.Controller(plant, weights, bounds, horizon=3)
    >>> trial = impc.Recording(plant, truth.simulate([1, 3], steps=20).x)
    >>> problem = impc.Problem(plant, bounds, 3, [trial])
    >>> found = impc.inverse_mpc(problem, impc.Weights([[1, 0], [0, 2]], 3))
    >>> found.explained, impc.weight_error(found.weights, weights) < 1e-6
    (True, True)
    """
    weight = condition_weight
    if weight is None:
        weight = CONDITION_WEIGHT * typical_output(problem)
    settings = squared, max_iterations, explain and not squared and condition_weight is None

    def fit(problem: Problem) -> DirectFit:
        return _conditioned(problem, start, weight, *settings)

    return with_or_without_set(problem, fit, lambda found: found.explained)


def _conditioned(
    problem: Problem,
    start: Weights,
    weight: float,
    squared: bool,
    max_iterations: int,
    explain: bool,
) -> DirectFit:
    objective = Objective(_closed_loop_residual(problem), 1.0, weight, squared)
    fit = conditioned_fit(problem.plant, objective, definite(start), max_iterations=max_iterations)
    found = _direct(problem, fit)
    if found.explained or not explain:
        return found
    return _explaining(problem, found, weight)


def _direct(problem: Problem, fit: ConditionedFit) -> DirectFit:
    explained = fit.misfit <= EXPLAINED * recorded_size(problem)
    values = {item.name: getattr(fit, item.name) for item in fields(ConditionedFit)}
    return DirectFit(**values, explained=explained)


def _explaining(problem: Problem, found: DirectFit, weight: float) -> DirectFit:
    """Weights of least condition number that explain the recordings, if any; else those given."""
    K, S = np.array(found.solution.K), np.array(found.solution.S)
    behind = weights_behind(refine_gain(problem, K, S))
    if not behind.explained or behind.equivalent is None:
        return found
    weights, condition = behind.equivalent.weights, behind.equivalent.condition
    return replace(
        found,
        weights=weights,
        solution=solve_lqr(problem.plant, weights),
        misfit=behind.misfit,
        condition=condition,
        objective=behind.misfit + weight * condition,
        evaluations=found.evaluations + behind.gain.evaluations,
        converged=True,
        explained=True,
    )


@checked
def inverse_mpc_reduced(problem: Problem) -> ReducedFit:
    """Reduced inverse MPC: fit the gain through the constrained controller, then one program.

    When the gain does not explain the recordings, or no weights have it, a search that stays among
    weights (the direct form) follows, and goes on as a search for a gain from where that ends.

    Parameters
    ----------
    problem : Problem

    Raises
    ------
    SolverError
        When the recordings cannot be simulated from where any search begins.

    Examples
    --------
    >>> import impc
    >>> from plants import yalmip_example
    >>> plant = impc.Plant(yalmip_example())
    >>> bounds = impc.Bounds(plant, u_min=-1, u_max=1)
    >>> truth = impc.Controller(plant, impc.Weights([[1, 0], [0, 1]], 1), bounds, horizon=3)
    >>> trial = impc.Recording(plant, truth.simulate([1, 3], steps=20).x)
    >>> found = impc.inverse_mpc_reduced(impc.Problem(plant, bounds, 3, [trial]))
    >>> found.explained, bool(abs(found.gain.K - truth.K).max() < 1e-6)
    (True, True)
    """
    return with_or_without_set(problem, _reduced, lambda found: found.explained)


def _reduced(problem: Problem) -> ReducedFit:
    first = weights_behind(fit_gain(problem))
    if first.explained:
        return _with_gain(problem, first)
    try:
        direct = inverse_mpc(
            problem,
            _most_promising(problem),
            max_iterations=_DETOUR,
            explain=False,
        )
    except SolverError:  # the loop falls with every regulator that a search begins at
        if first.equivalent is None:
            raise
        return _with_gain(problem, first)
    K, S = np.array(direct.solution.K), np.array(direct.solution.S)
    second = weights_behind(refine_gain(problem, K, S))
    best = min(first, second, key=lambda item: item.misfit)
    if best.misfit <= direct.misfit:
        return _with_gain(problem, best)
    kept = keeps_hard(problem, direct.weights)
    return ReducedFit(first.gain, first.metrics, None, direct, False, first.reason, kept)


def _with_gain(problem: Problem, found: WeightsBehind) -> ReducedFit:
    assert found.equivalent is not None  # its misfit is finite
    kept = keeps_hard(problem, found.equivalent.weights)
    return ReducedFit(
        found.gain, found.metrics, found.equivalent, None, found.explained, found.reason, kept
    )


def _most_promising(problem: Problem) -> Weights:
    """Of balanced regulators that of least misfit, whether or not every sample is reached."""

    def distance(solution: LqrSolution) -> float:
        return float(np.linalg.norm(evaluate(problem, solution.K, solution.S).residual))

    return min(regulators(problem), key=distance).weights


@checked(condition_weight=0)
def output_penalty_weights(
    problem: Problem,
    start: Weights,
    *,
    condition_weight: float | None = None,
) -> ConditionedFit:
    """Inverse LQR on the outputs (3.16): as `inverse_mpc`, but the loop is the plain regulator."""
    return inverse_mpc(
        problem.without_bounds(), start, condition_weight=condition_weight, explain=False
    )


def _closed_loop_residual(problem: Problem) -> Callable[[LqrSolution], Residual]:
    near: TerminalSet | None = None

    def residual(solution: LqrSolution) -> Residual:
        nonlocal near
        found = evaluate(problem, solution.K, solution.S, near)
        near = found.terminal or near
        return Residual(found.residual, found.dK, found.dS, usable=not found.reason)

    return residual
