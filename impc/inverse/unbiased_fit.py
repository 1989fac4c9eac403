"""A fit of a person at a limit, from which the mean of the score is taken away.

The likelihood of the filter is not exact at a limit, and where its score would be zero on average
is beside the truth. With b(theta) its mean over recordings of the person at theta
(`simulated_score`), the gain is where

    score(theta) - b(theta)  +  slope of the prior  =  0,

which has no bias whatever the filter leaves out: an estimating function whose mean is zero at the
truth, as in indirect inference (Gourieroux, Monfort and Renault 1993). It is solved by Newton's
steps from the largest likelihood, with the curvature C there,

    theta  <-  theta_0 - C^-1 b(theta),

for b changes little over a few deviations. (A search for the largest of F - b'theta costs twice as
much and stays where it is on a kink: between two jumps of the likelihood lies a maximum that a
slope of half a nat for each deviation does not move.) The mean is taken away along directions of
the gain that are told, levels and initial states follow on their ridge: along levels that are
weakly told it moved them by powers of e, and along directions of the gain that are not the
likelihood is no parabola over a deviation.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from impc.arrays import Array
from impc.control.simulation import Status
from impc.errors import ImpcError
from impc.inverse.likelihood_fit import person_at
from impc.inverse.person_prior import Prior
from impc.inverse.simulated_score import simulated_score
from impc.inverse.unseen_slope import unseen_slope

if TYPE_CHECKING:
    from impc.inverse.likelihood_fit import PersonFit
    from impc.inverse.simulated_score import SimulatedScore

__all__ = ["TiltedPrior", "Unbiased", "unbiased"]

# Means that are found, one before each step, and sets of trials for each: 32 sets add a thirtieth
# to the variance of the gain.
_ROUNDS, _SETS = 2, 16
# Deviations within which a mean is as it was found, and as far as it may move the gain.
_NEAR = 2.0
# A direction of the gain whose deviation is larger, in natural coordinates, is not told: what
# likelihoods say a deviation to either side of it is no slope.
_TOLD = 0.25


class TiltedPrior(Prior):
    """A prior, and a slope that the likelihood lacks near a point.

    Parameters
    ----------
    prior : Prior
    about : Array
        Where the slope was found (q,).
    slope : Array
        (q,), nats.
    curvature : Array
        Of what is to be largest there (q, q).
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
    """A fit without the bias of its score.

    Attributes
    ----------
    fit : PersonFit
        The fit as it was where no bound was met, where it was made without a prior, or where there
        is a reason.
    reason : str
        Why the mean of the score was not taken away, or not wholly; empty where it was, and where
        no bound was met.
    """

    fit: PersonFit
    reason: str


def unbiased(fit: PersonFit) -> Unbiased:
    """The person whose score is what it is on average, from the likeliest.

    Parameters
    ----------
    fit : PersonFit
        Of `fit_person`.
    """
    first = fit.prior
    met = any(np.any(trial.status != Status.FREE) for trial in fit.told.trials)
    if not (met and first.used):
        return Unbiased(fit, "")
    begin = first.placed(np.array(fit.theta), fit.told)
    curvature = first.parabola(begin, np.array(fit.unseen))[1]
    root, told = np.linalg.cholesky(curvature), _told(curvature, first.space.gain)
    place, means, size = begin, [], 0.0
    slope = np.zeros(len(begin.theta))
    try:
        for seed in range(_ROUNDS):
            mean = simulated_score(first, place.theta, seed, _SETS)
            means.append(_believed(curvature, mean))
            slope = told @ -np.mean(means, axis=0)
            size = float(np.linalg.norm(np.linalg.solve(root, slope)))
            slope *= _NEAR / max(size, _NEAR)
            place = first.at(begin.theta + np.linalg.solve(curvature, slope))
    except ImpcError as error:
        return Unbiased(fit, str(error))
    prior = TiltedPrior(first, place.theta, slope, curvature)
    unseen = unseen_slope(first, place)
    found = prior.placed(place.theta, place.told)
    moved = person_at(prior, found, unseen, fit.converged, fit.evaluations + _ROUNDS)
    far = f"it is worth {size:.1f} standard deviations, and {_NEAR:.0f} are taken away at most"
    return Unbiased(moved, far if size > _NEAR else "")


def _believed(curvature: Array, found: SimulatedScore) -> Array:
    """What is believed of a mean that is drawn (q,), nats.

    C (C + M)^-1 of it, M its covariance and C the curvature: as of a number whose own size is C's.
    """
    return np.asarray(curvature @ np.linalg.solve(curvature + found.spread, found.mean))


def _told(curvature: Array, gain: int) -> Array:
    """The projection onto slopes along directions of the gain that are told (q, q)."""
    covariance = np.linalg.inv(curvature)[:gain, :gain]
    variances, directions = np.linalg.eigh(covariance)
    kept = directions[:, variances < _TOLD**2]
    projection = np.zeros_like(curvature)
    projection[:gain, :gain] = kept @ kept.T
    return projection
