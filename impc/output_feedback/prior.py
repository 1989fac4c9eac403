"""Fit objective: log-likelihood + log-prior - REML term for the noise SDs.

docs/why/output_feedback.md explains the terms (Chung et al. 2013).
"""

from __future__ import annotations

import copy
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from impc.errors import ImpcError

if TYPE_CHECKING:
    from impc.arrays import Array
    from impc.output_feedback.unknowns import LikelihoodTerms, PersonCoordinates

#: A gain entry is individually identified if its standard error is below this, in whitened units.
IDENTIFIED = 0.25

# Curvature that is added so that steps stay finite where the objective is flat: a noise SD near
# zero, or a sense that is not used.
_FLAT = 1e-2
# Nats per factor of e by which a gain near the stability boundary amplifies noise: on the seat the
# likelihood alone is largest at that boundary, where the search makes almost no progress.
_BARRIER = 0.5
# Nats per factor of e by which a noise SD differs from its expected size. With 1 nat, simulated
# subjects with almost no sensory noise got some: 2 SDs too much on the cart.
_UNLIKE = 0.25


class Place(NamedTuple):
    """Iterate of a search."""

    theta: Array  # (q,)
    identified: LikelihoodTerms  # likelihood with derivatives
    value: float  # objective, nats
    lost: float  # REML term (`Prior.lost`), nats


class Prior:
    """Prior of unidentified directions, and the REML term of the noise SDs.

    A normal prior about the start for each coordinate of gain, cost weights and parameters, and a
    barrier at the stability boundary. Initial states have the distribution of the states of their
    trials. With x a noise SD over its scale, the density of its logarithm is a power of that of a
    half-Cauchy SD (Gelman 2006), x / (1 + x^2): far away, 0.25 nat per factor of e on either side.
    `scales` (levels,); `driven` (n, n).
    """

    def __init__(
        self,
        space: PersonCoordinates,
        spread: float,
        scales: Array,
        driven: Array | None = None,
    ) -> None:
        self.space, self.scales, self.center = space, scales, space.start.copy()
        self.weights = np.diag(np.where(np.arange(len(space.start)) < space.own, spread**-2.0, 0.0))
        unit, size = space.space.own_unit, space.after - space.shared
        for first in range(space.shared, space.shared + size, len(unit)):
            mine = slice(first, first + len(unit))
            trial = space.space.problem.recordings[(first - space.shared) // len(unit)]
            self.center[mine] = -np.linalg.solve(unit, trial.x0)
            if driven is not None:
                self.weights[mine, mine] @= unit.T @ np.linalg.solve(unit @ unit.T + driven, unit)
        self.unlikely = np.full(len(scales), _UNLIKE)
        self.used = bool(np.isfinite(spread))

    def at(self, theta: Array) -> Place:
        """Evaluate the objective at theta (q,)."""
        return self.placed(theta, self.space.identified(theta))

    def placed(self, theta: Array, identified: LikelihoodTerms) -> Place:
        """Evaluate the objective at theta (q,) with a known likelihood."""
        lost = self.lost(theta, identified)
        return Place(theta, identified, identified.value + self.value(theta) - lost, lost)

    def tried(self, theta: Array) -> Place | None:
        """Evaluate the objective at theta (q,); None if it is undefined or not finite."""
        try:
            there = self.at(theta)
        except ImpcError:
            return None
        return there if np.isfinite(there.value) else None

    def freed(self, along: Array) -> Prior:
        """Prior without expectation for the noise SD that is fixed along a direction (q,)."""
        freed = copy.copy(self)
        freed.unlikely = self.unlikely * (1 - np.abs(along[self.space.own :]))
        return freed

    def parabola(self, here: Place, unseen: Array) -> tuple[Array, Array]:
        """Gradient (q,) and negative Hessian (q, q), positive definite, of the objective.

        `unseen` (q,): gradient of the REML term.
        """
        slope, bend = self.slopes(here.theta)
        gradient = here.identified.gradient + slope + unseen
        return gradient, here.identified.information + bend + _FLAT * np.eye(len(gradient))

    def lost(self, theta: Array, identified: LikelihoodTerms) -> float:
        """REML term at theta (q,) in nats: noise SDs are biased because all else is fitted too.

        By Laplace's method the likelihood of the noise SDs alone, all else integrated out, is the
        maximum over all else minus half the log determinant of its information (restricted
        likelihood: Patterson and Thompson 1971, Cox and Reid 1987).
        """
        if not self.used:
            return 0.0
        own = slice(0, self.space.own)
        information = identified.information[own, own] + self.slopes(theta)[1][own, own]
        return float(np.linalg.slogdet(information)[1]) / 2

    def value(self, theta: Array) -> float:
        """Log-prior at theta (q,), nats; minus infinity if the gain does not stabilise."""
        if not self.used:
            return 0.0
        away = float((theta - self.center) @ self.weights @ (theta - self.center)) / 2
        unlike = float(np.sum(self.unlike(theta)))
        return -away - unlike - _BARRIER * self.space.noise_growth(theta)[0]

    def unlike(self, theta: Array) -> Array:
        """Penalty of each noise SD (levels,) at theta (q,), nats: log cosh of its deviation."""
        off = np.abs(theta[self.space.own :] - self.scales)
        return np.asarray(self.unlikely * (off + np.log1p(np.exp(-2 * off)) - np.log(2)))

    def slopes(self, theta: Array) -> tuple[Array, Array]:
        """Gradient and negative Hessian of the log-prior at theta (q,).

        The Hessian of the barrier is approximated by that of the logarithm of a distance.
        """
        if not self.used:
            return np.zeros(len(theta)), np.zeros((len(theta), len(theta)))
        own, slope = self.space.own, self.space.noise_growth(theta)[1]
        gradient = -self.weights @ (theta - self.center) - _BARRIER * slope
        turned = np.tanh(theta[own:] - self.scales)
        gradient[own:] -= self.unlikely * turned
        bend = self.weights + _BARRIER * np.outer(slope, slope)
        bend[own:, own:] += np.diag(self.unlikely * (1 - turned**2))
        return gradient, bend
