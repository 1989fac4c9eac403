"""Weights for noisy recordings: the direct form (3.6) in whitened coordinates.

Noise moves a fitted gain off the gains that weights can have, so that the reduced form has no
solution. The direct form has one, but in the units of a plant such as the seat the weights have
condition numbers of 1e7, which outweigh any misfit. In whitened coordinates (`gain_fibre`) they are
10 to 100, and the condition number acts as the mild regulariser that (3.6) intends.

    minimise  ||r||^2 / ||r_free||^2 + kappa(blkdiag(T'QT, G'RG)) / kappa_reference / samples

r_free is the residual of the unrestricted gain (`fit_gain`), which estimates the noise; T and G are
the whitened coordinates of the start. The reference is the condition number of the start, then of
the solution if that is larger: there the penalty equals the noise of one sample.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from impc.arrays import Array, frozen
from impc.checking import replace
from impc.control.terminal_set import TerminalSet
from impc.errors import SolverError, WeightsError
from impc.inverse.columns import triangular_rows
from impc.inverse.equivalent_weights import least_condition_weights
from impc.inverse.laws import GainLaw
from impc.inverse.problem import Problem
from impc.inverse.proximal_search import ConditionedFit, Objective, Residual, conditioned_fit
from impc.inverse.solution_set import (
    GainFibre,
    gain_fibre,
    natural_coordinates,
    pair_blocks,
    split_blocks,
)
from impc.inverse.unknowns import linear_at
from impc.model.plant import change_coordinates
from impc.model.riccati import LqrSolution, solve_lqr
from impc.model.weights import Weights, condition_number, normalised

#: Penalty at the condition number of the start, in squared noise SDs of one sample: it decides
#: along directions that noise leaves open. Scaled by all samples (1e-3 of the squared misfit) it
#: moved the gains of long, weakly excited recordings by several standard errors.
CONDITION_SHARE = 1.0
# Rounds with an updated reference, and the growth of the condition number that needs another.
_ROUNDS, _WORSE = 3, 1.05
_ITERATIONS = 40
# Relative decrease of the objective at which the search stops; less is below the noise.
_TOLERANCE = 1e-5
#: Largest condition number of the starting weights in whitened coordinates. Diagonal starts can lie
#: at the edge of the cone (1e9 and more), where the penalty, relative to the start, has no effect.
#: Of 15 random plants with three inputs that missed the truth, 13 reach it from 1e3, 8 from 1e5.
WORST_START = 1e3
# Accept a start whose misfit is at most this multiple of the noise.
_FITS = 1.005


def inverse_mpc_natural(
    problem: Problem,
    start: Weights,
    noise: float,
) -> ConditionedFit:
    """Direct inverse MPC in whitened coordinates, initial states and plant fixed."""
    plant = problem.plant
    solution = solve_lqr(plant, start)
    T, G = natural_coordinates(plant, solution.K)
    natural = change_coordinates(plant, T, G)
    fibre = gain_fibre(natural, np.linalg.solve(G, solution.K @ T), G.T @ solution.S @ G)
    best = best_conditioned(fibre, in_natural_units(start, T, G))
    residual = _residual(problem, T, G, noise)
    fits = np.linalg.norm(residual(solve_lqr(natural, best)).values) <= _FITS
    begin = best if fits else _away_from_the_edge(best)
    samples = problem.recorded_numbers
    reference, evaluations, found = condition_number(best), 0, None
    for _ in range(_ROUNDS):
        objective = Objective(residual, 1.0, CONDITION_SHARE / samples / reference, squared=True)
        found = conditioned_fit(
            natural, objective, begin, max_iterations=_ITERATIONS, tolerance=_TOLERANCE
        )
        evaluations += found.evaluations
        if found.condition <= _WORSE * reference:
            break
        begin, reference = found.weights, found.condition
    assert found is not None  # _ROUNDS > 0
    weights = in_plant_units(found.weights, T, G)
    return replace(
        found,
        weights=weights,
        solution=solve_lqr(plant, weights),
        misfit=found.misfit * noise,
        evaluations=evaluations,
        converged=found.iterations < _ITERATIONS,
    )


def in_plant_units(weights: Weights, T: Array, G: Array) -> Weights:
    """Weights of z = T^-1 x and v = G^-1 u as weights of x and u, scaled to R[0, 0] = 1."""
    z, v = np.linalg.inv(T), np.linalg.inv(G)
    block = pair_blocks((z.T @ weights.Q @ z)[None], (v.T @ weights.R @ v)[None])[0]
    return normalised(split_blocks(block, len(T)))


def in_natural_units(weights: Weights, T: Array, G: Array) -> Weights:
    """Weights of x = T z and u = G v as weights of z and v; T (n, n), G (m, m)."""
    block = pair_blocks((T.T @ weights.Q @ T)[None], (G.T @ weights.R @ G)[None])[0]
    return split_blocks(block, len(T))


def best_conditioned(fibre: GainFibre, member: Weights) -> Weights:
    """Equivalent weights of least condition number; `member` if the program fails."""
    try:
        return least_condition_weights(fibre, member).weights
    except (WeightsError, SolverError):  # numerically at the edge of the cone
        return member


def _away_from_the_edge(weights: Weights) -> Weights:
    """Weights with a multiple of I added if their condition number exceeds `WORST_START`."""
    if condition_number(weights) <= WORST_START:
        return weights
    floor = float(np.linalg.eigvalsh(weights.block)[-1]) / WORST_START
    n, size = len(weights.Q), len(weights.block)
    return split_blocks(weights.block + floor * np.eye(size), n)


def _residual(
    problem: Problem, T: Array, G: Array, noise: float
) -> Callable[[LqrSolution], Residual]:
    """Residual over noise of a regulator in whitened coordinates, u = -G K T^-1 x."""
    known = replace(problem, unknown_start=False, family=None, logarithms=frozen(np.zeros(0)))
    z, v = np.linalg.inv(T), np.linalg.inv(G)
    near: TerminalSet | None = None

    def residual(solution: LqrSolution) -> Residual:
        nonlocal near
        law = GainLaw(known, G @ solution.K @ z, v.T @ solution.S @ v)
        found = linear_at(known, law, law.start, near)
        near = found.terminal or near
        # Triangular factor: the search uses only norms and inner products.
        rows = triangular_rows([found.parts(known)[0], found.residual[:, None]]) / noise

        def along(dK: Array, dS: Array) -> Array:
            return np.asarray(rows[:, :-1] @ law.along(G @ dK @ z, v.T @ dS @ v).T)

        return Residual(rows[:, -1], along, usable=not found.reason)

    return residual
