"""Structured fit near its solution: covariance of the weights, quadratic form of the misfit.

As `covariance` for a gain: with J_t the derivative of the outputs at sample t by the unknowns,
after projection on initial states and physical parameters,

    cov = H^-1 cov( sum_t J_t' e_t ) H^-1,      H = sum_t J_t' J_t,

for log cost weights, and for correlations where products of features have cost weights
(`Structure.reported`). A physical parameter moves the gain because the weights stay fixed. A cost
weight of zero is at its bound and left out; `weight_profiles` gives its upper end.

The recordings identify a gain; the nonlinear part is the map from cost weights to gains. Near a fit
the misfit is therefore a quadratic form of gain and metric, computed from one simulation,

    m^2(z) = |q + R (k(z) - k)|^2 + rest,       k = (K, S),

R and q the triangular factor and residual in the columns of k after projection on initial states
and parameters (to first order); `rest` is the part that no nearby gain explains.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.linalg
import scipy.optimize

from impc.arrays import Array, BoolArray, Frozen, frozen
from impc.assess.covariance import TWO_SIDED, by_trial, spread_of_rows
from impc.assess.long_run_covariance import (
    ResidualNoise,
    residual_noise,
    white_noise,
)
from impc.errors import WeightsError
from impc.inverse.columns import trial_span
from impc.inverse.estimates import DETERMINED
from impc.inverse.laws import GainLaw, regulator_slopes
from impc.inverse.problem import noise_of_residual
from impc.inverse.residuals import scaled_changes
from impc.inverse.unknowns import linear_at
from impc.model.riccati import solve_lqr

if TYPE_CHECKING:
    from collections.abc import Callable

    from impc.inverse.columns import TrialSpan
    from impc.inverse.problem import Problem
    from impc.model.riccati import LqrSolution
    from impc.model.structure import Structure

    NoiseModel = Callable[[list[Array], TrialSpan], ResidualNoise]

#: A combination of logarithms is identified if its 95 % interval ends within this factor.
IDENTIFIED_FACTOR = 10.0
# Share of an unknown in a direction without a value, below which it is rounding.
_SHARE = 1e-3
# Prior SD of a log cost weight about the fit: far wider than any finite interval.
_SPREAD = 20.0
_TRIES = 30


@dataclass(frozen=True)
class Tangent(Frozen):
    """Residual of a structured fit and its derivatives."""

    structure: Structure
    problem: Problem  # At the fitted initial states and parameters
    solution: LqrSolution  # Riccati solution of the weights
    cost_weights: Array  # Unknowns (count,); minus infinity is a cost weight of zero
    residual: Array  # (r,)
    reason: str  # Why a simulation stopped; empty if all trials are complete
    law: GainLaw  # At gain and metric of the solution
    on_law: Array  # Derivative by whitened gain and metric (r, c), by initial states and errors
    own: Array
    # Derivative by the unknowns (r, count), or by the cost weight itself where it is zero
    on_cost_weights: Array
    on_parameters: Array  # By the parameters at fixed weights (r, k)
    noise: float  # Noise SD; from recordings, the RMS residual

    @property
    def moving(self) -> BoolArray:
        """Mask of unknowns other than zero cost weights (count,)."""
        return np.isfinite(self.cost_weights)

    def without_nuisance(self, columns: Array, *beside: Array) -> Array:
        """Columns after projection on initial states, parameters and others."""
        return self.span(*beside).without(columns)

    def span(self, *beside: Array) -> TrialSpan:
        """Span of initial states, parameters and columns `beside` (r, b)."""
        sizes = self.problem.row_sizes
        return trial_span(self.own, sizes, np.hstack([self.on_parameters, *beside]))

    def colour(self, model: NoiseModel, fitted: TrialSpan) -> ResidualNoise:
        """Autocorrelation model of the residuals after a fit of the span."""
        rows = sum(self.problem.trial_sizes)
        residuals = by_trial(self.problem, np.array(self.residual))
        return model(residuals, fitted.upper(len(residuals), rows))

    def spread(self, noise: ResidualNoise, columns: Array) -> Array:
        """Covariance (k, k) of columns' residual for this noise."""
        return spread_of_rows(self.problem, noise, columns, self.noise)

    @functools.cached_property
    def quadratic(self) -> LocalQuadratic:
        """Quadratic approximation of the misfit here."""
        return LocalQuadratic(self)


