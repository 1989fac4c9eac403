"""Test whether any cost weights explain the gain, and count identified directions.

    D = d' V^-1 d,    d = K - K(Q, R) along the identified directions

K is the best unrestricted gain, K(Q, R) the gain of the fitted weights, V the HAC covariance of K
along these directions. If the true gain belongs to some weights, D is at most chi-squared with as
many degrees of freedom as directions: it is zero where K itself has weights. So is the likelihood
ratio N log(misfit of the weights^2 / misfit of K^2). If both are larger, all weights are rejected,
and then no statement about the intent holds. If only D is larger, V is too small: near a limit the
curvature at K can be that of a crease, and intervals of K are too narrow.
If the residuals contradict the model itself, noise is not the only source of gain errors: weights
are then rejected only if their misfit is also more than 5 % larger.

Whether weights have K itself is a linear matrix inequality. With one input and an invertible A, the
return difference of an optimal regulator explains the result (docs/why/theory.md):

    |1 + K (zI - A)^-1 B|^2  >=  R / S  =  det(A - BK) / det A      for all |z| = 1.

The closed loop depends on (Q, R) only through K and S up to scale, so the derivative of the outputs
by the weights has rank at most n m + m (m + 1)/2 - 1 for any recording (n m + m - 1 if B has full
column rank). The condition number fixes the other directions by convention.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.special

from impc.arrays import Array, frozen
from impc.assess.printed_gain import GainEstimate
from impc.checking import checked
from impc.errors import SolverError, WeightsError
from impc.inverse.equivalent_weights import other_weights, weights_margin
from impc.inverse.estimates import ROUNDING, Estimate, Identifiability, OtherWeights
from impc.inverse.problem import Problem, misfit, recorded_size, simulated
from impc.inverse.proximal_search import weight_jacobian
from impc.inverse.proximal_step import block_basis
from impc.inverse.solution_set import GainFibre, gain_fibre
from impc.inverse.table31 import closed_loop_residual
from impc.model.plant import Plant
from impc.model.riccati import solve_lqr
from impc.model.weights import Weights

# p-value below which weights are rejected.
_LEVEL = 1e-3
# Relative misfit that weights must exceed if the residuals contradict the model.
_MORE = 1.05
_FREQUENCIES = 2000


@dataclass(frozen=True)
class ReturnDifference:
    """Return-difference inequality (one input)."""

    least: float  # min |1 + K (zI - A)^-1 B|^2, then det(A - BK) / det A
    needed: float
    frequency: float  # Frequency of the minimum, Hz

    @property
    def kept(self) -> bool:
        """Whether the inequality holds, to rounding."""
        return self.least >= self.needed * (1 - 1e-9)


@dataclass(frozen=True)
class WeightsTest:
    """Result of `weights_test`."""

    statistic: float  # D
    likelihood_ratio: float  # Increase of -2 log likelihood from K to the gain of the weights
    freedom: int  # Number of identified directions of the gain
    p_value: float  # Approximate: chi-squared, of the smaller of the two statistics
    more: float  # Misfit of the weights over that of the gain
    contradicted: bool  # Whether the residuals contradict the model
    exist: bool  # Whether positive definite weights have the identified gain exactly
    difference: ReturnDifference | None  # For that gain; one input and invertible A only

    @property
    def rejected(self) -> bool:
        """Whether all cost weights are rejected as an explanation of the gain."""
        return self.p_value < _LEVEL and (not self.contradicted or self.more > _MORE)

    @property
    def conflicting(self) -> bool:
        """Whether D rejects weights that explain the recordings about as well as the gain."""
        known = not self.contradicted and not self.rejected
        return known and _p_value(self.statistic, self.freedom) < _LEVEL

    @property
    def conflict(self) -> str:
        """The two statistics in words."""
        return (
            f"Cost weights with another gain explain the recordings about as well (chi-squared "
            f"{self.likelihood_ratio:.3g}), but by the standard errors of the gain they should be "
            f"much worse ({self.statistic:.3g})."
        )

    @property
    def sentence(self) -> str:
        """Conclusion if weights are rejected; otherwise empty."""
        if not self.rejected:
            return ""
        text = (
            "No cost weights explain this gain: the nearest gain that has cost weights differs "
            f"from it along {self.freedom} identified directions (chi-squared "
            f"{self.statistic:.3g})."
        )
        found = self.difference
        if found is None or found.kept:
            return text
        return (
            f"{text} An optimal controller has a squared return difference of at least "
            f"{found.needed:.3g} at every frequency; here it is {found.least:.3g} at "
            f"{found.frequency:.3g} Hz."
        )


def weights_test(
    fitted: Estimate, estimate: GainEstimate, *, contradicted: bool = False
) -> WeightsTest:
    """Compare the gain of the fitted weights with the identified gain."""
    covariance, plant = estimate.covariance, estimate.problem.plant
    identified, exact = covariance.identified, fitted.explained
    # Divided by its standard errors, V is well scaled.
    sizes, usable = covariance.deviations[identified], np.isfinite(covariance.deviations)
    V = covariance.spread[np.ix_(identified[usable], identified[usable])] / np.outer(sizes, sizes)
    d = covariance.along(estimate.K - fitted.gain)[identified] / sizes
    statistic = 0.0 if exact else float(d @ np.linalg.solve(V, d))
    freedom = len(d)
    try:
        exist = weights_margin(gain_fibre(plant, estimate.K)).exist
    except (WeightsError, SolverError):  # unstable, or numerically undecided
        exist = False
    more = 1.0 if exact else fitted.misfit / estimate.misfit
    ratio = max(0.0, 2 * estimate.problem.recorded_numbers * float(np.log(more)))
    p_value = _p_value(min(statistic, ratio), freedom)
    difference = return_difference(plant, estimate.K)
    return WeightsTest(statistic, ratio, freedom, p_value, more, contradicted, exist, difference)


def _p_value(statistic: float, freedom: int) -> float:
    return float(scipy.special.chdtrc(freedom, statistic)) if freedom else 1.0


def return_difference(plant: Plant, gain: Array) -> ReturnDifference | None:
    """Return-difference inequality of a gain (1, n); None for several inputs or singular A."""
    A, B, n = plant.A, plant.B, plant.n
    if plant.m > 1 or np.linalg.matrix_rank(A) < n:
        return None
    angles = np.linspace(0, np.pi, _FREQUENCIES)
    circle = np.exp(1j * angles)[:, None, None] * np.eye(n)
    with np.errstate(divide="ignore", invalid="ignore"):  # unbounded at a pole
        sizes = np.abs(np.linalg.det(circle - A + B @ gain) / np.linalg.det(circle - A)) ** 2
    place = int(np.nanargmin(sizes))
    needed = float(np.linalg.det(A - B @ gain) / np.linalg.det(A))
    return ReturnDifference(
        float(sizes[place]), needed, float(angles[place] / (2 * np.pi * plant.dt))
    )


# Exact derivatives leave singular values of 1e-13 in unidentified directions.
_DETERMINED = 1e-8


@checked
def identifiability(problem: Problem, weights: Weights) -> Identifiability:
    """Count the weight directions that the recordings identify.

    Parameters
    ----------
    problem : Problem
        Recordings and closed loop.
    weights : Weights
        Positive definite weights, such as the result of a fit.

    Returns
    -------
    Identifiability
        `free` directions of (Q, R) without scale, `rank` identified ones, `chosen` = free - rank
        fixed by convention, singular values, and examples of other weights with the same gain.

    Raises
    ------
    WeightsError
        If the weights have no stabilising Riccati solution.

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
    factor = np.linalg.cholesky(weights.block)
    basis = factor @ block_basis(plant.n, plant.m) @ factor.T
    found, _ = closed_loop_residual(problem, solution)
    slopes = weight_jacobian(solution, found, basis)
    values = np.asarray(np.linalg.svd(slopes, compute_uv=False))
    least = max(_DETERMINED * values[0], ROUNDING * recorded_size(problem))
    rank = int(np.count_nonzero(values > least))
    free = len(basis) - 1
    metric = solution.S if plant.m > 1 else None
    fibre = gain_fibre(plant, solution.K, metric)
    return Identifiability(
        frozen(values), free, rank, free - rank, _DETERMINED, _others(problem, fibre)
    )


def estimate_identifiability(estimate: Estimate) -> Identifiability:
    """Count the weight directions that the recordings identify; see `impc.identifiability`."""
    return identifiability(estimate.problem, estimate.stage_weights)


def _others(problem: Problem, fibre: GainFibre) -> tuple[OtherWeights, ...]:
    found = []
    try:
        for item in other_weights(fibre, 2):
            solution = solve_lqr(problem.plant, item.weights)
            left = misfit(problem, simulated(problem, solution.K, solution.S))
            found.append(OtherWeights(item.weights, left))
    except (WeightsError, SolverError):  # numerically at the edge of the cone
        return ()
    return tuple(found)
