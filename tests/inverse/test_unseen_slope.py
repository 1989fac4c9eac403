"""What scores do not have: against searches, and against many values on either side."""

from __future__ import annotations

import numpy as np
import pytest

from experiments.noisy_people import recorded, subject
from experiments.noisy_people_score import blind, true_unknowns
from impc.assess.person_covariance import person_covariance
from impc.control.controller import Controller
from impc.control.noisy_person import simulate_person
from impc.inverse.likelihood_fit import PersonFit, fit_person
from impc.inverse.likelihood_search import climb
from impc.inverse.methods import estimate
from impc.inverse.problem import Problem
from impc.inverse.unseen_slope import learned_slope, unseen_slope
from impc.model.bounds import Bounds
from impc.model.observer import Observer
from impc.model.recordings import Recording
from impc.model.weights import Weights
from tests.inverse.test_likelihood_fit import cart, posed
from tests.inverse.test_likelihood_search import sliding_person


@pytest.fixture(scope="module")
def sliding() -> PersonFit:
    return sliding_person()


@pytest.fixture(scope="module")
def jumping() -> PersonFit:
    """Someone with noisy senses who is at a limit all the time, and plans ten samples ahead."""
    person = Observer(cart(), ["x", "v"], motor=0.05, sensory=[0.3, 0.5])
    bounds = Bounds(cart(), u_min=-0.4, u_max=0.4)
    law = Controller(cart(), Weights(np.diag([40.0, 4.0]), 1), bounds, 10, terminal_set=False)
    rng, trials = np.random.default_rng(0), []
    for seed in range(2):
        push = np.repeat(rng.choice([-0.7, 0.0, 0.7], 40), 10)
        found = simulate_person(law, person, push, recorder=0.01, seed=seed)
        trials.append(Recording(cart(), found.outputs, push))
    problem = Problem(cart(), bounds, 10, trials, terminal_set=False, unknown_start=True)
    return fit_person(estimate(problem), person)


def test_the_slope_of_what_levels_lose_follows_the_ridge(sliding: PersonFit) -> None:
    """Against searches of all else with a level a little lower and higher."""
    prior, theta = sliding.prior, np.array(sliding.theta)
    own = sliding.space.own
    found, others, step = unseen_slope(prior, prior.at(theta)), np.eye(len(theta))[:, :own], 0.05
    for index in (own, own + 3):  # those that are told: motor, recorder
        lost = []
        for sign in (-1, 1):
            start = theta + sign * step * np.eye(len(theta))[index]
            there = prior.at(start)
            place, _, _, settled = climb(prior, there, 30, others, np.array(sliding.unseen))
            assert settled
            lost.append(place.lost)
        # Measured: .05 apart, for the first is a step of a tenth to one side.
        assert found[index] == pytest.approx((lost[0] - lost[1]) / (2 * step), abs=0.1)


def test_jumps_have_a_slope_that_no_score_has(jumping: PersonFit) -> None:
    """Against a cubic through sixty values of the likelihood within a deviation and a half."""
    prior, space, own = jumping.prior, jumping.space, jumping.space.own
    here = prior.at(np.array(jumping.theta))
    unseen = unseen_slope(prior, here)
    information = (
        np.array(here.told.information)[:own, :own] + prior.slopes(here.theta)[1][:own, :own]
    )
    covariance = np.linalg.inv(information)
    offsets, missed = np.linspace(-1.5, 1.5, 60), []
    for direction in np.linalg.eigh(covariance[: space.gain, : space.gain])[1].T:
        step = np.zeros(len(here.theta))
        step[:own] = covariance[:, : space.gain] @ direction
        step /= np.sqrt(direction @ step[: space.gain])
        places = here.theta + offsets[:, None] * step
        values = [space.value(place) + prior.value(place) for place in places]
        seen = float((here.told.gradient + prior.slopes(here.theta)[0]) @ step)
        third, _, first, _ = np.polyfit(offsets, values, 3)  # between -1 and 1: first + third
        missed.append((first + third - seen, float(unseen @ step)))
    many, two = np.transpose(missed)
    np.testing.assert_allclose(two, many, atol=0.1)
    assert np.max(np.abs(two)) > 0.2


def test_without_a_bound_scores_have_all_of_the_gain() -> None:
    person = Observer(cart(), ["x"], motor=0.4, sensory=0.05)
    free = fit_person(estimate(posed(person, 0.01, 30.0)), person)
    assert not np.any(
        unseen_slope(free.prior, free.prior.at(np.array(free.theta)))[: free.space.own]
    )


def test_what_levels_lose_is_learned_and_jumps_are_not(jumping: PersonFit) -> None:
    """After a long step along one level the slope along it is what was lost over the length."""
    prior, theta, own = jumping.prior, np.array(jumping.theta), jumping.space.own
    here, slope = prior.at(theta.copy()), np.array(jumping.unseen)
    theta[own] += 2.0
    theta[0] += 0.1
    there = prior.at(theta)
    learned = learned_slope(prior, slope, here, there)
    assert learned[own] == pytest.approx((here.lost - there.lost) / 2, rel=0.05)
    np.testing.assert_array_equal(np.delete(learned, own), np.delete(slope, own))


@pytest.mark.full
def test_the_gain_of_somebody_at_a_limit_is_where_the_likelihood_is_highest() -> None:
    """Where scores alone had ended three of ten entries held, and errors were 20 in chi-square."""
    who = subject("seat", 2, "sensory", 90.0, 6.0)
    found = fit_person(estimate(recorded(who, 2).problem), blind(who))
    covariance, gain = person_covariance(found), found.space.gain
    error = found.theta[:gain] - true_unknowns(found, who)[:gain]
    z = np.array(covariance.directions) @ error / np.array(covariance.deviations)
    assert z @ z < 15
