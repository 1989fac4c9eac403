"""A fit that particles correct: against values of their likelihood, and where they do not serve."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from experiments.particles.clipped_regulator import clipped_regulator, first_state
from experiments.particles.corrected_fit import TiltedPrior, with_particles
from experiments.particles.correction import particle_slope, particles_serve, regulator_alone
from experiments.particles.likelihood import particle_likelihood
from impc.control.controller import Controller
from impc.control.noisy_person import simulate_person
from impc.inverse.likelihood_fit import PersonFit, fit_person
from impc.inverse.methods import estimate
from impc.inverse.problem import Problem
from impc.model.bounds import Bounds
from impc.model.observer import Observer
from impc.model.recordings import Recording
from impc.model.weights import Weights
from tests.inverse.test_likelihood_fit import cart
from tests.support import extrapolated_slope

if TYPE_CHECKING:
    from impc.arrays import Array

pytestmark = pytest.mark.long


def person(**levels: float) -> Observer:
    return Observer(cart(), ["x", "v"], motor=0.2, sensory=[0.1, 0.2], **levels)


def problem(limit: float, *, horizon: int = 5) -> Problem:
    """Three trials of somebody with noisy senses, at the limit in a third of the samples or not."""
    bounds = Bounds(cart(), u_min=-limit, u_max=limit)
    law = Controller(cart(), Weights(np.diag([8.0, 1.0]), 1), bounds, horizon, terminal_set=False)
    rng, trials = np.random.default_rng(0), []
    for seed in range(3):
        push = np.repeat(rng.choice([-0.7, 0.0, 0.7], 30), 10)
        found = simulate_person(law, person(), push, recorder=0.01, seed=seed)
        trials.append(Recording(cart(), found.outputs, push))
    return Problem(cart(), bounds, horizon, trials, terminal_set=False)


@pytest.fixture(scope="module")
def met() -> PersonFit:
    return fit_person(estimate(problem(0.7)), person())


def by_particles(fit: PersonFit, theta: Array, count: int, seed: int) -> float:
    who = fit.space.unpack(theta)
    posed = who.point.problem
    own = clipped_regulator(posed.plant, who.point.K, posed.bounds, who.observer, who.recorder)
    return sum(
        particle_likelihood(
            own,
            np.array(trial.outputs),
            np.array(trial.disturbance),
            first_state(posed.plant, own, trial.x0),
            count,
            seed,
        )
        for trial in posed.recordings
    )


def test_the_slope_is_that_of_values(met: PersonFit) -> None:
    """Of particles less of the filter, both of the clipped regulator, along the whole gain."""
    theta, space = np.array(met.theta), met.space
    found = particle_slope(space, theta, 0)
    way = np.zeros(len(theta))
    way[: space.gain] = theta[: space.gain] / np.linalg.norm(theta[: space.gain])
    step = 0.3 * way / np.sqrt(way @ met.told.information @ way) * 3
    draws = [
        by_particles(met, theta + step, 800, seed) - by_particles(met, theta - step, 800, seed)
        for seed in range(4)
    ]
    own = regulator_alone(space)
    filtered = own.value(theta + step) - own.value(theta - step)
    error = np.hypot(np.std(draws, ddof=1) / 2, 2 * np.sqrt(step @ found.noise @ step))
    assert abs(2 * step @ found.slope - (np.mean(draws) - filtered)) < 4 * error
    assert 0 <= found.value < 50
    assert found.share > 0.1


def test_drawn_slopes_scatter_as_they_say(met: PersonFit) -> None:
    found = [particle_slope(met.space, np.array(met.theta), seed) for seed in range(12)]
    told = np.diag(found[0].noise) > 0
    scatter = np.var([one.slope[told] for one in found], axis=0, ddof=1)
    said = np.mean([np.diag(one.noise)[told] for one in found], axis=0)
    # Variances of twelve draws lie within a factor of three; particles add more than on a seat.
    assert np.all((scatter / said > 0.2) & (scatter / said < 4.0))


def test_it_goes_uphill_by_particles_and_stays_near(met: PersonFit) -> None:
    found = with_particles(met)
    assert found is not met
    values = [by_particles(met, np.array(each.theta), 800, 5) for each in (met, found)]
    posed = [met.prior.value(np.array(each.theta)) for each in (met, found)]
    assert values[1] + posed[1] > values[0] + posed[0] - 1
    np.testing.assert_allclose(found.K, met.K, rtol=0.2)
    again = with_particles(met)
    np.testing.assert_array_equal(found.theta, again.theta)


def test_the_tilt_of_a_prior_has_the_slope_that_it_says(met: PersonFit) -> None:
    theta, prior = np.array(met.theta), met.prior
    rng = np.random.default_rng(1)
    curvature = prior.parabola(prior.placed(theta, met.told), np.zeros(len(theta)))[1]
    root = np.linalg.cholesky(curvature)
    slope = root @ rng.standard_normal(len(theta))
    tilted = TiltedPrior(prior, theta, slope, curvature)
    np.testing.assert_allclose(tilted.slopes(theta)[0] - prior.slopes(theta)[0], slope, rtol=1e-8)
    assert tilted.value(theta) == pytest.approx(prior.value(theta), rel=1e-12)
    there = theta + np.linalg.solve(root.T, rng.standard_normal(len(theta)))
    way = np.linalg.solve(root.T, rng.standard_normal(len(theta)))

    def moved(t: float) -> Array:
        return np.array([tilted.value(there + t * way) - prior.value(there + t * way)])

    exact = (tilted.slopes(there)[0] - prior.slopes(there)[0]) @ way
    assert exact == pytest.approx(extrapolated_slope(moved, 1e-3)[0], rel=1e-6)


def test_where_no_bound_is_met_nothing_changes() -> None:
    fit = fit_person(estimate(problem(50.0)), person())
    assert with_particles(fit) is fit


def test_noise_by_a_share_is_left_to_the_filter(met: PersonFit) -> None:
    assert particles_serve(met.problem, met.space)
    fit = fit_person(estimate(problem(0.7)), person(share=0.1), max_evaluations=15)
    assert not particles_serve(fit.problem, fit.space)
    assert with_particles(fit) is fit
