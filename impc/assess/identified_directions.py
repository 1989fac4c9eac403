"""What the recordings say of the weights, and what the condition number said in their place.

The closed loop depends on (Q, R) through K and the scale-free S only, so the derivative of the
outputs with respect to the weights has at most n m + m (m + 1)/2 - 1 directions, whatever was
recorded (n m + m - 1 when A is invertible: docs/theory.md). The rest of the weights was chosen by
the condition number.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Array, Frozen, frozen
from impc.checking import checked
from impc.errors import SolverError, WeightsError
from impc.inverse.equivalent_weights import other_weights
from impc.inverse.estimates import ROUNDING
from impc.inverse.least_squares import triangular_rows
from impc.inverse.problem import misfit, recorded_size, simulated
from impc.inverse.proximal_search import Residual, weight_jacobian
from impc.inverse.proximal_step import block_basis
from impc.inverse.residuals import evaluate
from impc.inverse.solution_set import gain_fibre
from impc.model.riccati import solve_lqr
from impc.model.weights import Weights, condition_number

if TYPE_CHECKING:
    from impc.inverse.equivalent_weights import EquivalentWeights
    from impc.inverse.problem import Problem
    from impc.inverse.residuals import Evaluation
    from impc.inverse.solution_set import GainFibre
    from impc.model.riccati import LqrSolution

# Exact derivatives leave singular values of 1e-13 where nothing is determined.
_DETERMINED = 1e-8


@dataclass(frozen=True)
class OtherWeights:
    """Weights other than the reported ones, and the misfit of the same recordings with them."""

    weights: Weights
    condition: float  # kappa(blkdiag(Q, R))
    misfit: float  # 2-norm of the output residual


@dataclass(frozen=True)
class Identifiability(Frozen):
    """Result of `identifiability`."""

    # Of the outputs' derivative with respect to relative changes of blkdiag(Q, R) (s,), largest
    # first. Relative: in the coordinates D of dX = L D L', X = L L'.
    singular_values: Array
    free: int  # Directions of (Q, R), scale not counted
    # How many of them the recordings determine: singular values above 1e-8 of the largest, and
    # above 1e-10 of the recorded outputs
    rank: int
    chosen: int  # How many the condition number chose: free - rank
    tolerance: float  # That share of the largest
    # Other weights that explain the recordings equally well; empty where they cannot be found in
    # double precision
    others: tuple[OtherWeights, ...]


@checked
def identifiability(problem: Problem, weights: Weights) -> Identifiability:
    """Count what the recordings determine at the given weights.

    Parameters
    ----------
    problem : Problem
    weights : Weights
        Positive definite; the result of a fit.

    Raises
    ------
    WeightsError
        When the weights have no stabilising Riccati solution.

    Examples
    --------
    >>> import impc
    >>> from plants import yalmip_example
    >>> plant = impc.Plant(yalmip_example())
    >>> bounds, weights = impc.Bounds(plant, u_min=-1, u_max=1), impc.Weights([[1, 0], [0, 1]], 1)
    >>> truth = impc.Controller(plant, weights, bounds, horizon=3)
    >>> trial = impc.Recording(plant, truth.simulate([1, 3], steps=20).x)
    >>> told = impc.identifiability(impc.Problem(plant, bounds, 3, [trial]), weights)
    >>> told.free, told.rank, told.chosen
    (3, 2, 1)
    """
    plant = problem.plant
    solution = solve_lqr(plant, weights)
    found = evaluate(problem, solution.K, solution.S)
    factor = np.linalg.cholesky(weights.block)
    basis = factor @ block_basis(plant.n, plant.m) @ factor.T
    values = _singular_values(solution, found, basis)
    least = max(_DETERMINED * values[0], ROUNDING * recorded_size(problem))
    rank = int(np.count_nonzero(values > least))
    free = len(basis) - 1
    metric = solution.S if plant.m > 1 else None
    fibre = gain_fibre(plant, solution.K, metric)
    return Identifiability(
        frozen(values), free, rank, free - rank, _DETERMINED, _others(problem, fibre)
    )


def _singular_values(solution: LqrSolution, found: Evaluation, basis: Array) -> Array:
    """Of the derivative along a `basis` of the weights; all but a few rows are gone before."""
    parts = [found.dK, found.dS]
    rows = triangular_rows([part.reshape(len(part), -1) for part in parts])
    first = int(np.prod(found.dK.shape[1:]))
    dK, dS = (
        columns.reshape(len(rows), *part.shape[1:])
        for columns, part in zip((rows[:, :first], rows[:, first:]), parts, strict=True)
    )
    residual = Residual(np.zeros(len(rows)), dK, dS, usable=True)
    values = np.linalg.svd(weight_jacobian(solution, residual, basis), compute_uv=False)
    # More directions than gain and metric have entries leave the outputs as they are.
    return np.pad(values, (0, min(len(found.residual), len(basis)) - len(values)))


def _others(problem: Problem, fibre: GainFibre) -> tuple[OtherWeights, ...]:
    try:
        return tuple(_explain(problem, item) for item in other_weights(fibre, 2))
    except (WeightsError, SolverError):  # weights at the edge of what a program can tell
        return ()


def _explain(problem: Problem, found: EquivalentWeights) -> OtherWeights:
    solution = solve_lqr(problem.plant, found.weights)
    left = misfit(problem, simulated(problem, solution.K, solution.S))
    return OtherWeights(found.weights, condition_number(found.weights), left)
