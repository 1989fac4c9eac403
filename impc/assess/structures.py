"""Fit and test cost structures: intervals, score test, comparison by AIC.

Each structure is fitted, starting from the fitted weights, and again without each trial. Akaike's
criterion is that of the innovations of the residuals (`variance_accounted_for`), plus 2 for each
identified combination of unknowns (docs/howto/weights.md).

The score test compares a structure with an unrestricted gain, for autocorrelated residuals. At the
fit of the structure the residual e has no part along its columns. Let U be an orthonormal basis of
what a free gain adds beyond these, initial states and parameters. If the structure holds,

    T = (U'e)' V^-1 U'e,      V = cov(U'e) for the autocorrelation of the residuals

is chi-squared with as many degrees of freedom as U has columns. No fit outside the structure is
needed. Only directions of the gain are used that the recordings identify (`covariance.IDENTIFIED`),
which depends on derivatives and not on e. A zero cost weight contributes the direction towards
negative values: a structure that needs negative cost weights is rejected too.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import scipy.stats

from impc.arrays import Array, Frozen, frozen
from impc.assess.assessments import evaluate_method
from impc.assess.long_run_covariance import residual_noise
from impc.assess.structured_weights import Tangent, WeightCovariance, tangent, weight_covariance
from impc.assess.variance_accounted_for import (
    innovation_roots,
    innovations_criterion,
    predicted,
)
from impc.assess.weight_profiles import WeightInterval, WeightProfiles
from impc.inverse.estimates import Estimate
from impc.inverse.problem import EXPLAINED, Problem, recorded_size
from impc.inverse.refit import IDENTIFIED
from impc.inverse.structured import feature_sizes, search_from
from impc.model.recordings import Recording
from impc.model.riccati import solve_lqr
from impc.model.structure import Structure
from impc.model.weights import Weights


@dataclass(frozen=True)
class Ratio:
    """Cost ratio of two features at their RMS in the recordings."""

    first: str  # Labels of the features
    second: str
    interval: WeightInterval  # Interval of the log ratio


@dataclass(frozen=True)
class StructureFit(Frozen):
    """Structure fitted to recordings, with its uncertainty and test."""

    structure: Structure
    estimate: Estimate | None  # None if no controller of it can be simulated
    reason: str  # Why there is none; otherwise empty
    # RMS of each state feature in the simulation (k,), in its unit
    sizes: Array
    effort: float  # Mean square of the first input feature
    covariance: WeightCovariance | None
    # For each unknown as reported: log cost weight or correlation
    intervals: tuple[WeightInterval, ...]
    # For each pair of penalised features, unless products are penalised too
    ratios: tuple[Ratio, ...]
    test: StructureTest | None
    vaf: Array  # Over all trials, per output (p,), %
    held_out: Array  # Mean over held-out trials per output (p,), %; NaN without
    aic: float  # Akaike's criterion

    @property
    def refused(self) -> bool:
        """Whether the recordings reject the structure, or it cannot be simulated."""
        return self.test is None or self.test.refused

    @property
    def identified(self) -> int:
        """Number of identified combinations of its unknowns."""
        return 0 if self.covariance is None else int(np.count_nonzero(self.covariance.identified))


def no_structure(structure: Structure, outputs: int, reason: str) -> StructureFit:
    """Result for a structure that cannot be simulated, with the `reason`."""
    nothing, missing = frozen(np.full(outputs, np.nan)), frozen(np.zeros(0))
    return StructureFit(
        structure, None, reason, missing, np.nan, None, (), (), None, nothing, nothing, np.inf
    )


def assess_structure(
    problem: Problem,
    structure: Structure,
    found: Estimate,
    near: Estimate,
    settle: float,
    *,
    held_out: bool,
) -> StructureFit:
    """Compute intervals, test, VAF and AIC of a fitted structure."""
    there, cost_weights = found.problem, np.array(found.cost_weights)
    at = tangent(structure, there, cost_weights)
    covariance = weight_covariance(at)
    sizes = feature_sizes(there, structure, np.array(found.gain), np.array(found.metric))
    own = evaluate_method(found, there.bounds)
    started = problem.at(there.starts, there.logarithms, there.errors)

    def left_out(index: int, trial: Recording) -> Array:
        """VAF (p,) of a trial under the cost weights that the others have."""
        end = search_from(started.leaving_out(index), structure, _moving(cost_weights))
        return np.array(predicted(end.problem, end.K, end.S, trial, settle).vaf)

    trials = problem.recordings if held_out and len(problem.recordings) > 1 else ()
    left = [left_out(index, trial) for index, trial in enumerate(trials)]
    nothing = np.full(len(problem.plant.outputs), np.nan)
    intervals, ratios = _intervals(at, covariance, sizes)
    return StructureFit(
        structure,
        found,
        "",
        frozen(sizes),
        float(np.mean((own.commands @ structure.input_features[0]) ** 2)),
        covariance,
        intervals,
        ratios,
        structure_test(at),
        own.vaf,
        frozen(np.mean(left, axis=0) if left else nothing),
        innovations_criterion(
            found, innovation_roots(near), int(np.count_nonzero(covariance.identified))
        ),
    )


def _moving(cost_weights: Array) -> Array:
    """Replace zero cost weights by small ones, so that a search can increase them."""
    least = np.min(cost_weights[np.isfinite(cost_weights)])
    return np.where(np.isfinite(cost_weights), cost_weights, least - np.log(100.0))


def _intervals(
    at: Tangent, covariance: WeightCovariance, sizes: Array
) -> tuple[tuple[WeightInterval, ...], tuple[Ratio, ...]]:
    structure, rows = at.structure, np.eye(at.structure.count)
    profiles = WeightProfiles(at, covariance)
    intervals = profiles.unknowns()
    if structure.coupled or structure.input_coupled:
        return intervals, ()
    ratios = []
    for i, j in itertools.permutations(np.flatnonzero(at.moving[: len(structure.labels)]), 2):
        shift = 2 * float(np.log(sizes[i] / sizes[j]))
        if at.cost_weights[i] - at.cost_weights[j] + shift >= 0:  # larger cost first
            found = profiles.interval(rows[i] - rows[j]).shifted(shift)
            ratios.append(Ratio(structure.labels[i], structure.labels[j], found))
    return intervals, tuple(ratios)


#: Level of the test.
SIGNIFICANCE = 0.05
# Size of the tested cross term, relative to the geometric mean of both cost weights.
_CROSS = 0.5


@dataclass(frozen=True)
class CrossTerm:
    """Departure from the structure, and the power of the test against it."""

    # Features with a cross term of half the geometric mean of their cost weights
    first: str
    second: str
    power: float  # Probability that the test rejects at its level, between 0 and 1


@dataclass(frozen=True)
class StructureTest(Frozen):
    """Result of `structure_test`."""

    statistic: float  # T
    # Degrees of freedom; 0 if the recordings identify nothing of the gain beyond the structure, or
    # the fit is exact
    freedom: int
    # p-value; 1 if there is nothing to test
    probability: float
    powers: tuple[CrossTerm, ...]  # For each pair of penalised features

    @property
    def refused(self) -> bool:
        """Whether the recordings reject the structure at the 5 % level."""
        return self.probability < SIGNIFICANCE


def structure_test(at: Tangent) -> StructureTest:
    """Score test of a structure at its fit against an unrestricted gain."""
    fitted = at.span(np.array(at.on_parameters), np.array(at.on_cost_weights[:, at.moving]))
    beyond = fitted.without(np.array(at.on_law[:, : at.solution.K.size]))
    left, sizes, _ = np.linalg.svd(beyond, full_matrices=False)
    identified = sizes > at.noise / IDENTIFIED
    U = left[:, identified]
    exact = EXPLAINED * recorded_size(at.problem)
    if U.shape[1] == 0 or np.linalg.norm(at.residual) <= exact:
        return StructureTest(0.0, 0, 1.0, ())
    V = at.spread(at.colour(residual_noise, fitted), U)
    score = U.T @ at.residual
    statistic = float(score @ np.linalg.solve(V, score))
    freedom = U.shape[1]
    return StructureTest(
        statistic,
        freedom,
        float(scipy.stats.chi2.sf(statistic, freedom)),
        _powers(at, U, V),
    )


def _powers(at: Tangent, U: Array, V: Array) -> tuple[CrossTerm, ...]:
    """Power of the test against cross terms, to first order."""
    structure, given = at.structure, at.solution
    if structure.coupled:
        return ()
    penalised, freedom = np.flatnonzero(at.moving[: len(structure.labels)]), len(V)
    quantile = float(scipy.stats.chi2.ppf(1 - SIGNIFICANCE, freedom))
    found = []
    for i, j in itertools.combinations(penalised, 2):
        one, other = structure.features[i], structure.features[j]
        half = _CROSS * np.exp((at.cost_weights[i] + at.cost_weights[j]) / 2)
        crossed = Weights(
            given.weights.Q + half * (np.outer(one, other) + np.outer(other, one)), given.weights.R
        )
        there = solve_lqr(at.problem.plant, crossed)
        change = at.law.along((there.K - given.K)[None], (there.S - given.S)[None])[0]
        apart = U.T @ (at.on_law @ change)
        distance = float(apart @ np.linalg.solve(V, apart))
        power = float(scipy.stats.ncx2.sf(quantile, freedom, distance))
        found.append(CrossTerm(structure.labels[i], structure.labels[j], power))
    return tuple(found)