def tangent(
    structure: Structure, problem: Problem, cost_weights: Array, noise: float | None = None
) -> Tangent:
    """Residual and derivatives at `cost_weights` (count,), prior rows last.

    `noise` is the noise SD; None: that of the residual.
    """
    solution = solve_lqr(problem.plant, structure.weights(cost_weights))
    K, S = np.array(solution.K), np.array(solution.S)
    law = GainLaw(problem, K, S)
    found = linear_at(problem, law, law.start)
    size = float(np.sqrt(np.mean(found.residual**2))) if noise is None else noise
    scale = noise_of_residual(problem, found.residual) if noise is None else noise
    found = found.with_prior(problem, scale)
    on_law, on_parameters, own = found.parts(problem)
    seen = on_law @ law.along(*regulator_slopes(problem, structure, cost_weights, solution)).T
    count = structure.count
    return Tangent(
        structure,
        problem,
        solution,
        frozen(cost_weights),
        frozen(found.residual),
        found.reason,
        law,
        frozen(on_law),
        frozen(own),
        frozen(seen[:, :count]),
        frozen(on_parameters + seen[:, count:]),
        size,
    )


class LocalQuadratic:
    """Quadratic form of gain and metric that approximates the misfit near a tangent."""

    def __init__(self, at: Tangent) -> None:
        #: Trace of the metric over m.
        self.at, self.scale = at, float(np.trace(at.solution.S)) / at.problem.plant.m
        seen = at.without_nuisance(np.array(at.on_law))
        residual = at.without_nuisance(np.array(at.residual)[:, None])[:, 0]
        self.triangle: Array = np.asarray(np.linalg.qr(seen, mode="r"), dtype=np.float64)
        # R'q = columns' residual.
        self.inside = np.linalg.pinv(self.triangle.T) @ (seen.T @ residual)
        self.rest = float(residual @ residual - self.inside @ self.inside)

    def least(self, z: Array, along: Array, aim: LqrSolution | None = None) -> tuple[float, Array]:
        """Least m^2 from z over steps along columns, and its minimiser.

        With `aim`, the distance to that regulator takes the place of the misfit.
        """
        moving = np.isfinite(z)
        offset, rest = self.inside, self.rest
        if aim is not None:
            offset, rest = -self._away(aim), 0.0
        weight, rows = self.at.noise / _SPREAD, len(self.triangle)

        def moved(step: Array) -> Array:
            there = z.copy()
            there[moving] += along @ step
            return there

        @functools.lru_cache(maxsize=1)  # scipy asks for residual and derivative separately
        def seen(numbers: tuple[float, ...]) -> tuple[Array, Array]:
            step = np.array(numbers)
            prior = weight * np.eye(len(step))
            try:
                value, slopes = self._form(moved(step), moving)
            except WeightsError:  # a derivative is used only at the start: the search ends there
                far = np.full(rows + len(step), 1e6 * self.at.noise)
                return far, np.vstack([np.zeros((rows, len(step))), prior])
            return np.append(offset + value, weight * step), np.vstack([slopes @ along, prior])

        def residual(step: Array) -> Array:
            return seen(tuple(step))[0]

        def derivative(step: Array) -> Array:
            return seen(tuple(step))[1]

        step: Array = np.zeros(along.shape[1])
        if len(step):
            step = scipy.optimize.least_squares(
                residual, step, jac=derivative, ftol=1e-6, max_nfev=_TRIES
            ).x
        data = residual(step)[:rows]
        return float(data @ data) + rest, moved(step)

    def _form(self, z: Array, moving: Array) -> tuple[Array, Array]:
        """R (k(z) - k) and its derivative by the free unknowns."""
        problem, structure = self.at.problem.with_nuisance_fixed(), self.at.structure
        solution = solve_lqr(problem.plant, structure.weights(z))
        dK, dS = regulator_slopes(problem, structure, z, solution)
        turned = self.scale * scaled_changes(np.array(solution.S), dS[moving])
        return self._away(solution), self.triangle @ self.at.law.along(dK[moving], turned).T

    def _away(self, solution: LqrSolution) -> Array:
        """R (k - k(fit)) of another regulator."""
        here, S = self.at.solution, np.array(solution.S)
        metric = self.scale * len(S) / np.trace(S) * S - here.S
        return np.asarray(
            self.triangle @ self.at.law.along((solution.K - here.K)[None], metric[None])[0]
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
