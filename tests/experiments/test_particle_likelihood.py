"""Look-ahead particles against a Kalman filter, a bootstrap filter and repeated draws."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.stats

from experiments.particles.clipped_regulator import ClippedRegulator, clipped_regulator, first_state
from experiments.particles.drawn_particles import _normal_between
from experiments.particles.likelihood import particle_likelihood
from impc.arrays import Array
from tests.output_feedback.test_likelihood import Someone, likelihood, particles, push, recorded

pytestmark = pytest.mark.full

PEOPLE = [
    Someone(limit=0.8, horizon=1, sensory=(0.1, 0.2)),
    Someone(limit=0.8, horizon=1, sensory=(0.1, 0.2), walk=0.2),
    Someone(limit=0.6, horizon=1, sensory=()),
]


def regulator(who: Someone) -> ClippedRegulator:
    law = who.controller()
    parts = law.bounds, who.observer(), np.array([who.recorder])
    return clipped_regulator(who.plant(), np.array([who.gain]), *parts)


def given(who: Someone, samples: int, seed: int = 1) -> tuple[Array, Array, Array]:
    outputs = np.array(recorded(who, samples, seed).outputs)
    return outputs, push(samples), first_state(who.plant(), regulator(who), np.array(who.start))


@pytest.mark.parametrize("who", [one._replace(limit=1e3) for one in PEOPLE])
def test_where_no_bound_is_met_it_is_that_of_a_kalman_filter(who: Someone) -> None:
    """For any seed: psi is exact, so all particles have the same weight."""
    outputs, disturbance, start = given(who, 120)
    exact = likelihood(who._replace(limit=np.inf), outputs).value
    for seed in (0, 1):
        found = particle_likelihood(regulator(who), outputs, disturbance, start, 3, seed)
        assert found == pytest.approx(exact, abs=1e-6)


def test_it_is_that_of_particles_that_know_the_past_only() -> None:
    """A bootstrap filter needs thousands of particles where forty suffice here."""
    who = PEOPLE[0]
    trial = given(who, 60)
    draws = [particles(who, trial[0], 20_000, seed) for seed in range(4)]
    own = [particle_likelihood(regulator(who), *trial, 40, seed) for seed in range(8)]
    error = np.hypot(np.std(draws, ddof=1) / 2, np.std(own, ddof=1) / np.sqrt(8))
    assert abs(np.mean(own) - np.mean(draws)) < 4 * error
    assert np.std(own, ddof=1) < np.std(draws, ddof=1) < 0.5


def sized(who: Someone, factor: float) -> Someone:
    return who._replace(gain=(factor * who.gain[0], factor * who.gain[1]))


@pytest.mark.parametrize("ends", [(-np.inf, -2.0), (-1.0, 3.0), (0.2, 0.3), (2.0, np.inf),
                                  (3.0, 3.1), (-4.0, -1.0), (6.0, 40.0)])  # fmt: skip
def test_numbers_between_two_ends_are_drawn_as_they_should(ends: tuple[float, float]) -> None:
    drawn = [_normal_between(*ends) for _ in range(4000)]
    assert scipy.stats.kstest(drawn, scipy.stats.truncnorm(*ends).cdf).pvalue > 1e-6


def test_the_score_has_no_mean_over_recordings() -> None:
    """Score along the size of the gain at a limit: zero mean, and the expected variance."""
    who = Someone(limit=0.5, horizon=1, sensory=(0.2, 0.4), motor=0.1, start=(0.0, 0.0))
    slopes, bends = [], []
    for seed in range(60):
        trial = given(who, 100, seed)
        low, middle, high = (
            particle_likelihood(regulator(sized(who, factor)), *trial, 100, seed)
            for factor in (0.85, 1.0, 1.15)
        )
        slopes.append((high - low) / 0.3)
        bends.append(-(high - 2 * middle + low) / 0.15**2)
    assert abs(np.mean(slopes)) < 3 * np.std(slopes) / np.sqrt(60)
    # Second Bartlett identity; with 60 draws the variance is uncertain by a fifth.
    assert 0.4 < np.var(slopes) / np.mean(bends) < 2.5
