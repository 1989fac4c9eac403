"""A fit of a person at a limit, from which the mean of the score is taken away.

The likelihood of the filter is not exact at a limit, and where its score would be zero on average
is beside the truth. With b(theta) its mean over recordings of the person at theta
(`simulated_score`), the gain is where

    score(theta) - b(theta)  +  slope of the prior  =  0,

which has no bias whatever the filter leaves out: an estimating function whose mean is zero at the
truth, as in indirect inference (Gourieroux, Monfort and Renault 1993). It is solved by one step of
Newton's from the largest likelihood, with mean and curvature C there,

    theta  =  theta_0 - C^-1 b(theta_0),

for b changes little over a few deviations. (Once more from where that ends is no better: there the
likelihood of the recordings is not at its best, and scores scatter by more. A search for the
largest of F - b'theta stays where it is on a kink: between two jumps of the likelihood lies a
maximum that a slope of half a nat for each deviation does not move.) The mean is taken away along
directions of the gain that are told, levels and initial states follow on their ridge: along levels
that are weakly told it moved them by powers of e, and along directions of the gain that are not the
likelihood is no parabola over a deviation. Where it is none along the step either, as with two
inputs in one of three people, the step is shortened.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from impc.arrays import Array
from impc.control.simulation import Status
from impc.errors import ImpcError
from impc.inverse.likelihood_fit import person_at
from impc.inverse.person_prior import TOLD, Prior
from impc.inverse.simulated_score import simulated_score
from impc.inverse.unseen_slope import unseen_slope

if TYPE_CHECKING:
    from impc.inverse.likelihood_fit import PersonFit
    from impc.inverse.simulated_score import SimulatedScore

# Sets of trials for the mean: they add a thirtieth to the variance of the gain.
_SETS = 32
# Deviations within which a mean is as it was found.
_NEAR = 2.0
# Shares of the step that are tried, until the likelihood of the recordings falls by what the
# parabola says and not by so much more, nats: it is rough by half a nat.
_SHARES, _APART = (1.0, 0.5, 0.25, 0.125), 1.0


class TiltedPrior(Prior):
    """A prior, and a slope that the likelihood lacks near a point.

    `about` (q,); `slope` (q,); `curvature` (q, q).
    """

    def __init__(self, prior: Prior, about: Array, slope: Array, curvature: Array) -> None:
        self.__dict__.update(vars(prior))
        root = np.linalg.cholesky(curvature)
        self.about, self.unit, self.along = about, root.T, np.linalg.solve(root, slope)

    def value(self, theta: Array) -> float:
        """With what the slope adds at theta (q,), nats."""
        off = self.unit @ (theta - self.about)
        return super().value(theta) + float(self.along @ (_NEAR * np.tanh(off / _NEAR)))

    def slopes(self, theta: Array) -> tuple[Array, Array]:
        """With that slope, (q,) and (q, q), at theta (q,)."""
        gradient, bend = super().slopes(theta)
        off = self.unit @ (theta - self.about)
        return gradient + self.unit.T @ (self.along / np.cosh(off / _NEAR) ** 2), bend


class Unbiased(NamedTuple):
    """A fit without the bias of its score."""

    # The fit as it was where no bound was met, where it was made without a prior, or where there is
    # a reason
    fit: PersonFit
    # Why the mean of the score was not taken away, or not wholly; empty where it was, and where no
    # bound was met
    reason: str


def unbiased(fit: PersonFit) -> Unbiased:
    """The person whose score is what it is on average, from the likeliest."""
    first = fit.prior
    met = any(np.any(trial.status != Status.FREE) for trial in fit.told.trials)
    if not (met and first.used):
        return Unbiased(fit, "")
    begin = first.placed(np.array(fit.theta), fit.told)
    curvature = first.parabola(begin, np.array(fit.unseen))[1]
    try:
        mean = _believed(curvature, simulated_score(first, begin.theta, 0, _SETS))
    except ImpcError as error:
        return Unbiased(fit, str(error))
    slope = -_told(curvature, first.space.gain) @ mean
    step = np.linalg.solve(curvature, slope)
    size = float(np.sqrt(slope @ step))
    worth = f"it is worth {size:.1f} standard deviations"
    for share in _SHARES:
        place = first.tried(begin.theta + share * step)
        lost = np.inf if place is None else begin.value - place.value
        if place is not None and lost < (share * size) ** 2 / 2 + _APART:
            break
    else:
        return Unbiased(fit, f"{worth}, and the likelihood is no parabola")
    prior = TiltedPrior(first, place.theta, share * slope, curvature)
    unseen = unseen_slope(first, place)
    found = prior.placed(place.theta, place.told)
    moved = person_at(prior, found, unseen, fit.converged, fit.evaluations + 1)
    part = f"{worth}, and the likelihood a parabola over {share * size:.1f} of them alone"
    return Unbiased(moved, part if share < 1 else "")


def _believed(curvature: Array, found: SimulatedScore) -> Array:
    """What is believed of a mean that is drawn (q,), nats.

    C (C + M)^-1 of it, M its covariance and C the curvature: as of a number whose own size is C's.
    """
    return np.asarray(curvature @ np.linalg.solve(curvature + found.spread, found.mean))


def _told(curvature: Array, gain: int) -> Array:
    """The projection onto slopes along directions of the gain that are told (q, q).

    What likelihoods say a deviation to either side along another is no slope.
    """
    covariance = np.linalg.inv(curvature)[:gain, :gain]
    variances, directions = np.linalg.eigh(covariance)
    kept = directions[:, variances < TOLD**2]
    projection = np.zeros_like(curvature)
    projection[:gain, :gain] = kept @ kept.T
    return projection
