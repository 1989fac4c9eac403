"""A fit of a person at a limit, corrected by particles.

What the filter's score lacks (`particle_slope`) changes little over a few deviations. So the search
goes on from where it ended with that slope added, is told the slope anew where it ends, and so on:

    F(theta) + sum_i  s_i tanh(2^-1 (theta - theta_k)_i) 2,

i over coordinates in which the curvature of F is one, so that the slope is believed within two
deviations of where it was found. Each slope is drawn, with a covariance M that is known, and is
taken for C (C + M)^-1 of itself, C the curvature, as a slope whose own size is that of C; those of
the second round and later ones are averaged. It is added along the gain alone: along levels that
are weakly told what is drawn had moved searches by deviations (docs/noisy-people.md, section
"Particles").
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from experiments.particles.correction import particle_slope, particles_serve
from impc.arrays import Array
from impc.control.closed_loop import Status
from impc.errors import ImpcError
from impc.inverse.likelihood_fit import person_at
from impc.inverse.likelihood_search import climb
from impc.inverse.person_prior import Prior

if TYPE_CHECKING:
    from experiments.particles.correction import ParticleSlope
    from impc.inverse.likelihood_fit import PersonFit
    from impc.inverse.person_prior import Place

__all__ = ["TiltedPrior", "with_particles"]

# Slopes that are drawn, and likelihoods of each search between them.
_ROUNDS, _LIKELIHOODS = 4, 40
# Particles have lost the recordings where so few of them count.
_LOST = 0.05
# A round after which the likelihood by particles is lower by more, nats, was one too many: what
# they draw moves it by one.
_FALLEN = 4.0
# Deviations within which a slope is as it was found.
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
        """With that slope at theta (q,)."""
        gradient, bend = super().slopes(theta)
        off = self.unit @ (theta - self.about)
        return gradient + self.unit.T @ (self.along / np.cosh(off / _NEAR) ** 2), bend


def with_particles(fit: PersonFit) -> PersonFit:
    """The person whose likelihood by particles is largest, searched from a fit.

    Where no bound is met, or particles know no more than the filter (`particles_serve`), or lose
    the recordings, that is the fit as it was.

    Parameters
    ----------
    fit : PersonFit
        Of `fit_person`.
    """
    first, space = fit.prior, fit.space
    met = any(np.any(trial.status != Status.FREE) for trial in fit.told.trials)
    if not (met and first.used and particles_serve(fit.problem, space)):
        return fit
    unseen, slopes = np.array(fit.unseen), []
    prior, place, spent, settled = first, first.placed(np.array(fit.theta), fit.told), 0, True
    highest, found = -np.inf, fit
    for seed in range(_ROUNDS):
        try:
            lacked = particle_slope(space, place.theta, seed)
        except ImpcError:
            return found
        value = first.placed(place.theta, place.told).value + lacked.value
        if lacked.share < _LOST or value < highest - _FALLEN:
            return found
        highest = max(highest, value)
        slopes.append(_believed(first, place, unseen, lacked))
        slope = np.mean(slopes[1:] or slopes, axis=0)
        prior = TiltedPrior(first, place.theta, slope, first.parabola(place, unseen)[1])
        place = prior.placed(place.theta, place.told)
        found = person_at(prior, place, unseen, settled and fit.converged, fit.evaluations + spent)
        if seed < _ROUNDS - 1:
            place, _, more, settled = climb(prior, place, _LIKELIHOODS, unseen=unseen)
            spent += more
    return found


def _believed(prior: Prior, here: Place, unseen: Array, lacked: ParticleSlope) -> Array:
    """What is believed of a slope that is drawn (q,), nats; along the gain."""
    curvature = prior.parabola(here, unseen)[1]
    believed = curvature @ np.linalg.solve(curvature + lacked.noise, lacked.slope)
    believed[prior.space.gain :] = 0.0
    return np.asarray(believed)
