"""Structured fit near its solution: derivatives, and covariance of the weights.

As `covariance` for a gain: with J_t the derivative of the outputs at sample t by the unknowns,
after projection on initial states and physical parameters,

    cov = H^-1 cov( sum_t J_t' e_t ) H^-1,      H = sum_t J_t' J_t,

for log cost weights, and for correlations where products of features have cost weights
(`Structure.reported`). A physical parameter moves the gain because the weights stay fixed. A cost
weight of zero is at its bound and left out; `weight_profiles` gives its upper end.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from impc.arrays import Array, BoolArray, Frozen, frozen
from impc.assess.covariance import TWO_SIDED, NoiseModel, Slopes, slopes_at
from impc.assess.long_run_covariance import ResidualNoise, residual_noise, white_noise
from impc.inverse.laws import regulator_slopes
from impc.inverse.problem import Problem
from impc.model.riccati import LqrSolution, solve_lqr
from impc.model.structure import Structure

#: A combination of logarithms is identified if its 95 % interval ends within this factor.
IDENTIFIED_FACTOR = 10.0
# Share of an unknown in a direction without a value, below which it is rounding.
_SHARE = 1e-3


@dataclass(frozen=True)
class Tangent(Slopes):
    """Residual of a structured fit and its derivatives; parameters move it at fixed weights."""

    structure: Structure
    solution: LqrSolution  # Riccati solution of the weights
    cost_weights: Array  # Unknowns (count,); minus infinity is a cost weight of zero
    # Derivative by the unknowns (r, count), or by the cost weight itself where it is zero
    on_cost_weights: Array

    @property
    def moving(self) -> BoolArray:
        """Mask of unknowns other than zero cost weights (count,)."""
        return np.isfinite(self.cost_weights)

    def without_nuisance(self, columns: Array, *beside: Array) -> Array:
        """Columns after projection on initial states, parameters and others."""
        return self.span(np.array(self.on_parameters), *beside).without(columns)


def tangent(
    structure: Structure, problem: Problem, cost_weights: Array, noise: float | None = None
) -> Tangent:
    """Residual and derivatives at `cost_weights` (count,); `noise` as in `slopes_at`."""
    solution = solve_lqr(problem.plant, structure.weights(cost_weights))
    at = slopes_at(problem, np.array(solution.K), np.array(solution.S), noise)
    changes = regulator_slopes(problem, structure, cost_weights, solution)
    seen, beside = np.split(at.on_law @ at.law.along(*changes).T, [structure.count], axis=1)
    given = vars(at) | {"on_parameters": frozen(at.on_parameters + beside)}
    return Tangent(
        **given,
        structure=structure,
        solution=solution,
        cost_weights=frozen(cost_weights),
        on_cost_weights=frozen(seen),
    )


@dataclass(frozen=True)
class WeightCovariance(Frozen):
    """Covariance of the unknowns of a structure, to first order."""

    structure: Structure
    # Reported values: log cost weights (minus infinity: zero), correlations (count,)
    values: Array
    # Of the derivative by free unknowns, nuisance eliminated, largest first (a,)
    singular_values: Array
    directions: Array  # Right singular vectors over all unknowns, one a row (a, count)
    # Standard error along each (a,); infinite below 1e-6 of the largest singular value
    deviations: Array
    # Over all unknowns (count, count), without directions of infinite standard error
    covariance: Array
    # Standard error of each unknown (count,); infinite if unidentified directions contribute or the
    # cost weight is zero
    each: Array
    white: Array  # Covariance for white residuals (count, count)
    noise: ResidualNoise  # Autocorrelation model of the residuals

    @property
    def rank(self) -> int:
        """Number of directions above rounding."""
        return int(np.count_nonzero(np.isfinite(self.deviations)))

    @property
    def identified(self) -> BoolArray:
        """Mask of directions (a,) known to within a factor of `IDENTIFIED_FACTOR` at 95 %."""
        return np.asarray(TWO_SIDED * self.deviations < np.log(IDENTIFIED_FACTOR))

    def spread(self, combination: Array) -> tuple[float, float]:
        """Standard error of a combination (count,), and its ratio to that for white residuals."""
        own, plain = (
            float(np.sqrt(max(float(combination @ matrix @ combination), 0.0)))
            for matrix in (self.covariance, self.white)
        )
        blind = self.directions[~np.isfinite(self.deviations)] @ combination
        if np.linalg.norm(blind) > _SHARE * np.linalg.norm(combination) or plain == 0:
            return np.inf, 1.0
        return own, own / plain


def weight_covariance(
    at: Tangent, noise: NoiseModel = residual_noise, white: NoiseModel = white_noise
) -> WeightCovariance:
    """Covariance of the unknowns of a structured fit, for two noise models."""
    values, chain = at.structure.reported(at.cost_weights)
    moving = at.moving
    slopes = np.linalg.inv(chain[np.ix_(moving, moving)])
    rest = at.span(np.array(at.on_parameters))
    found = at.sandwich(rest.without(at.on_cost_weights[:, moving]) @ slopes, rest, noise)
    plain = at.colour(white, rest.plus(found.unit))
    spreads = found.spread, at.spread(plain, found.unit / found.values[found.usable])
    directions = np.zeros((len(found.values), at.structure.count))
    directions[:, moving] = found.directions
    back = directions[found.usable]
    covariance, plain_covariance = (back.T @ spread @ back for spread in spreads)
    each = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    blind = np.linalg.norm(directions[~found.usable], axis=0) > _SHARE
    each[blind | ~moving] = np.inf
    return WeightCovariance(
        at.structure,
        frozen(values),
        frozen(found.values),
        frozen(directions),
        frozen(found.deviations),
        frozen(covariance),
        frozen(each),
        frozen(plain_covariance),
        found.noise,
    )
