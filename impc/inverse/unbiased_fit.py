"""A fit of a person at a limit, from which the mean of the score is taken away.

The likelihood of the filter is not exact at a limit, and where its score would be zero on average
is beside the truth. With b(theta) its mean over recordings of the person at theta
(`simulated_score`), the gain is where

    score(theta) - b(theta)  +  slope of the prior  =  0,

which has no bias whatever the filter leaves out: an estimating function whose mean is zero at the
truth, as in indirect inference (Gourieroux, Monfort and Renault 1993). b changes little over a few
deviations. So the search goes on from where it ended with

    F(theta) - sum_i  b_i tanh(2^-1 (theta - theta_k)_i) 2,

i over coordinates in which the curvature of F is one, so that b is believed within two deviations
of where it was found; it is found again where that ends, and so on. It is taken away along the gain
alone: along levels that are weakly told it moved searches by powers of e.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Array
from impc.control.closed_loop import Status
from impc.errors import ImpcError
from impc.inverse.likelihood_fit import person_at
from impc.inverse.likelihood_search import climb
from impc.inverse.person_prior import Prior
from impc.inverse.simulated_score import simulated_score
from impc.inverse.unseen_slope import unseen_slope

if TYPE_CHECKING:
    from impc.inverse.likelihood_fit import PersonFit
    from impc.inverse.person_prior import Place
    from impc.inverse.simulated_score import SimulatedScore

__all__ = ["TiltedPrior", "unbiased"]

# Means that are found, sets of trials for each, and likelihoods of each search after one. Those of
# the second and later ones are averaged: 48 sets add a fiftieth to the variance of the gain.
_ROUNDS, _SETS, _LIKELIHOODS = 3, 24, 40
# Deviations within which a mean is as it was found.
_NEAR = 2.0


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


def unbiased(fit: PersonFit) -> PersonFit:
    """The person whose score is what it is on average, searched from a fit.

    Where no bound was met in the recordings, or the person who was found runs away in every trial,
    that is the fit as it was.

    Parameters
    ----------
    fit : PersonFit
        Of `fit_person`.
    """
    first = fit.prior
    met = any(np.any(trial.status != Status.FREE) for trial in fit.told.trials)
    if not (met and first.used):
        return fit
    unseen, means = np.array(fit.unseen), []
    place, found, spent, settled = first.placed(np.array(fit.theta), fit.told), fit, 0, True
    for seed in range(_ROUNDS):
        try:
            unseen = unseen_slope(first, place) if seed else unseen
            mean = simulated_score(first, place.theta, seed, _SETS)
        except ImpcError:
            return found
        means.append(_believed(first, place, unseen, mean))
        slope = -np.mean(means[1:] or means, axis=0)
        prior = TiltedPrior(first, place.theta, slope, first.parabola(place, unseen)[1])
        begin = prior.placed(place.theta, place.told)
        place, _, more, settled = climb(prior, begin, _LIKELIHOODS, unseen=unseen)
        spent += more
        found = person_at(prior, place, unseen, settled and fit.converged, fit.evaluations + spent)
    return found


def _believed(prior: Prior, here: Place, unseen: Array, found: SimulatedScore) -> Array:
    """What is believed of a mean that is drawn (q,), nats; along the gain.

    C (C + M)^-1 of it, M its covariance and C the curvature: as of a number whose own size is C's.
    """
    curvature = prior.parabola(here, unseen)[1]
    believed = curvature @ np.linalg.solve(curvature + found.spread, found.mean)
    believed[prior.space.gain :] = 0.0
    return np.asarray(believed)
