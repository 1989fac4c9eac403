"""From recordings to one controller: gain, weights, initial states, physical parameters.

    diagonal weights  ->  gain with initial states and parameters  ->  weights with that gain, or
                                                                       the direct form near it

A gain that explains its recordings to 1e-9 has weights to find, and the reduced form finds them:
one semidefinite program. With noise a fitted gain has none as a rule, and the direct form in
natural coordinates (`natural_search`) takes the weights that fit best (docs/fitting.md).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import frozen
from impc.checking import checked, replace
from impc.errors import SolverError, WeightsError
from impc.inverse.diagonal_start import diagonal_weights
from impc.inverse.estimates import Estimate, Status
from impc.inverse.explaining_weights import weights_behind
from impc.inverse.gain_search import EXPLAINED, GainFit, describe_gain, fit_gain, refine_gain
from impc.inverse.initial_states import with_fitted_starts
from impc.inverse.natural_search import WORST_START, in_plant_units, inverse_mpc_natural
from impc.inverse.nearest_regulator import auxiliary_weights
from impc.inverse.one_step import one_step
from impc.inverse.problem import recorded_size
from impc.inverse.quiet_samples import has_bounds
from impc.inverse.residuals import residual_only
from impc.inverse.solution_set import natural_coordinates
from impc.model.plant import change_coordinates
from impc.model.riccati import solve_lqr

if TYPE_CHECKING:
    from impc.inverse.problem import Problem
    from impc.inverse.proximal_search import ConditionedFit
    from impc.model.weights import Weights

__all__ = ["fit_controller", "free_gain", "noise_of"]

# Of the natural coordinates of the gain, see `fit_gain`: no optimal gain is far beyond 1.
_SPREAD = 1.0
# Weights that leave this much more than the free gain are looked for again: a tenth of a point of
# VAF where noise leaves 90 %.
_POOR = 1.005
# Condition number of the start from which they are looked for last, and steps.
_EDGE = 1e5
_LONG = 100
# Of steps by themselves, for a start: half the searches of 20 plants end sooner.
_STEP_EVALUATIONS = 30


@checked
def fit_controller(problem: Problem, start: Weights | None = None) -> Estimate:
    """Fit the weights of the constrained controller behind recordings.

    Parameters
    ----------
    problem : Problem
    start : Weights, optional
        Where the search begins; by default the best diagonal ones.

    Returns
    -------
    Estimate
        Of the method "inverse_mpc".

    Raises
    ------
    WeightsError, SolverError
        When no regulator can be simulated, or no weights can be found.
    """
    begin = diagonal_weights(problem) if start is None else start
    free = _other_basin(problem, begin, free_gain(problem, begin))
    if free.explained:  # otherwise no weights can have it: the direct form says which come near
        behind = weights_behind(free)
        if behind.explained and behind.equivalent is not None:
            return _finish(
                behind.gain, free.problem, behind.equivalent.weights, evaluations=0, converged=True
            )
    found = inverse_mpc_natural(free.problem, begin, noise_of(free))
    if found.misfit < free.misfit:  # the free gain stands in a local minimum
        free = free_gain(free.problem, found.weights)
        found = inverse_mpc_natural(free.problem, found.weights, noise_of(free))
    if found.misfit > _POOR * free.misfit:  # the weights stand in one
        found = _again(free, found, begin)
    settled = free.problem
    if problem.unknown_start:
        settled = with_fitted_starts(free.problem, found.solution.K, found.solution.S)
    return _finish(
        free, settled, found.weights, evaluations=found.evaluations, converged=found.converged
    )


def _again(free: GainFit, found: ConditionedFit, begin: Weights) -> ConditionedFit:
    """The direct form from other starts, one after the other until one leaves what noise does.

    First the weights whose regulator is nearest to the free gain, then the start of all, let nearer
    to the edge of what weights can have. Which leads on is chance: of 100 random plants with three
    inputs three stood at 1.1 to 4.7 % too much after the first, and one after the second.
    """
    if not free.stabilises:  # no regulator is near it, and natural coordinates are those of one
        return found
    for start, worst in ((_nearest, WORST_START), (lambda _: begin, _EDGE)):
        if found.misfit <= _POOR * free.misfit:
            break
        try:
            other = inverse_mpc_natural(
                free.problem, start(free), noise_of(free), worst_start=worst, max_iterations=_LONG
            )
        except (WeightsError, SolverError):  # no better start: the answer so far stands
            continue
        found = other if other.misfit < found.misfit else found
    return found


def _nearest(free: GainFit) -> Weights:
    """The weights whose regulator is nearest to the free gain."""
    plant = free.problem.plant
    T, G = natural_coordinates(plant, free.K)
    natural = change_coordinates(plant, T, G)
    gain, metric = np.asarray(np.linalg.solve(G, free.K @ T)), G.T @ free.S @ G
    return in_plant_units(auxiliary_weights(natural, gain, None, metric=metric).weights, T, G)


def _other_basin(problem: Problem, begin: Weights, found: GainFit) -> GainFit:
    """The free gain, or a better one from the gain that fits each step by itself (`one_step`).

    With several inputs the misfit of whole trajectories has local minima that no start on diagonal
    weights avoids: two of 100 random plants in each hundred ended at 5 to 29 % more than the truth.
    """
    if problem.plant.m == 1 or not has_bounds(problem) or found.explained:
        return found
    solution = solve_lqr(problem.plant, begin)
    start = np.array(solution.K), np.array(solution.S)
    try:
        near = refine_gain(
            one_step(problem), *start, max_evaluations=_STEP_EVALUATIONS, spread=_SPREAD
        )
        other = refine_gain(problem, np.array(near.K), np.array(near.S), spread=_SPREAD)
    except SolverError:  # no better start: the first answer stands
        return found
    return other if other.misfit < found.misfit else found


def free_gain(problem: Problem, begin: Weights) -> GainFit:
    """The best gain of any kind near that of some weights, with what else the problem lacks."""
    solution = solve_lqr(problem.plant, begin)
    start = np.array(solution.K), np.array(solution.S)
    return fit_gain(problem, start, attempts=1, regulators=False, spread=_SPREAD)


def noise_of(free: GainFit) -> float:
    """Misfit of the free gain, at least that of rounding."""
    return max(free.misfit, EXPLAINED * recorded_size(free.problem))


def _finish(
    free: GainFit, problem: Problem, weights: Weights, *, evaluations: int, converged: bool
) -> Estimate:
    solution = solve_lqr(problem.plant, weights)
    K, S = np.array(solution.K), np.array(solution.S)
    metrics = frozen(S[None])
    if problem.plant.m > 1:
        metrics = describe_gain(replace(free, problem=problem), K, S).metrics
    misfit = float(np.linalg.norm(residual_only(problem, K, S)))
    explained = misfit <= EXPLAINED * recorded_size(problem)
    status = Status.SETTLED if converged else Status.STOPPED
    return Estimate(
        method="inverse_mpc",
        problem=problem,
        K=solution.K,
        S=solution.S,
        weights=weights,
        metrics=metrics,
        misfit=misfit,
        noise=noise_of(free),
        status=Status.EXPLAINED if explained else status,
        reason="",
        evaluations=free.evaluations + evaluations,
        seconds=0.0,
    )
