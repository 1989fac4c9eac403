"""How far the weights of a structure are identified: deviations for any colour of the residuals.

As `covariance` has it for a gain: with J_t the derivative of the outputs at sample t with respect
to the unknowns, once initial states and physical parameters have taken what they can,

    cov = H^-1 cov( sum_t J_t' e_t ) H^-1,      H = sum_t J_t' J_t,

of the logarithms of cost weights, and of the correlations where products of features have cost
weights too (`Structure.reported`). A physical parameter moves the gain too, because the weights
stay. A cost weight of zero is at its limit and is left out; `weight_profiles` gives its upper end
(docs/structures.md).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Array, BoolArray, Frozen, frozen
from impc.assess.covariance import TWO_SIDED, by_trial, spread_of_rows
from impc.assess.long_run_covariance import (
    ResidualNoise,
    residual_noise,
    white_noise,
)
from impc.inverse.coordinates import metric_directions
from impc.inverse.estimates import DETERMINED
from impc.inverse.least_squares import trial_span
from impc.inverse.problem import noise_of_residual
from impc.inverse.residuals import evaluate, with_prior_rows
from impc.inverse.solution_set import natural_coordinates
from impc.inverse.structured_search import regulator_slopes
from impc.model.riccati import solve_lqr

if TYPE_CHECKING:
    from collections.abc import Callable

    from impc.inverse.least_squares import TrialSpan
    from impc.inverse.problem import Problem
    from impc.inverse.residuals import Evaluation
    from impc.model.riccati import LqrSolution
    from impc.model.structure import Structure

    NoiseModel = Callable[[list[Array], TrialSpan], ResidualNoise]

#: A combination of logarithms is identified when its interval of 95 % ends within this factor.
IDENTIFIED_FACTOR = 10.0
# Of an unknown: a smaller share in a direction without a value is rounding's.
_SHARE = 1e-3


@dataclass(frozen=True)
class Tangent(Frozen):
    """The residual of a structured fit, and where it can move."""

    structure: Structure
    problem: Problem  # At the initial states and the parameters
    solution: LqrSolution  # The regulator of the weights
    cost_weights: Array  # Unknowns (count,); minus infinity is a cost weight of zero
    residual: Array  # (r,)
    found: Evaluation
    # Derivative with respect to the unknowns (r, count), or to a cost weight itself where it is
    # zero
    on_cost_weights: Array
    on_parameters: Array  # With respect to the parameters, the weights held (r, k)
    noise: float  # Root-mean-square of the noise: of the residual, where recordings were made

    @property
    def moving(self) -> BoolArray:
        """Unknowns that are not cost weights of zero (count,)."""
        return np.isfinite(self.cost_weights)

    def without_nuisance(self, columns: Array, *beside: Array) -> Array:
        """What initial states, parameters and others cannot make up of columns."""
        return self.span(*beside).without(columns)

    def span(self, *beside: Array) -> TrialSpan:
        """What initial states, parameters and columns `beside` (r, b) can make up."""
        sizes = self.problem.row_sizes
        return trial_span(self.found.own, sizes, np.hstack([self.on_parameters, *beside]))

    def colour(self, model: NoiseModel, fitted: TrialSpan) -> ResidualNoise:
        """That of the residuals that a fit of all in a span leaves."""
        rows = sum(self.problem.trial_sizes)
        residuals = by_trial(self.problem, np.array(self.residual))
        return model(residuals, fitted.upper(len(residuals), rows))

    def spread(self, noise: ResidualNoise, columns: Array) -> Array:
        """Covariance of columns' residual (k, k) for noise of a colour."""
        return spread_of_rows(self.problem, noise, columns, self.noise)

    def gain_columns(self) -> tuple[Array, Array]:
        """Derivatives with respect to gain and metric."""
        gain, metric = np.array(self.solution.K), np.array(self.solution.S)
        T, G = natural_coordinates(self.problem.plant, gain)
        on_metric = self.found.along_metric(metric, metric_directions(metric))
        return self.found.along_gain(T, G), on_metric


