"""Weights for noisy recordings: the direct form (3.6) in coordinates in which it is well posed.

Noise moves a fitted gain off the gains that any weights have, so the reduced form has no answer.
The direct form, misfit plus condition number, has one, but in the units of a plant such as the
seat (radians beside the states of a delay) all weights near the answer have condition numbers of
1e7, and a condition number that large outweighs any misfit. In natural coordinates (`gain_fibre`)
the same weights have condition numbers of 10 to 100. There it is a mild regulariser, which is what
(3.6) wants of it, and half a dozen prox-linear steps reach the answer.

    minimise  ||r||^2 / ||r_free||^2 + kappa(blkdiag(T'QT, G'RG)) / kappa_reference / samples

r_free is the residual of the gain without weights (`fit_gain`), which says how much is noise; T and
G are the natural coordinates of the start and stay. The reference is the condition number of the
start, then that of the answer while it is larger: the penalty costs one sample's noise there.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Array, frozen
from impc.checking import replace
from impc.errors import SolverError, WeightsError
from impc.inverse.equivalent_weights import least_condition_weights
from impc.inverse.least_squares import triangular_rows
from impc.inverse.proximal_search import Objective, Residual, conditioned_fit
from impc.inverse.residuals import evaluate
from impc.inverse.solution_set import gain_fibre, natural_coordinates, pair_blocks, split_blocks
from impc.model.plant import change_coordinates
from impc.model.riccati import solve_lqr
from impc.model.weights import Weights, condition_number, normalised

if TYPE_CHECKING:
    from collections.abc import Callable

    from impc.control.terminal_set import TerminalSet
    from impc.inverse.problem import Problem
    from impc.inverse.proximal_search import ConditionedFit
    from impc.inverse.solution_set import GainFibre
    from impc.model.riccati import LqrSolution

#: What the condition number of the start counts, in squared standard deviations of one sample's
#: noise. It decides along directions that noise leaves open, and moves no other by as much as its
#: own deviation; counted against all samples together (1e-3 of the squared misfit) it moved the
#: gains of long, weakly excited recordings by several, and again at every restart.
CONDITION_SHARE = 1.0
# Rounds with another reference, and by how much the condition number has to grow for one more.
_ROUNDS, _WORSE = 3, 1.05
_ITERATIONS = 40
# A step that promises less than this, of the objective, is below what the noise decides.
_TOLERANCE = 1e-5
#: Condition number, in natural coordinates, of the weights that a search begins with. Cost weights
#: of a
#: diagonal start may lie at the edge of what any weights have (1e9 and more): the penalty, which is
#: relative to the start, then regularises nothing and the search stays at that edge. Of 15 random
#: plants with three inputs that ended short of the truth, 13 end at it from 1e3, 8 from 1e5.
WORST_START = 1e3
# A start that leaves no more than this, of the noise, is where the search has to go.
_FITS = 1.005


def inverse_mpc_natural(
    problem: Problem,
    start: Weights,
    noise: float,
) -> ConditionedFit:
    """Direct inverse MPC in natural coordinates, at given initial states and plant."""
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
    assert found is not None  # there are rounds
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
    """The member of least condition number, or the known one where no program says it."""
    try:
        return least_condition_weights(fibre, member).weights
    except (WeightsError, SolverError):  # at the edge of the cone, in double precision
        return member


def _away_from_the_edge(weights: Weights) -> Weights:
    """The weights, if need be with a penalty on every direction, at most `WORST_START` apart."""
    if condition_number(weights) <= WORST_START:
        return weights
    floor = float(np.linalg.eigvalsh(weights.block)[-1]) / WORST_START
    n, size = len(weights.Q), len(weights.block)
    return split_blocks(weights.block + floor * np.eye(size), n)


def _residual(
    problem: Problem, T: Array, G: Array, noise: float
) -> Callable[[LqrSolution], Residual]:
    """Residual over noise of a regulator given in natural coordinates, u = -G K T^-1 x."""
    known = replace(problem, unknown_start=False, family=None, logarithms=frozen(np.zeros(0)))
    z, v = np.linalg.inv(T), np.linalg.inv(G)
    near: TerminalSet | None = None

    def residual(solution: LqrSolution) -> Residual:
        nonlocal near
        metric = v.T @ solution.S @ v
        found = evaluate(known, G @ solution.K @ z, metric, near)
        near = found.terminal or near
        # As many rows as columns: a search uses norms and inner products only.
        m, n = known.plant.m, known.plant.n
        table = triangular_rows(
            [found.dK.reshape(-1, m * n), found.dS.reshape(-1, m * m), found.residual[:, None]]
        )
        table = table / noise
        dK = np.asarray(G.T @ table[:, : m * n].reshape(-1, m, n) @ z.T)
        dS = v @ table[:, m * n : -1].reshape(-1, m, m) @ v.T * _scale_ratio(metric, solution.S)
        return Residual(table[:, -1], dK, dS, usable=not found.reason)

    return residual


def _scale_ratio(metric: Array, natural: Array) -> float:
    """Both metrics are scaled to a mean diagonal of 1 before they are differentiated."""
    return float(np.trace(natural) / np.trace(metric))
