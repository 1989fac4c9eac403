"""What scores do not have: against searches, and against many values on either side."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from experiments.noisy_people import recorded, subject
from experiments.noisy_people_score import blind
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

if TYPE_CHECKING:
    from impc.arrays import Array

pytestmark = pytest.mark.full


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


def deviations(fit: PersonFit) -> list[Array]:
    """One deviation along each direction of the gain, initial states on their ridge."""
    space, own = fit.space, fit.space.own
    here, steps = fit.prior.at(np.array(fit.theta)), []
    information = np.array(here.told.information) + fit.prior.slopes(here.theta)[1]
    covariance = np.linalg.inv(information[:own, :own])
    for direction in np.linalg.eigh(covariance[: space.gain, : space.gain])[1].T:
        step = np.zeros(len(here.theta))
        step[:own] = covariance[:, : space.gain] @ direction
        steps.append(step / np.sqrt(direction @ step[: space.gain]))
    return steps


def heights(fit: PersonFit, offsets: Array, step: Array) -> list[float]:
    """Likelihood times prior so many deviations away, logarithms."""
    places = np.array(fit.theta) + offsets[:, None] * step
    return [fit.space.value(place) + fit.prior.value(place) for place in places]


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
    prior = jumping.prior
    here = prior.at(np.array(jumping.theta))
    unseen = unseen_slope(prior, here)
    offsets, missed = np.linspace(-1.5, 1.5, 60), []
    for step in deviations(jumping):
        seen = float((here.told.gradient + prior.slopes(here.theta)[0]) @ step)
        # Between -1 and 1: first + third.
        third, _, first, _ = np.polyfit(offsets, heights(jumping, offsets, step), 3)
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


def test_the_search_for_somebody_at_a_limit_ends_where_the_likelihood_is_highest() -> None:
    """Of parabolas through many values along each direction of the gain, jumps and all."""
    who = subject("seat", 3, "sensory", 90.0, 6.0)
    found = fit_person(estimate(recorded(who, 3).problem), blind(who))
    assert found.converged
    tops = []
    for step in deviations(found):
        offsets = np.linspace(-1.5, 1.5, 30)
        second, first, _ = np.polyfit(offsets, heights(found, offsets, step), 2)
        tops.append(-first / (2 * second))
    assert np.max(np.abs(tops)) < 0.1  # .13 where jumps are not asked for
