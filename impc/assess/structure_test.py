"""Is a structure true? A score test of it against any gain, for residuals of any colour.

At the fit of the structure the residual e has no part along the structure's own columns. Let U be
an orthonormal basis of what the gain, moved freely, could do to the outputs beyond that, and beyond
initial states and parameters. If the structure holds, U'e is a sum of noise alone, and

    T = (U'e)' V^-1 U'e,      V = cov(U'e) for the colour that the residuals show

is chi-squared with as many degrees of freedom as U has columns (docs/structures.md). Nothing is
fitted outside of the structure: a free gain wanders along what recordings hardly tell, and a ratio
of misfits is no chi-squared for coloured residuals. Only directions are used that the recordings
tell of a gain (`covariance.TOLD`), which depends on their derivatives and not on e. What a price of
zero would do below zero is one of them: a structure is refused too when it wants negative prices.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.stats

from impc.arrays import Frozen
from impc.assess.covariance import TOLD, by_trial
from impc.assess.long_run_covariance import residual_noise, spread_of_sum
from impc.assess.near_fit import NearFit
from impc.inverse.problem import EXPLAINED, recorded_size
from impc.model.riccati import solve_lqr
from impc.model.weights import Weights

if TYPE_CHECKING:
    from impc.assess.structured_weights import Tangent

__all__ = ["LEVEL", "CrossTerm", "StructureTest", "structure_test"]

#: Of the test.
LEVEL = 0.05
# Of the geometric mean of two prices: the departure whose detection is told.
_CROSS = 0.5


@dataclass(frozen=True)
class CrossTerm:
    """A departure from the structure, and how probably the test would refuse it."""

    # Features that are priced together too, with half the geometric mean of their prices
    first: str
    second: str
    power: float  # Probability that the test refuses it at its level, between 0 and 1


@dataclass(frozen=True)
class StructureTest(Frozen):
    """Result of `structure_test`."""

    statistic: float  # T
    # Degrees of freedom; 0 where the recordings tell nothing of the gain beyond the structure, or
    # the structure explains them to the last digit
    freedom: int
    # Of a T at least as large if the structure holds; 1 where there is nothing to test
    probability: float
    powers: tuple[CrossTerm, ...]  # For each pair of features that both have a price

    @property
    def refused(self) -> bool:
        """Whether the recordings refuse the structure."""
        return self.probability < LEVEL


def structure_test(at: Tangent) -> StructureTest:
    """Test a structure at its fit, against all gains."""
    on_gain, on_metric = at.gain_columns()
    fitted = at.span(np.array(at.on_prices[:, at.moving]))
    beyond = fitted.without(np.hstack([on_gain, on_metric, at.found.dparameters]))
    gain = beyond[:, : on_gain.shape[1]]
    left, sizes, _ = np.linalg.svd(gain, full_matrices=False)
    told = sizes > at.noise / TOLD
    U = left[:, told]
    exact = EXPLAINED * recorded_size(at.problem)
    if U.shape[1] == 0 or np.linalg.norm(at.residual) <= exact:
        return StructureTest(0.0, 0, 1.0, ())
    residuals = by_trial(at.problem, np.array(at.residual))
    V = spread_of_sum(residual_noise(residuals, fitted), by_trial(at.problem, U))
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
    """What the test would see: how far prices one by one stay from what a cross term does.

    `variance` is that of a residual along the directions tested, its colour counted.
    """
    structure, near = at.structure, NearFit(at)
    if structure.coupled:
        return ()
    priced = np.flatnonzero(at.moving[: len(structure.labels)])
    quantile = float(scipy.stats.chi2.ppf(1 - LEVEL, freedom))
    found = []
    for i, j in itertools.combinations(priced, 2):
        one, other = structure.features[i], structure.features[j]
        half = _CROSS * np.exp((at.prices[i] + at.prices[j]) / 2)
        given = at.solution.weights
        crossed = Weights(given.Q + half * (np.outer(one, other) + np.outer(other, one)), given.R)
        there = solve_lqr(at.problem.plant, crossed)
        prices = np.array(at.prices)
        apart, _ = near.least(prices, np.eye(int(np.sum(at.moving))), there)
        power = float(scipy.stats.ncx2.sf(quantile, freedom, apart / variance))
        found.append(CrossTerm(structure.labels[i], structure.labels[j], power))
    return tuple(found)
