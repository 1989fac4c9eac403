"""Inverse MPC: the weights of the constrained controller that made the recordings.

`infer_weights` is Table 3.1 from end to end. Its last line is the direct form (3.6); the reduced
form reaches the same weights through the gain: what the recordings determine is K (and S), and the
weights of least condition number among all those with that gain are one semidefinite program.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Array
from impc.closed_loop import simulate
from impc.conditioned_fit import ConditionedFit, Objective, Residual, conditioned_fit
from impc.controller import mpc_controller
from impc.diagonal_weights import bryson_weights
from impc.door import checked
from impc.equivalent_weights import gain_fibre, least_condition_weights
from impc.errors import SolverError, WeightsError
from impc.evaluation import evaluate
from impc.gain import GainFit, fit_gain
from impc.inverse_lqr import inverse_lqr_gradient, inverse_lqr_lmi
from impc.inverse_problem import scenarios, without_bounds
from impc.lqr import solve_lqr
from impc.weights import Weights, condition_number, normalised, stage_weights

if TYPE_CHECKING:
    from collections.abc import Callable

    from impc.closed_loop import Simulation
    from impc.equivalent_weights import EquivalentWeights
    from impc.inverse_lqr import InverseLqr
    from impc.inverse_problem import InverseProblem
    from impc.lqr import LqrSolution
    from impc.plant import Plant
    from impc.terminal_set import TerminalSet

__all__ = [
    "AUXILIARY_CONDITION_WEIGHT",
    "CONDITION_WEIGHT",
    "Inference",
    "ReducedFit",
    "Start",
    "auxiliary_weights",
    "infer_weights",
    "inverse_mpc",
    "inverse_mpc_reduced",
    "output_penalty_weights",
    "start_gains",
    "starting_point",
    "verify_hard",
]

# c of (3.5) to (3.7) is lost. Small enough that the exact fit wins in the 2-norm (docs/theory.md).
#: Weight of the condition number in (3.6) and (3.16), against 1 for the misfit.
CONDITION_WEIGHT = 1e-4
#: The same in (3.7), against 1 for the distance of the gains.
AUXILIARY_CONDITION_WEIGHT = 1e-3
# Steps of the direct form inside the reduced one: it need not end, only change the valley.
_DETOUR = 60
# Starting weights are kept this definite: the search takes the Cholesky factor of them.
_LARGEST_START_CONDITION = 1e6


@dataclass(frozen=True)
class ReducedFit:
    """Result of `inverse_mpc_reduced`.

    Attributes
    ----------
    gain : GainFit
        What the recordings determine.
    equivalent : EquivalentWeights or None
        Weights of least condition number with exactly that gain; None when there are none.
    direct : ConditionedFit or None
        Weights of the direct form, when none have exactly that gain.
    reason : str
        Why the direct form was needed; empty when it was not.
    kept_hard : bool
        Whether the controller found reaches every sample with hard state bounds and terminal set,
        which the search had softened; see `verify_hard`.
    """

    gain: GainFit
    equivalent: EquivalentWeights | None
    direct: ConditionedFit | None
    reason: str
    kept_hard: bool

    @property
    def weights(self) -> Weights:
        """The weights found, scaled to R[0, 0] = 1."""
        found = self.equivalent if self.direct is None else self.direct
        assert found is not None  # one of the two is always there: see `inverse_mpc_reduced`
        return found.weights


@dataclass(frozen=True)
class Start:
    """Lines 1 to 8 of Table 3.1; what the branch taken did not need is None.

    Attributes
    ----------
    gain : GainFit
        Line 1: feedback gain without bounds.
    lmi : InverseLqr
        Line 2; whether it is feasible decides the branch.
    gradient : InverseLqr or None
        Line 4.
    auxiliary : ConditionedFit or None
        Line 5.
    weights : Weights
        Line 5 or 7: where (3.6) starts.
    """

    gain: GainFit
    lmi: InverseLqr
    gradient: InverseLqr | None
    auxiliary: ConditionedFit | None
    weights: Weights


@dataclass(frozen=True)
class Inference:
    """Table 3.1 from end to end.

    Attributes
    ----------
    start : Start
        Lines 1 to 8.
    fit : ConditionedFit
        Line 9.
    """

    start: Start
    fit: ConditionedFit


@checked(condition_weight=0)
def infer_weights(
    problem: InverseProblem, *, condition_weight: float = CONDITION_WEIGHT
) -> Inference:
    """Table 3.1: from recordings to the weights of the constrained controller behind them.

    Parameters
    ----------
    problem : InverseProblem
    condition_weight : float
        Weight of the condition number against the 2-norm of the misfit, in (3.6).

    Raises
    ------
    WeightsError, SolverError
        When no starting weights can be found, or the recordings cannot be simulated from them.
    """
    start = starting_point(problem)
    return Inference(start, inverse_mpc(problem, start.weights, condition_weight=condition_weight))


def start_gains(start: Start, plant: Plant) -> list[tuple[Array, Array]]:
    """The gains (m, n) that Table 3.1 passed, with metrics (m, m), as starts for `fit_gain`."""
    passed = [start.weights]
    if start.gradient is not None and start.gradient.weights is not None:
        passed.append(start.gradient.weights)
    solutions = [solve_lqr(plant, weights) for weights in passed]
    pairs = [(np.array(item.K), np.array(item.S)) for item in solutions]
    return [(np.array(start.gain.K), pairs[0][1]), *pairs]


@checked
def starting_point(problem: InverseProblem) -> Start:
    """Lines 1 to 8 of Table 3.1: a feedback gain, and the weights of a regulator like it.

    Raises
    ------
    WeightsError, SolverError
        As `infer_weights`.
    """
    plant = problem.plant
    gain = fit_gain(without_bounds(problem), attempts=1)
    lmi = inverse_lqr_lmi(plant, gain.K)
    if lmi.weights is not None:
        return Start(gain, lmi, None, None, lmi.weights)
    gradient = inverse_lqr_gradient(plant, gain.K)
    auxiliary = auxiliary_weights(plant, gain.K, gradient.weights)
    return Start(gain, lmi, gradient, auxiliary, auxiliary.weights)


@checked(condition_weight=0, max_iterations=1)
def inverse_mpc(
    problem: InverseProblem,
    start: Weights,
    *,
    condition_weight: float = CONDITION_WEIGHT,
    squared: bool = False,
    max_iterations: int = 200,
) -> ConditionedFit:
    """Direct inverse MPC (3.6): misfit of the constrained closed loop plus condition number.

    Terminal weight and terminal set follow (Q, R) at every iterate.

    Parameters
    ----------
    start : Weights
        Positive definite, from Table 3.1 for example.
    condition_weight : float
        Against a fit weight of 1.
    squared : bool
        Whether the misfit is the square of its 2-norm; see `Objective`.
    max_iterations : int
        Steps that are solved at most.

    Raises
    ------
    WeightsError, SolverError
        As `conditioned_fit`.
    """
    objective = Objective(_closed_loop_residual(problem), 1.0, condition_weight, squared)
    return conditioned_fit(
        problem.plant, objective, _definite(start), max_iterations=max_iterations
    )


@checked(condition_weight=0)
def inverse_mpc_reduced(
    problem: InverseProblem,
    *starts: tuple[Array, Array],
    condition_weight: float = CONDITION_WEIGHT,
) -> ReducedFit:
    """Reduced inverse MPC: fit the gain through the constrained controller, then one program.

    Three searches at most: two for a gain, and when neither explains the recordings, or no weights
    have the gain found, one that stays among weights (the direct form) and goes on as a search for
    a gain from where that ends. It passes local minima at gains that no weights have.

    Parameters
    ----------
    starts : pairs of Array
        Gains (m, n) and metrics (m, m) from which the search may start, see `fit_gain`.
    condition_weight : float
        Of the direct form.

    Raises
    ------
    SolverError
        When the recordings cannot be simulated from any start.
    """
    first = fit_gain(problem, *starts, attempts=2)
    equivalent, reason = _least_condition(problem.plant, first)
    if equivalent is not None and first.explained:
        return _with_gain(problem, first, equivalent)
    direct = inverse_mpc(
        problem,
        _most_promising(problem),
        condition_weight=condition_weight,
        max_iterations=_DETOUR,
    )
    end = (np.array(direct.solution.K), np.array(direct.solution.S))
    second = fit_gain(problem, end, attempts=1)
    if equivalent is not None and first.misfit <= second.misfit:
        return _with_gain(problem, first, equivalent)
    again, _ = _least_condition(problem.plant, second)
    if again is not None:
        return _with_gain(problem, second, again)
    if equivalent is not None:
        return _with_gain(problem, first, equivalent)
    kept = all(run.complete for run in verify_hard(problem, direct.weights))
    return ReducedFit(first, None, direct, reason, kept)


def _with_gain(problem: InverseProblem, fit: GainFit, equivalent: EquivalentWeights) -> ReducedFit:
    kept = all(run.complete for run in verify_hard(problem, equivalent.weights))
    return ReducedFit(fit, equivalent, None, "", kept)


def _most_promising(problem: InverseProblem) -> Weights:
    """Of `bryson_weights` those with the least misfit, whether or not every sample is reached."""

    def distance(weights: Weights) -> float:
        solution = solve_lqr(problem.plant, weights)
        return float(np.linalg.norm(evaluate(problem, solution.K, solution.S).residual))

    return min(bryson_weights(problem), key=distance)


def _least_condition(plant: Plant, fit: GainFit) -> tuple[EquivalentWeights | None, str]:
    """The weights of least condition number with the fitted gain, or why there are none."""
    try:
        fibre = gain_fibre(plant, fit.K, fit.S if fit.metric_determined else None)
        return least_condition_weights(fibre), ""
    except (WeightsError, SolverError) as error:  # none, or none that could be certified
        return None, str(error)


@checked(gain="m n", condition_weight=0)
def auxiliary_weights(
    plant: Plant,
    gain: Array,
    start: Weights | None,
    *,
    condition_weight: float = AUXILIARY_CONDITION_WEIGHT,
) -> ConditionedFit:
    """Auxiliary problem (3.7): weights whose regulator is near the gain, and well conditioned.

    minimise  ||K(Q, R) - gain||_2 + condition_weight kappa(blkdiag(Q, R))

    Parameters
    ----------
    gain : Array
        (m, n).
    start : Weights or None
        Where the search begins; the identity for None.
    condition_weight : float
        Against 1 for the distance.

    Raises
    ------
    WeightsError
        When the start has no stabilising Riccati solution.
    """
    size = gain.size
    dK = np.eye(size).reshape(size, *gain.shape)
    dS = np.zeros((size, plant.m, plant.m))

    def distance(solution: LqrSolution) -> Residual:
        return Residual((solution.K - gain).ravel(), dK, dS, usable=True)

    begin = stage_weights(np.eye(plant.n), np.eye(plant.m)) if start is None else start
    return conditioned_fit(
        plant, Objective(distance, 1.0, condition_weight, squared=False), _definite(begin)
    )


@checked(condition_weight=0)
def output_penalty_weights(
    problem: InverseProblem,
    start: Weights,
    *,
    condition_weight: float = CONDITION_WEIGHT,
) -> ConditionedFit:
    """Inverse LQR on the outputs (3.16): as `inverse_mpc`, but the loop is the plain regulator.

    Parameters
    ----------
    start : Weights
        Positive definite.
    condition_weight : float
        Against a fit weight of 1.

    Raises
    ------
    WeightsError, SolverError
        As `inverse_mpc`.
    """
    return inverse_mpc(without_bounds(problem), start, condition_weight=condition_weight)


@checked
def verify_hard(problem: InverseProblem, weights: Weights) -> list[Simulation]:
    """Simulate every recording with hard state bounds and terminal set.

    The search softens those rows; this says whether the controller found keeps them. Pass each
    result to `require_complete` to turn a failure into an error.
    """
    controller = mpc_controller(
        problem.plant,
        weights,
        problem.bounds,
        problem.horizon,
        terminal_set=problem.terminal_set,
    )
    return [simulate(controller, drive) for drive in scenarios(problem)]


def _closed_loop_residual(problem: InverseProblem) -> Callable[[LqrSolution], Residual]:
    near: TerminalSet | None = None

    def residual(solution: LqrSolution) -> Residual:
        nonlocal near
        found = evaluate(problem, solution.K, solution.S, near)
        near = found.terminal or near
        return Residual(found.residual, found.dK, found.dS, usable=not found.reason)

    return residual


def _definite(weights: Weights) -> Weights:
    """Lift the least eigenvalues of Q and R so that the condition number is at most 1e6."""
    if condition_number(weights) <= _LARGEST_START_CONDITION:
        return normalised(weights)
    floor = float(np.linalg.eigvalsh(weights.block)[-1]) / _LARGEST_START_CONDITION
    lifted = []
    for matrix in (weights.Q, weights.R):
        values, vectors = np.linalg.eigh(matrix)
        lifted.append((vectors * np.maximum(values, floor)) @ vectors.T)
    return normalised(stage_weights(*lifted))
