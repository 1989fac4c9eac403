"""What recordings say of structures: prices with intervals, whether each is true, which is better.

Each structure is fitted from the weights that fit at all, and again without each trial in turn. The
criterion is Akaike's for the innovations of the residuals (`other_models`), with two for each
combination of unknowns that the recordings tell (docs/structures.md).
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.stats

from impc.arrays import Array, Frozen, frozen
from impc.assess.held_out import left_out_vaf
from impc.assess.intervals import LEVEL
from impc.assess.long_run_covariance import residual_noise
from impc.assess.other_models import innovations_criterion, residuals_of
from impc.assess.price_profiles import PriceInterval, PriceProfiles
from impc.assess.structure_test import StructureTest, structure_test
from impc.assess.structured_weights import PriceCovariance, price_covariance, tangent
from impc.assess.variance_accounted_for import vaf
from impc.control.closed_loop import simulate
from impc.inverse.problem import EXPLAINED, scenarios
from impc.inverse.structured_fit import feature_sizes, structured_estimate
from impc.inverse.structured_search import search_from

if TYPE_CHECKING:
    from impc.assess.structured_weights import Tangent
    from impc.inverse.estimates import Estimate
    from impc.inverse.problem import Problem
    from impc.model.structure import Structure

__all__ = ["Ratio", "StructureFit", "assess_structure", "criterion_of", "no_structure"]


@dataclass(frozen=True)
class Ratio:
    """What one feature costs over another, both at the size that they have in the recordings."""

    first: str  # Labels of the features
    second: str
    interval: PriceInterval  # Of the logarithm of the ratio


@dataclass(frozen=True)
class StructureFit(Frozen):
    """A structure fitted to recordings, and what they say of it."""

    structure: Structure
    estimate: Estimate | None  # None when no regulator of it can be simulated
    reason: str  # Why there is none; empty otherwise
    # Root-mean-square of each feature of the states in the simulation (k,), in its unit
    sizes: Array
    effort: float  # Mean square of the first feature of the inputs
    covariance: PriceCovariance | None
    # Of each unknown, as told: of logarithms of prices, or of correlations
    intervals: tuple[PriceInterval, ...]
    # Of each two features that have a price, when they are priced one by one
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
    def told(self) -> int:
        """Number of combinations of its unknowns that the recordings tell."""
        return 0 if self.covariance is None else int(np.count_nonzero(self.covariance.told))


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
    """Say what recordings tell of a structure."""
    there, prices = found.problem, np.array(found.prices)
    at = tangent(structure, there, prices)
    covariance = price_covariance(at)
    sizes = feature_sizes(there, structure, np.array(found.gain), np.array(found.metric))
    runs = [simulate(found.controller(), drive) for drive in scenarios(there)]
    u = np.concatenate([run.applied for run in runs]) @ structure.input_features[0]
    recorded = np.concatenate([trial.outputs for trial in there.recordings])
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
        criterion_of(found, roots, int(np.count_nonzero(covariance.told))),
    )


def criterion_of(found: Estimate, roots: Array, told: int) -> float:
    """Akaike's criterion of an estimate: innovations for given `roots` (p,), and 2 a told unknown.

    What is below rounding is no difference: 1e-9 of an output's size is added to the innovations.
    """
    floor = np.random.default_rng(0)
    residuals = [
        part + EXPLAINED * floor.standard_normal(part.shape)
        for part in residuals_of(found, found.problem)
    ]
    return innovations_criterion(residuals, roots) + 2 * told


def _left_out(problem: Problem, structure: Structure, end: Estimate, settle: float) -> list[Array]:
    """VAF of each trial under the structure fitted to the others."""
    start, found = problem.at(end.problem.starts, end.problem.logarithms), []
    prices = _moving(np.array(end.prices))
    for index in range(len(problem.recordings) if len(problem.recordings) > 1 else 0):
        others = start.leaving_out(index)
        one = search_from(others, structure, prices)
        other = structured_estimate(others, structure, one)
        found.append(left_out_vaf(other, problem.recordings[index], settle)[0])
    return found


def _moving(prices: Array) -> Array:
    """Prices of zero made small instead, so that a search may find that other trials want them."""
    least = np.min(prices[np.isfinite(prices)])
    return np.where(np.isfinite(prices), prices, least - np.log(100.0))


def _intervals(
    at: Tangent, covariance: PriceCovariance, sizes: Array
) -> tuple[tuple[PriceInterval, ...], tuple[Ratio, ...]]:
    structure, rows = at.structure, np.eye(at.structure.count)
    if structure.coupled or structure.input_coupled:
        z = float(scipy.stats.norm.ppf(0.5 + LEVEL / 2))
        return tuple(
            PriceInterval(float(value), float(value - z * own), float(value + z * own), LEVEL)
            for value, own in zip(covariance.values, covariance.each, strict=True)
        ), ()
    profiles = PriceProfiles(at, covariance)
    intervals = tuple(
        profiles.interval(rows[index]) if moving else profiles.zero(index)
        for index, moving in enumerate(at.moving)
    )
    ratios = []
    for i, j in itertools.permutations(np.flatnonzero(at.moving[: len(structure.labels)]), 2):
        shift = 2 * float(np.log(sizes[i] / sizes[j]))
        if at.prices[i] - at.prices[j] + shift >= 0:  # the dearer one first
            found = profiles.interval(rows[i] - rows[j])
            moved = PriceInterval(
                found.value + shift, found.low + shift, found.high + shift, found.level
            )
            ratios.append(Ratio(structure.labels[i], structure.labels[j], moved))
    return intervals, tuple(ratios)
