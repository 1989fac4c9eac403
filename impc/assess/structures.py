"""What recordings say of structures: weights with intervals, whether each is true, which is better.

Each structure is fitted from the weights that fit at all, and again without each trial in turn. The
criterion is Akaike's for the innovations of the residuals (`variance_accounted_for`), with two
combination of unknowns that the recordings identify (docs/structures.md).

Is a structure true? A score test of it against any gain, for residuals of any colour.

At the fit of the structure the residual e has no part along the structure's own columns. Let U be
an orthonormal basis of what the gain, moved freely, could do to the outputs beyond that, and beyond
initial states and parameters. If the structure holds, U'e is a sum of noise alone, and

    T = (U'e)' V^-1 U'e,      V = cov(U'e) for the colour that the residuals show

is chi-squared with as many degrees of freedom as U has columns (docs/structures.md). Nothing is
fitted outside of the structure: a free gain drifts along what is hardly identified, and a ratio
of misfits is no chi-squared for coloured residuals. Only directions are used that the recordings
say of a gain (`covariance.IDENTIFIED`), which depends on their derivatives and not on e. What a
cost weight of zero would do below zero is one of them: a structure is refused too when it wants
negative cost weights.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.stats

from impc.arrays import Array, Frozen, frozen
from impc.assess.covariance import IDENTIFIED
from impc.assess.long_run_covariance import residual_noise
from impc.assess.printed_gain import LEVEL
from impc.assess.structured_weights import WeightCovariance, tangent, weight_covariance
from impc.assess.variance_accounted_for import (
    innovations_criterion,
    left_out_vaf,
    residuals_of,
    vaf,
)
from impc.assess.weight_profiles import NearFit, WeightInterval, WeightProfiles
from impc.control.closed_loop import simulate
from impc.inverse.problem import EXPLAINED, recorded_size, scenarios
from impc.inverse.structured_fit import feature_sizes, structured_estimate
from impc.inverse.structured_search import search_from
from impc.model.riccati import solve_lqr
from impc.model.weights import Weights

if TYPE_CHECKING:
    from impc.assess.structured_weights import Tangent
    from impc.inverse.estimates import Estimate
    from impc.inverse.problem import Problem
    from impc.model.structure import Structure


@dataclass(frozen=True)
class Ratio:
    """What one feature costs over another, both at the size that they have in the recordings."""

    first: str  # Labels of the features
    second: str
    interval: WeightInterval  # Of the logarithm of the ratio


@dataclass(frozen=True)
class StructureFit(Frozen):
    """A structure fitted to recordings, and what they say of it."""

    structure: Structure
    estimate: Estimate | None  # None when no regulator of it can be simulated
    reason: str  # Why there is none; empty otherwise
    # Root-mean-square of each feature of the states in the simulation (k,), in its unit
    sizes: Array
    effort: float  # Mean square of the first feature of the inputs
    covariance: WeightCovariance | None
    # Of each unknown, as identified: of logarithms of cost weights, or of correlations
    intervals: tuple[WeightInterval, ...]
    # Of each two features that have a cost weight, when they are penalised one by one
    ratios: tuple[Ratio, ...]
    test: StructureTest | None
    vaf: Array  # Of each output, all trials together (p,), %
    held_out: Array  # Mean over trials left out, of each output (p,), %; NaN when none is
    aic: float  # Akaike's criterion

    @property
    def refused(self) -> bool:
        """Whether the recordings refuse it, or nothing of it can be simulated."""
        return self.test is None or self.test.refused

    @property
    def identified(self) -> int:
        """Number of combinations of its unknowns that the recordings identify."""
        return 0 if self.covariance is None else int(np.count_nonzero(self.covariance.identified))


def no_structure(structure: Structure, outputs: int, reason: str) -> StructureFit:
    """A structure that cannot be simulated, and the `reason`; recordings have so many `outputs`."""
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
    """Say what recordings identify of a structure."""
    there, cost_weights = found.problem, np.array(found.cost_weights)
    at = tangent(structure, there, cost_weights)
    covariance = weight_covariance(at)
    sizes = feature_sizes(there, structure, np.array(found.gain), np.array(found.metric))
    runs = [simulate(found.controller(), drive) for drive in scenarios(there)]
    u = np.concatenate([run.applied for run in runs]) @ structure.input_features[0]
    recorded = np.concatenate([trial.without_offset for trial in there.recordings])
    left = _left_out(problem, structure, found, settle) if held_out else []
    nothing = np.full(len(problem.plant.outputs), np.nan)
    intervals, ratios = _intervals(at, covariance, sizes)
    roots = np.asarray(residual_noise(residuals_of(near, near.problem)).root)
    return StructureFit(
        structure,
        found,
        "",
        frozen(sizes),
        float(np.mean(u**2)),
        covariance,
        intervals,
        ratios,
        structure_test(at),
        frozen(vaf(recorded, np.concatenate([run.x @ there.plant.C.T for run in runs]))),
        frozen(np.mean(left, axis=0) if left else nothing),
        criterion_of(found, roots, int(np.count_nonzero(covariance.identified))),
    )


def criterion_of(found: Estimate, roots: Array, identified: int) -> float:
    """Akaike's criterion of an estimate: innovations for `roots` (p,), and 2 an identified unknown.

    What is below rounding is no difference: 1e-9 of an output's size is added to the innovations.
    """
    floor = np.random.default_rng(0)
    residuals = [
        part + EXPLAINED * floor.standard_normal(part.shape)
        for part in residuals_of(found, found.problem)
    ]
    return innovations_criterion(residuals, roots) + 2 * identified


def _left_out(problem: Problem, structure: Structure, end: Estimate, settle: float) -> list[Array]:
    """VAF of each trial under the structure fitted to the others."""
    there = end.problem
    start, found = problem.at(there.starts, there.logarithms, there.shifts), []
    cost_weights = _moving(np.array(end.cost_weights))
    for index in range(len(problem.recordings) if len(problem.recordings) > 1 else 0):
        others = start.leaving_out(index)
        one = search_from(others, structure, cost_weights)
        other = structured_estimate(others, structure, one)
        found.append(left_out_vaf(other, problem.recordings[index], settle).vaf)
    return found


def _moving(cost_weights: Array) -> Array:
    """Cost weights of zero made small instead: a search may find that other trials want them."""
    least = np.min(cost_weights[np.isfinite(cost_weights)])
    return np.where(np.isfinite(cost_weights), cost_weights, least - np.log(100.0))


def _intervals(
    at: Tangent, covariance: WeightCovariance, sizes: Array
) -> tuple[tuple[WeightInterval, ...], tuple[Ratio, ...]]:
    structure, rows = at.structure, np.eye(at.structure.count)
    if structure.coupled or structure.input_coupled:
        z = float(scipy.stats.norm.ppf(0.5 + LEVEL / 2))
        return tuple(
            WeightInterval(float(value), float(value - z * own), float(value + z * own), LEVEL)
            for value, own in zip(covariance.values, covariance.each, strict=True)
        ), ()
    profiles = WeightProfiles(at, covariance)
    intervals = tuple(
        profiles.interval(rows[index]) if moving else profiles.zero(index)
        for index, moving in enumerate(at.moving)
    )
    ratios = []
    for i, j in itertools.permutations(np.flatnonzero(at.moving[: len(structure.labels)]), 2):
        shift = 2 * float(np.log(sizes[i] / sizes[j]))
        if at.cost_weights[i] - at.cost_weights[j] + shift >= 0:  # the dearer one first
            found = profiles.interval(rows[i] - rows[j])
            moved = WeightInterval(
                found.value + shift, found.low + shift, found.high + shift, found.level
            )
            ratios.append(Ratio(structure.labels[i], structure.labels[j], moved))
    return intervals, tuple(ratios)


#: Of the test.
SIGNIFICANCE = 0.05
# Of the geometric mean of two cost weights: the departure whose detection is identified.
_CROSS = 0.5


@dataclass(frozen=True)
class CrossTerm:
    """A departure from the structure, and how probably the test would refuse it."""

    # Features that are penalised together too, with half the geometric mean of their cost weights
    first: str
    second: str
    power: float  # Probability that the test refuses it at its level, between 0 and 1


@dataclass(frozen=True)
class StructureTest(Frozen):
    """Result of `structure_test`."""

    statistic: float  # T
    # Degrees of freedom; 0 where the recordings identify nothing of the gain beyond the structure,
    # or the structure explains them to the last digit
    freedom: int
    # Of a T at least as large if the structure holds; 1 where there is nothing to test
    probability: float
    powers: tuple[CrossTerm, ...]  # For each pair of features that both have a cost weight

    @property
    def refused(self) -> bool:
        """Whether the recordings refuse the structure."""
        return self.probability < SIGNIFICANCE


def structure_test(at: Tangent) -> StructureTest:
    """Test a structure at its fit, against all gains."""
    on_gain, on_metric = at.gain_columns()
    fitted = at.span(np.array(at.on_cost_weights[:, at.moving]))
    beyond = fitted.without(np.hstack([on_gain, on_metric, at.found.dparameters]))
    gain = beyond[:, : on_gain.shape[1]]
    left, sizes, _ = np.linalg.svd(gain, full_matrices=False)
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
        _powers(at, float(np.trace(V)) / freedom, freedom),
    )


def _powers(at: Tangent, variance: float, freedom: int) -> tuple[CrossTerm, ...]:
    """What the test would see: how far cost weights one by one stay from what a cross term does."""
    structure, near = at.structure, NearFit(at)
    if structure.coupled:
        return ()
    penalised = np.flatnonzero(at.moving[: len(structure.labels)])
    quantile = float(scipy.stats.chi2.ppf(1 - SIGNIFICANCE, freedom))
    found = []
    for i, j in itertools.combinations(penalised, 2):
        one, other = structure.features[i], structure.features[j]
        half = _CROSS * np.exp((at.cost_weights[i] + at.cost_weights[j]) / 2)
        given = at.solution.weights
        crossed = Weights(given.Q + half * (np.outer(one, other) + np.outer(other, one)), given.R)
        there = solve_lqr(at.problem.plant, crossed)
        cost_weights = np.array(at.cost_weights)
        apart, _ = near.least(cost_weights, np.eye(int(np.sum(at.moving))), there)
        power = float(scipy.stats.ncx2.sf(quantile, freedom, apart / variance))
        found.append(CrossTerm(structure.labels[i], structure.labels[j], power))
    return tuple(found)