def tangent(
    structure: Structure, problem: Problem, cost_weights: Array, noise: float | None = None
) -> Tangent:
    """Residual and derivatives at `cost_weights` (count,) and a problem's other unknowns.

    The last rows are those of stated uncertainties. The `noise` is that of the residual if omitted.
    """
    solution = solve_lqr(problem.plant, structure.weights(cost_weights))
    K, S = np.array(solution.K), np.array(solution.S)
    found = evaluate(problem, K, S)
    size = float(np.sqrt(np.mean(found.residual**2))) if noise is None else noise
    scale = noise_of_residual(problem, found.residual) if noise is None else noise
    found = with_prior_rows(problem, found, scale)
    dK, dS = regulator_slopes(problem, structure, cost_weights, solution)
    seen = found.dK.reshape(len(found.residual), -1) @ dK.reshape(len(dK), K.size).T
    seen += found.along_metric(S, dS)
    count = structure.count
    return Tangent(
        structure,
        problem,
        solution,
        frozen(cost_weights),
        frozen(found.residual),
        found,
        frozen(seen[:, :count]),
        frozen(found.dparameters + seen[:, count:]),
        size,
    )


@dataclass(frozen=True)
class WeightCovariance(Frozen):
    """What the recordings say of the unknowns of a structure, to first order."""

    structure: Structure
    # As identified: logarithms of cost weights, and correlations (count,); minus infinity for a
    # cost weight of 0
    values: Array
    # Of the residual's derivative with respect to those that move, once initial states and
    # parameters have taken what they can; largest first (a,)
    singular_values: Array
    directions: Array  # Right singular vectors over all unknowns, one a row (a, count)
    # Standard deviation along each (a,); infinite below 1e-6 of the largest singular value
    deviations: Array
    # Over all unknowns (count, count), without the directions that have no deviation
    covariance: Array
    # Standard deviation of each unknown (count,); infinite where a direction without a value takes
    # part, and for a cost weight of zero
    each: Array
    white: Array  # The covariance as if the residuals were white (count, count)
    noise: ResidualNoise  # The colour of the residuals

    @property
    def rank(self) -> int:
        """Number of directions above rounding."""
        return int(np.count_nonzero(np.isfinite(self.deviations)))

    @property
    def identified(self) -> BoolArray:
        """Which directions are known to within a factor of `IDENTIFIED_FACTOR` at 95 % (a,)."""
        return np.asarray(TWO_SIDED * self.deviations < np.log(IDENTIFIED_FACTOR))

    def spread(self, combination: Array) -> tuple[float, float]:
        """Deviation of a combination of unknowns (count,), and over that for white residuals."""
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
    """Covariance of the unknowns of a structured fit; `noise, white` (samples, p)."""
    values, chain = at.structure.reported(at.cost_weights)
    moving = at.moving
    slopes = np.linalg.inv(chain[np.ix_(moving, moving)])
    beside = at.span()
    seen = beside.without(at.on_cost_weights[:, moving]) @ slopes
    _, sizes, rows = np.linalg.svd(seen, full_matrices=False)
    usable = sizes > DETERMINED * np.max(sizes, initial=0.0)
    unit = seen @ rows[usable].T / sizes[usable]
    fitted = beside.plus(unit)
    colour, along = at.colour(noise, fitted), unit / sizes[usable]
    spread, plain = (at.spread(kind, along) for kind in (colour, at.colour(white, fitted)))
    deviations = np.full(len(sizes), np.inf)
    deviations[usable] = _roots(spread)
    directions = np.zeros((len(sizes), at.structure.count))
    directions[:, moving] = rows
    back = directions[usable]
    covariance = back.T @ spread @ back
    each = _roots(covariance)
    blind = np.linalg.norm(directions[~usable], axis=0) > _SHARE
    each[blind | ~moving] = np.inf
    return WeightCovariance(
        at.structure,
        frozen(values),
        frozen(sizes),
        frozen(directions),
        frozen(deviations),
        frozen(covariance),
        frozen(each),
        frozen(back.T @ plain @ back),
        colour,
    )


def _roots(covariance: Array) -> Array:
    return np.asarray(np.sqrt(np.maximum(np.diag(covariance), 0.0)))
