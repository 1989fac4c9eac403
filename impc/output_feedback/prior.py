"""What a search for a person makes largest: log-likelihood + log-prior - REML term for the levels.

docs/noisy-people.md, "The fit", says why there is each (Chung et al. 2013).
"""

from __future__ import annotations

import copy
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from impc.errors import ImpcError

if TYPE_CHECKING:
    from impc.arrays import Array
    from impc.output_feedback.unknowns import LikelihoodTerms, PersonCoordinates

#: A number of the gain is individually identified when its deviation is below this, of a
#: coordinate.
IDENTIFIED = 0.25

# Without a prior a level that slides to zero, or a sense to one that is not used, has no end: along
# what is so flat a step of ten is as far as a promise is believed.
_FLAT = 1e-2
# Nats for each factor of e by which a gain near the border of those that stabilise lets noise
# grow: on the seat the largest likelihood without it is on that border, and a search creeps there.
_BARRIER = 0.5
# Nats for each factor of e by which a level lies far from the size that is expected. With one nat
# people all but without noise in the senses had some: two deviations too much on the cart.
_UNLIKE = 0.25


class Place(NamedTuple):
    """A point of a search."""

    theta: Array  # (q,)
    identified: LikelihoodTerms  # What the recordings say there
    value: float  # What is to be largest, nats
    lost: float  # What levels lose there (`Prior.lost`), nats


class Prior:
    """What holds directions that nothing identifies, as a share of a log-likelihood.

    A normal number about the start for each coordinate of gain, cost weights and parameters, and a
    barrier before gains that do not stabilise. Initial states are as any other state of their
    trials. With x a level over its scale the density of its logarithm is a power of
    that of a half-Cauchy level (Gelman 2006), x / (1 + x^2): far away, a quarter of a nat for each
    factor of e on either side.

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
        """What is to be largest, at theta (q,): likelihood times prior, less what levels lose."""
        return self.placed(theta, self.space.identified(theta))

    def placed(self, theta: Array, identified: LikelihoodTerms) -> Place:
        """The same, with what the recordings say at theta (q,)."""
        lost = self.lost(theta, identified)
        return Place(theta, identified, identified.value + self.value(theta) - lost, lost)

    def tried(self, theta: Array) -> Place | None:
        """The same, or None where there is no likelihood at theta (q,), or no number."""
        try:
            there = self.at(theta)
        except ImpcError:
            return None
        return there if np.isfinite(there.value) else None

    def freed(self, along: Array) -> Prior:
        """A prior that expects nothing of the level that is held along a direction (q,)."""
        freed = copy.copy(self)
        freed.unlikely = self.unlikely * (1 - np.abs(along[self.space.own :]))
        return freed

    def parabola(self, here: Place, unseen: Array) -> tuple[Array, Array]:
        """Slope (q,) and curvature (q, q), positive definite, of what is to be largest.

        `unseen` (q,).
        """
        slope, bend = self.slopes(here.theta)
        gradient = here.identified.gradient + slope + unseen
        return gradient, here.identified.information + bend + _FLAT * np.eye(len(gradient))

    def lost(self, theta: Array, identified: LikelihoodTerms) -> float:
        """What levels lose because all else is fitted to the same noise, nats, at theta (q,).

        `identified` is what the recordings say there.

        The likelihood of the levels alone, all else integrated out, is by Laplace's method the
        largest over all else, less half of the logarithm of the determinant of the information on
        that (restricted likelihood: Patterson and Thompson 1971, Cox and Reid 1987).
        """
        if not self.used:
            return 0.0
        own = slice(0, self.space.own)
        information = identified.information[own, own] + self.slopes(theta)[1][own, own]
        return float(np.linalg.slogdet(information)[1]) / 2

    def value(self, theta: Array) -> float:
        """At theta (q,), nats; minus infinity where a gain does not stabilise."""
        if not self.used:
            return 0.0
        away = float((theta - self.center) @ self.weights @ (theta - self.center)) / 2
        unlike = float(np.sum(self.unlike(theta)))
        return -away - unlike - _BARRIER * self.space.wandering(theta)[0]

    def unlike(self, theta: Array) -> Array:
        """What each level costs (levels,) at theta (q,), nats: log cosh of how far it is off."""
        off = np.abs(theta[self.space.own :] - self.scales)
        return np.asarray(self.unlikely * (off + np.log1p(np.exp(-2 * off)) - np.log(2)))

    def slopes(self, theta: Array) -> tuple[Array, Array]:
        """Derivatives at theta; the barrier is taken to bend as the logarithm of a distance does.

        `theta` (q,).
        """
        if not self.used:
            return np.zeros(len(theta)), np.zeros((len(theta), len(theta)))
        own, slope = self.space.own, self.space.wandering(theta)[1]
        gradient = -self.weights @ (theta - self.center) - _BARRIER * slope
        turned = np.tanh(theta[own:] - self.scales)
        gradient[own:] -= self.unlikely * turned
        bend = self.weights + _BARRIER * np.outer(slope, slope)
        bend[own:, own:] += np.diag(self.unlikely * (1 - turned**2))
        return gradient, bend
