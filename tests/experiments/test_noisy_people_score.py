"""The study of people who sense with noise, small: one subject scored; more in the slow one."""

from __future__ import annotations

import numpy as np
import pytest

from experiments.noisy_people import recorded, subject
from experiments.noisy_people_score import Score, above_truth, blind, falls, passed_over, score
from impc.checking import replace
from impc.inverse.methods import fit
from impc.model.structure import Structure
from impc.output_feedback.covariance import person_covariance
from impc.output_feedback.fit import fit_person
from impc.output_feedback.profile import profile

pytestmark = pytest.mark.full


def scored(seed: int, limit: float) -> Score:
    who = subject("cart", seed, "motor", 90.0, limit)
    return score(who, recorded(who, seed), "carts", seed, profiled=seed == 0)


def test_a_subject_is_scored_against_its_truth() -> None:
    found = scored(0, 0.7)
    assert len(found.seconds) == 3
    assert 80 < found.vaf < 97
    assert found.converged
    assert found.above > 0
    assert len(found.expected) == len(found.entries) == len(found.fell) == 2
    # At a parabola's end of 95 % the likelihood has fallen by 1.92.
    for (error, deviation), nats in zip(found.expected, found.fell, strict=True):
        assert nats == pytest.approx((error / deviation) ** 2 / 2, abs=0.3)
    for error, deviation in found.expected:
        assert abs(error) < 4 * deviation  # seed 0
    assert np.log(found.found[0] / found.levels[0]) == pytest.approx(0, abs=0.3)


def test_the_seat_is_held_at_its_limit() -> None:
    who = subject("seat", 5, "motor", 90.0, 6.0)
    trials = recorded(who, 5)
    assert 0.1 < trials.saturated < 0.4
    assert 85 < trials.vaf < 95
    assert not passed_over(who, trials, 5, met=True)


def test_who_falls_or_is_seldom_at_the_limit_is_no_subject() -> None:
    who = subject("seat", 5, "sensory", 90.0, 6.0)
    assert passed_over(who, recorded(who, 5), 5, met=True) == "falls"
    who = subject("seat", 1, "sensory", 90.0, 6.0)
    seldom = recorded(who, 1)
    assert seldom.saturated < 0.12
    assert passed_over(who, seldom, 1, met=True) == "not so often at the limit"
    assert not passed_over(who, seldom, 1, met=False)


def test_who_falls_where_nobody_records_is_no_subject_either() -> None:
    """None of three trials ends in a fall, of sixty others some do."""
    who = subject("seat", 4, "sensory", 70.0, 9.0)
    trials = recorded(who, 4)
    assert trials.largest < 1
    assert 0.12 < trials.saturated < 0.4
    assert 1 <= falls(who, 4) < 20
    assert passed_over(who, trials, 4, met=True) == "falls"


@pytest.mark.full
def test_on_the_seat_a_person_is_told_where_least_squares_is_far_off() -> None:
    """Noise in the senses: least squares has five times the gain, in coordinates of its own."""
    who = subject("seat", 2, "sensory", 90.0, 70.0)
    trials, truth = recorded(who, 2), np.array(who.controller.K)
    first = fit(trials.problem)
    assert np.array(first.gain)[0, 0] > 4 * truth[0, 0]
    found = fit_person(first, blind(who))
    assert found.converged
    assert found.space.gain == 5
    np.testing.assert_allclose(found.K[0, :4], truth[0, :4], rtol=0.2)
    # The prior is that about a gain close by, in whose coordinates there are less than half units.
    assert np.linalg.norm((np.array(found.theta) - found.prior.center)[:5]) < 0.5
    covariance = person_covariance(found)
    z = (np.array(found.K) - truth)[0] / np.array(covariance.entries)[0]
    assert np.all(np.abs(z[:4]) < 1.96)


@pytest.mark.full
def test_a_search_leaves_somebody_who_knows_the_rates_exactly() -> None:
    """The likeliest start leads there, 80 nats below the truth, and settles."""
    who = subject("seat", 16, "motor", 70.0, 70.0)
    found = fit_person(fit(recorded(who, 16).problem), blind(who))
    truth = np.array(who.controller.K)
    assert found.converged
    assert above_truth(found, who) > 0
    np.testing.assert_allclose(found.K[0, :4], truth[0, :4], rtol=0.2)


@pytest.mark.full
def test_a_profile_tells_the_first_entry() -> None:
    """N m/rad: 844 +- 204 by the sandwich, by profile 678 to 1342; 970 is true."""
    who = subject("seat", 1, "both", 70.0, 70.0)
    found = fit_person(fit(recorded(who, 1).problem), blind(who))
    truth, K = float(np.array(who.controller.K)[0, 0]), float(np.array(found.K)[0, 0])
    slopes = found.space.changes(found.theta)[0][:, 0, 0]
    length = float(np.linalg.norm(slopes))
    along = np.zeros(len(found.theta))
    along[: len(slopes)] = slopes / length
    low, high = K + length * (np.array(profile(found, along)) - float(along @ found.theta))
    assert 0.6 * truth < low < truth < high < 1.6 * truth


@pytest.mark.full
def test_a_structure_that_is_wrong_is_seen() -> None:
    """Prices on one angle and its rate alone: the same person with any gain is preferred."""
    who = subject("seat", 1, "motor", 90.0, 70.0)
    problem = recorded(who, 1).problem
    shape = Structure(problem.plant, "full", over=["theta1", "theta1_rate"])
    first = fit(replace(problem, structure=shape))
    kept = fit_person(first, blind(who))
    free = fit_person(replace(first, problem=replace(problem, structure=None)), blind(who))
    assert kept.space.gain < 5
    assert kept.criterion - free.criterion > 4


@pytest.mark.slow
def test_intervals_of_the_likelihood_hold() -> None:
    """Of 40 at 95 % two miss: 8 or more have a probability of 0.1 %."""
    people = [scored(seed, 5.0) for seed in range(40)]
    pairs = np.array([one.expected for one in people])
    assert np.all(np.sum(np.abs(pairs[..., 0]) > 1.96 * pairs[..., 1], axis=0) < 8)
