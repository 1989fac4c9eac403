"""Particles that know what is to come, beside dense densities, other particles and other draws."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.stats

from experiments.particles.clipped_regulator import ClippedRegulator, clipped_regulator, first_state
from experiments.particles.drawn_particles import _normal_between
from experiments.particles.likelihood import (
    SLOPE_STEP,
    particle_likelihood,
    particle_paths,
    path_slopes,
    stein_fields,
)
from experiments.particles.wanted_paths import complete, gains, pull
from impc.arrays import Array
from tests.control.test_joint_likelihood import Someone, likelihood, particles, push, recorded

pytestmark = pytest.mark.long

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


def told(who: Someone, trial: tuple[Array, Array, Array], wanted: Array) -> Array:
    room = np.zeros((1, 1, wanted.shape[1])), np.zeros((1, wanted.shape[1]))
    own = regulator(who)
    return np.asarray(complete(own, gains(own, len(trial[0])), *trial, wanted, *room))


def some_paths(samples: int, count: int = 3) -> Array:
    rng = np.random.default_rng(7)
    return np.asarray(np.cumsum(0.2 * rng.standard_normal((samples - 1, count)), axis=0))


@pytest.mark.parametrize("who", [one._replace(limit=1e3) for one in PEOPLE])
def test_where_no_bound_is_met_it_is_that_of_a_kalman_filter(who: Someone) -> None:
    """Whatever is drawn: psi is exact, and so each particle has the same weight."""
    outputs, disturbance, start = given(who, 120)
    exact = likelihood(who._replace(limit=np.inf), outputs).value
    for seed in (0, 1):
        found = particle_likelihood(regulator(who), outputs, disturbance, start, 3, seed)
        assert found == pytest.approx(exact, abs=1e-6)


@pytest.mark.parametrize("who", PEOPLE)
def test_given_what_is_wanted_the_density_is_that_of_a_normal_vector(who: Someone) -> None:
    """Stack all states, outputs and wanted commands of a short trial into one vector."""
    samples, own = 6, regulator(who)
    trial = given(who, samples)
    wanted = some_paths(samples, 1)
    C, h = own.C, own.h
    mean, spread, means = trial[2], [own.P0], []
    for t in range(samples):
        means.append(mean)
        mean = own.F @ mean + own.E @ trial[1][t]
        if t < samples - 1:
            mean = mean + own.B * np.clip(wanted[t, 0], own.low, own.high)
        spread.append(own.F @ spread[-1] @ own.F.T + own.Q)
    # The first command is known, as the first estimate is.
    picks = [(t, C) for t in range(samples)] + [(t, h[None]) for t in range(1, samples - 1)]
    power = np.linalg.matrix_power
    blocks = [
        [
            (a @ spread[min(s, t)] @ power(own.F, t - s).T @ b.T)
            if s <= t
            else (a @ power(own.F, s - t) @ spread[t] @ b.T)
            for t, b in picks
        ]
        for s, a in picks
    ]
    covariance = np.block(blocks)
    covariance[:samples, :samples] += own.R[0, 0] * np.eye(samples)
    center = np.concatenate([pick @ means[t] for t, pick in picks])
    value = np.concatenate([trial[0][:, 0], wanted[1:, 0]])
    exact = scipy.stats.multivariate_normal.logpdf(value, center, covariance)
    assert told(who, trial, wanted)[0] == pytest.approx(exact, rel=1e-8)


@pytest.mark.parametrize("who", PEOPLE)
def test_the_slope_along_a_path_equals_differences(who: Someone) -> None:
    own, trial, wanted = regulator(who), given(who, 60), some_paths(60)
    known = gains(own, 60)
    missed, innovation = np.zeros((60, 1, 3)), np.zeros((59, 3))
    complete(own, known, *trial, wanted, missed, innovation)
    slope = pull(own, known, wanted, missed, innovation)
    rng = np.random.default_rng(2)
    for _ in range(5):
        way = 1e-5 * rng.standard_normal((59, 1))
        change = told(who, trial, wanted + way) - told(who, trial, wanted - way)
        np.testing.assert_allclose(np.sum(2 * way * slope, axis=0), change, rtol=1e-5, atol=1e-7)


def test_it_is_that_of_particles_that_know_the_past_only() -> None:
    """A bootstrap filter needs thousands for what forty do here."""
    who = PEOPLE[0]
    trial = given(who, 60)
    draws = [particles(who, trial[0], 20_000, seed) for seed in range(4)]
    own = [particle_likelihood(regulator(who), *trial, 40, seed) for seed in range(8)]
    error = np.hypot(np.std(draws, ddof=1) / 2, np.std(own, ddof=1) / np.sqrt(8))
    assert abs(np.mean(own) - np.mean(draws)) < 4 * error
    assert np.std(own, ddof=1) < np.std(draws, ddof=1) < 0.5


def sized(who: Someone, factor: float) -> Someone:
    return who._replace(gain=(factor * who.gain[0], factor * who.gain[1]))


def moved(who: Someone, t: float) -> Someone:
    return who._replace(gain=sized(who, 1 + t).gain, motor=who.motor * (1 - t))


@pytest.mark.parametrize("who", PEOPLE)
def test_the_mean_slope_of_paths_is_the_slope_of_the_likelihood(who: Someone) -> None:
    """Fisher's identity, by differences of the likelihood with many particles."""
    trial = given(who, 80)
    near = [(regulator(moved(who, SLOPE_STEP)), regulator(moved(who, -SLOPE_STEP)))]
    paths = particle_paths(regulator(who), *trial, 400, 300, 3)
    slopes = path_slopes(near, *trial, paths.wanted)[:, 0]
    apart = 0.2
    ends = [
        [particle_likelihood(regulator(moved(who, t)), *trial, 1000, seed) for seed in range(6)]
        for t in (apart, -apart)
    ]
    middle = [(a - b) / (2 * apart) for a, b in zip(*ends, strict=True)]
    error = np.hypot(np.std(slopes) / np.sqrt(100), np.std(middle, ddof=1) / np.sqrt(6))
    # A difference over .4 misses a tenth of the slope of one over nothing at most.
    assert abs(np.mean(slopes) - np.mean(middle)) < 4 * error + 0.1 * abs(np.mean(middle))


@pytest.mark.parametrize("who", PEOPLE)
def test_what_is_taken_away_has_no_mean(who: Someone) -> None:
    own, trial = regulator(who), given(who, 80)
    wanted = np.hstack([particle_paths(own, *trial, 300, 50, seed).wanted for seed in range(8)])
    found = stein_fields(own, *trial, wanted)
    spread = np.std(found, axis=0)
    off = np.mean(found, axis=0)[spread > 0] / spread[spread > 0]
    assert np.max(np.abs(off)) * np.sqrt(len(found)) < 6


@pytest.mark.parametrize("ends", [(-np.inf, -2.0), (-1.0, 3.0), (0.2, 0.3), (2.0, np.inf),
                                  (3.0, 3.1), (-4.0, -1.0), (6.0, 40.0)])  # fmt: skip
def test_numbers_between_two_ends_are_drawn_as_they_should(ends: tuple[float, float]) -> None:
    drawn = [_normal_between(*ends) for _ in range(4000)]
    assert scipy.stats.kstest(drawn, scipy.stats.truncnorm(*ends).cdf).pvalue > 1e-6


def test_the_score_has_no_mean_over_recordings() -> None:
    """Along the size of the gain of somebody at a limit, and with the variance that is expected."""
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
    # The second Bartlett identity: of 60 draws a variance is known to a fifth, the bend to less.
    assert 0.4 < np.var(slopes) / np.mean(bends) < 2.5
