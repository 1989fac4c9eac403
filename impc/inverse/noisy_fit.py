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
from impc.inverse.equivalent_weights import least_condition_weights
from impc.inverse.estimates import Estimate, Status
from impc.inverse.explaining_weights import weights_behind
from impc.inverse.gain_search import EXPLAINED, GainFit, describe_gain, fit_gain
from impc.inverse.initial_states import with_fitted_starts
from impc.inverse.natural_search import in_plant_units, inverse_mpc_natural
from impc.inverse.nearest_regulator import auxiliary_weights
from impc.inverse.problem import recorded_size
from impc.inverse.residuals import residual_only
from impc.inverse.solution_set import gain_fibre, natural_coordinates
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
# VAF where noise leaves 90 %. A search that is worth it was looked for twice at most.
_POOR = 1.005
_ROUNDS = 3


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
    free = free_gain(problem, begin)
    if free.explained:  # otherwise no weights can have it: the direct form says which come near
        behind = weights_behind(free)
        if behind.explained and behind.equivalent is not None:
            return _finish(
                behind.gain, free.problem, behind.equivalent.weights, evaluations=0, converged=True
            )
    found = inverse_mpc_natural(free.problem, begin, noise_of(free))
    for _ in range(_ROUNDS):
        if found.misfit < free.misfit:  # the free gain stands in a local minimum
            free = free_gain(free.problem, found.weights)
            found = inverse_mpc_natural(free.problem, found.weights, noise_of(free))
        elif found.misfit > _POOR * free.misfit:  # the weights stand in one
            before, found = found, _again(free, begin, found)
            if found is before:
                break
        else:
            break
    settled = free.problem
    if problem.unknown_start:
        settled = with_fitted_starts(free.problem, found.solution.K, found.solution.S)
    return _finish(
        free, settled, found.weights, evaluations=found.evaluations, converged=found.converged
    )


def _again(free: GainFit, begin: Weights, found: ConditionedFit) -> ConditionedFit:
    """The direct form from the weights whose regulator is nearest to the free gain, if better."""
    plant = free.problem.plant
    if not free.stabilises:
        return found
    T, G = natural_coordinates(plant, free.K)
    natural = change_coordinates(plant, T, G)
    target, near = (
        np.asarray(np.linalg.solve(G, gain @ T)) for gain in (free.K, solve_lqr(plant, begin).K)
    )
    try:
        centre = least_condition_weights(gain_fibre(natural, near)).weights
        start = in_plant_units(auxiliary_weights(natural, target, centre).weights, T, G)
        other = inverse_mpc_natural(free.problem, start, noise_of(free))
    except (WeightsError, SolverError):  # no better start: the first answer stands
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
