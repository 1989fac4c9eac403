"""Whether any cost weights explain the gain that recordings identify.

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
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.special

from impc.errors import SolverError, WeightsError
from impc.inverse.equivalent_weights import weights_margin
from impc.inverse.solution_set import gain_fibre

if TYPE_CHECKING:
    from impc.arrays import Array
    from impc.assess.printed_gain import GainEstimate
    from impc.inverse.estimates import Estimate
    from impc.model.plant import Plant

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
    identified = covariance.told
    steps = covariance.along(estimate.K - fitted.gain)[identified]
    exact = fitted.explained
    statistic = 0.0 if exact else float(np.sum((steps / covariance.deviations[identified]) ** 2))
    freedom = int(np.count_nonzero(identified))
    p_value = float(scipy.special.chdtrc(freedom, statistic)) if freedom else 1.0
    try:
        exist = weights_margin(gain_fibre(plant, estimate.K)).exist
    except (WeightsError, SolverError):  # unstable, or at the edge of what a program can tell
        exist = False
    more = 1.0 if exact else fitted.misfit / estimate.misfit
    difference = return_difference(plant, estimate.K)
    return WeightsTest(statistic, freedom, p_value, more, contradicted, exist, difference)


def return_difference(plant: Plant, gain: Array) -> ReturnDifference | None:
    """The inequality at a gain (1, n); None for several inputs, or a singular A.

    By det(zI - A + BK) / det(zI - A), which is 1 + K (zI - A)^-1 B.
    """
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
