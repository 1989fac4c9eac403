"""People as likely: the sandwich of each, and the ends of all."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from impc.assess.likely_people import (
    LikelyPerson,
    direction_intervals,
    entry_intervals,
    level_intervals,
    people_as_likely,
)
from impc.assess.person_covariance import person_covariance
from impc.assess.person_profile import profile
from impc.inverse.likelihood_fit import PersonFit, fit_person, person_at
from impc.inverse.methods import estimate
from impc.model.observer import Observer
from tests.inverse.test_likelihood_fit import cart, posed

pytestmark = pytest.mark.full


@pytest.fixture(scope="module")
def fitted() -> PersonFit:
    """Position and speed are sensed; their noise is hardly told apart from six seconds."""
    person = Observer(cart(), ["x", "v"], motor=0.4, sensory=[0.05, 0.05])
    return fit_person(estimate(posed(person, 0.01, 3.0)), person)


@pytest.fixture(scope="module")
def people(fitted: PersonFit) -> list[LikelyPerson]:
    return people_as_likely(fitted)


def test_each_is_as_likely_as_a_number_inside_an_interval(
    fitted: PersonFit, people: list[LikelyPerson]
) -> None:
    """By the likelihood anew; one is among them whose senses err a quarter less."""
    assert len(people) > 1
    assert people[0].fit is fitted
    values = [one.prior.at(np.array(one.theta)).value for one, _ in people]
    assert_allclose(values, [one.value for one, _ in people], atol=1e-9)
    assert max(values) - min(values) <= 1.920729
    shares = [min(one.observer.sensory / fitted.observer.sensory) for one, _ in people[1:]]
    assert min(shares) < 0.75


def test_the_one_that_was_found_is_inside_whoever_is_likelier(fitted: PersonFit) -> None:
    """A search may end where another hill is higher: what is printed is in its intervals still."""
    theta = np.array(fitted.theta)
    theta[0] += 3 * np.array(person_covariance(fitted).covariance)[0, 0] ** 0.5
    lower = person_at(fitted.prior, fitted.prior.at(theta), np.array(fitted.unseen), False, 1)
    people = people_as_likely(lower)
    assert lower.value < max(one.value for one, _ in people) - 1.920729
    low, high = entry_intervals(people).T
    assert np.all((low < np.ravel(lower.K)) & (np.ravel(lower.K) < high))
    assert np.all((low < np.ravel(fitted.K)) & (np.ravel(fitted.K) < high))
    low, high = level_intervals(people).T
    assert np.all((low < lower.levels) & (lower.levels < high))


def test_intervals_reach_from_the_lowest_end_to_the_highest(
    fitted: PersonFit, people: list[LikelyPerson]
) -> None:
    ends = entry_intervals(people)
    for k in range(fitted.K.size):
        about = [(np.ravel(one.K)[k], np.ravel(told.entries)[k]) for one, told in people]
        assert ends[k, 0] == pytest.approx(min(K - 1.959964 * s for K, s in about))
        assert ends[k, 1] == pytest.approx(max(K + 1.959964 * s for K, s in about))
    levels = level_intervals(people)
    names = fitted.space.names
    assert levels.shape == (len(names), 2)
    values = [one.levels for one, _ in people]
    for k in range(len(names)):
        about = [
            (v[k], np.exp(1.959964 * t.levels[k])) for v, (_, t) in zip(values, people, strict=True)
        ]
        assert levels[k, 0] == pytest.approx(min(v / factor for v, factor in about))
        assert levels[k, 1] == pytest.approx(max(v * factor for v, factor in about))


def test_along_an_entry_a_direction_has_the_interval_of_the_entry(
    fitted: PersonFit, people: list[LikelyPerson]
) -> None:
    dK, _ = fitted.space.changes(fitted.theta)
    ways = dK.reshape(len(dK), -1).T[:, : fitted.space.gain]
    begin = np.ravel(fitted.K) - ways @ fitted.theta[: fitted.space.gain]
    found = direction_intervals(people, ways) + begin[:, None]
    assert_allclose(found, entry_intervals(people), rtol=1e-9)


def test_who_sees_every_state_has_one_hill() -> None:
    """No sense can be exact instead: the sandwich about the fit, or farther along one direction."""
    seeing = Observer(cart(), motor=0.4)
    fit = fit_person(estimate(posed(seeing, 0.01, 3.0, trials=1)), seeing)
    people, sandwich = people_as_likely(fit), person_covariance(fit)
    assert [one for one, told in people if np.any(told.covariance)] == [fit]
    low, high = entry_intervals(people[:1]).T
    assert_array_equal(np.transpose([low, high]), sandwich.entry_intervals(fit.K))
    wider = entry_intervals(people).T
    assert np.all((wider[0] <= low) & (high <= wider[1]))
    np.testing.assert_allclose(wider, (low, high), rtol=0.1)


def test_where_a_hill_is_flat_an_interval_reaches_as_far_as_the_profile() -> None:
    """Of the direction of the gain that is least told, with noisy senses at a limit."""
    person = Observer(cart(), ["x", "v"], motor=0.05, sensory=[0.3, 0.6])
    fit = fit_person(estimate(posed(person, 0.01, 0.6, trials=1)), person)
    people, along = people_as_likely(fit), np.zeros(len(fit.theta))
    sandwich, least = people[0].covariance, max(one.value for one, _ in people) - 1.920729
    assert sandwich.deviations[-1] < 0.25
    along[: fit.space.gain] = sandwich.directions[-1]
    ends = (np.array(profile(fit, along)) - along @ fit.theta) / sandwich.deviations[-1]
    far = [one for one, told in people if not np.any(told.covariance)]
    off = np.array([along @ (one.theta - fit.theta) for one in far]) / sandwich.deviations[-1]
    assert all(one.value >= least for one in far)
    # Measured: -2.86 and 1.96, by profile -2.89 and 2.08; the sandwich ends at 1.96.
    assert np.min(off) < -2.5
    np.testing.assert_allclose([np.min(off), np.max(off)], ends, rtol=0.12)
