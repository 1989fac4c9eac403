"""Whether any cost weights explain the gain that recordings identify, and how far they do.

    D = sum over identified directions i of  ((K - K(Q, R)) along i / s_i)^2

K is the best gain of any kind, K(Q, R) the best one that weights have, s_i the standard errors for
noise of the colour that the residuals show. If the true gain is that of some weights, D is at most
chi-squared with as many degrees of freedom as there are directions. If D is much larger, no weights
explain the recordings, and what any of them say of the subject's intent is void. Where residuals
contradict the model itself, noise is not all that moves the gain: then weights have to leave more
than a twentieth more, too.

Whether weights have K itself is a linear matrix inequality. With one input and an invertible A
there is an explanation: the return difference of an optimal regulator keeps (docs/theory.md,
section 2)

    |1 + K (zI - A)^-1 B|^2  >=  R / S  =  det(A - BK) / det A      for all |z| = 1.

The closed loop depends on (Q, R) through K and the scale-free S only, so the derivative of the
outputs with respect to the weights has at most n m + m (m + 1)/2 - 1 directions, whatever was
recorded (n m + m - 1 when A is invertible). The rest of them was chosen by the condition number.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.special

from impc.arrays import Array, Frozen, frozen
from impc.checking import checked
from impc.errors import SolverError, WeightsError
from impc.inverse.equivalent_weights import other_weights, weights_margin
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
    from impc.arrays import Array
    from impc.assess.printed_gain import GainEstimate
    from impc.inverse.equivalent_weights import EquivalentWeights
    from impc.inverse.estimates import Estimate
    from impc.inverse.problem import Problem
    from impc.inverse.residuals import Evaluation
    from impc.inverse.solution_set import GainFibre
    from impc.model.plant import Plant
    from impc.model.riccati import LqrSolution


# Probability below which the true gain is said to have no weights.
_LEVEL = 1e-3
# How much more, of the misfit, weights have to leave where the model is contradicted.
_MORE = 1.05
_FREQUENCIES = 2000


@dataclass(frozen=True)
class ReturnDifference:
    """The inequality of one input."""

    least: float  # The least |1 + K (zI - A)^-1 B|^2, and det(A - BK) / det A
    needed: float
    frequency: float  # Where it is least, Hz

    @property
    def kept(self) -> bool:
        """Whether it holds, to rounding."""
        return self.least >= self.needed * (1 - 1e-9)


@dataclass(frozen=True)
class WeightsTest:
    """Result of `weights_test`."""

    statistic: float  # D
    freedom: int  # Directions of the gain that are identified
    p_value: float  # Of chi-squared: an upper limit
    more: float  # Misfit of the weights, of that of the gain
    contradicted: bool  # Whether the residuals contradict the model
    exist: bool  # Whether positive definite weights have the identified gain itself
    difference: ReturnDifference | None  # Of that gain, with one input and an invertible A

    @property
    def rejected(self) -> bool:
        """Whether no cost weights explain the gain."""
        return self.p_value < _LEVEL and (not self.contradicted or self.more > _MORE)

    @property
    def sentence(self) -> str:
        """The finding where weights are rejected; empty otherwise."""
        if not self.rejected:
            return ""
        text = (
            "No cost weights explain this gain: the nearest that has any differs from it by "
            f"chi-squared {self.statistic:.3g} along {self.freedom} identified directions."
        )
        found = self.difference
        if found is None or found.kept:
            return text
        return (
            f"{text} An optimal controller has a return difference of {found.needed:.3g} or more "
            f"at every frequency; here it is {found.least:.3g} at {found.frequency:.3g} Hz."
        )


def weights_test(
    fitted: Estimate, estimate: GainEstimate, *, contradicted: bool = False
) -> WeightsTest:
    """Compare the gain of the fitted weights with the gain that is identified."""
    covariance, plant = estimate.covariance, estimate.problem.plant
    identified = covariance.identified
    steps = covariance.along(estimate.K - fitted.gain)[identified]
    exact = fitted.explained
    statistic = 0.0 if exact else float(np.sum((steps / covariance.deviations[identified]) ** 2))
    freedom = int(np.count_nonzero(identified))
    p_value = float(scipy.special.chdtrc(freedom, statistic)) if freedom else 1.0
    try:
        exist = weights_margin(gain_fibre(plant, estimate.K)).exist
    except (WeightsError, SolverError):  # unstable, or at the edge of what a program can determine
        exist = False
    more = 1.0 if exact else fitted.misfit / estimate.misfit
    difference = return_difference(plant, estimate.K)
    return WeightsTest(statistic, freedom, p_value, more, contradicted, exist, difference)


def return_difference(plant: Plant, gain: Array) -> ReturnDifference | None:
    """The inequality at a gain (1, n); None for several inputs, or a singular A."""
    A, B, n = plant.A, plant.B, plant.n
    if plant.m > 1 or np.linalg.matrix_rank(A) < n:
        return None
    angles = np.linspace(0, np.pi, _FREQUENCIES)
    circle = np.exp(1j * angles)[:, None, None] * np.eye(n)
    with np.errstate(divide="ignore", invalid="ignore"):  # at a pole the ratio has no bound
        sizes = np.abs(np.linalg.det(circle - A + B @ gain) / np.linalg.det(circle - A)) ** 2
    place = int(np.nanargmin(sizes))
    needed = float(np.linalg.det(A - B @ gain) / np.linalg.det(A))
    return ReturnDifference(
        float(sizes[place]), needed, float(angles[place] / (2 * np.pi * plant.dt))
    )


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
    >>> identified = impc.identifiability(impc.Problem(plant, bounds, 3, [trial]), weights)
    >>> identified.free, identified.rank, identified.chosen
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
    except (WeightsError, SolverError):  # weights at the edge of what a program can determine
        return ()


def _explain(problem: Problem, found: EquivalentWeights) -> OtherWeights:
    solution = solve_lqr(problem.plant, found.weights)
    left = misfit(problem, simulated(problem, solution.K, solution.S))
    return OtherWeights(found.weights, condition_number(found.weights), left)
