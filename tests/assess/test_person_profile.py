"""Intervals of levels by profile, against another maximiser and against deviations."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.optimize

from experiments.noisy_people import Subject, recorded, subject
from experiments.noisy_people_study import blind, true_unknowns
from impc.arrays import Array
from impc.assess.person_covariance import person_covariance
from impc.assess.person_profile import level_interval, level_intervals
from impc.inverse.likelihood_fit import PersonFit, fit_person
from impc.inverse.likelihood_search import climb, reach
from impc.inverse.methods import estimate
from impc.model.observer import Observer
from tests.inverse.test_likelihood_fit import cart, posed


@pytest.fixture(scope="module")
def fitted() -> PersonFit:
    """Motor noise is well told; the sense of a state that is recorded too is not."""
    person = Observer(cart(), ["x"], motor=0.4, sensory=0.01)
    return fit_person(estimate(posed(person, 0.01, 3.0)), person)


@pytest.fixture(scope="module")
def slid() -> tuple[Subject, PersonFit]:
    """A cart at its limit, seed 1, and a fit in which both senses slid to none."""
    who = subject("cart", 1, "both", 90.0, 0.7)
    return who, fit_person(estimate(recorded(who, 1).problem), blind(who))


def test_a_level_that_is_well_told_has_the_interval_of_its_deviation(fitted: PersonFit) -> None:
    index = fitted.space.names.index("recorder x")
    expected = person_covariance(fitted, "expected")
    assert expected.levels[index] < 0.1
    value = float(fitted.recorder[0])
    # Measured: 0.8 % below, 0.0 above, of a deviation of 2.8 %.
    np.testing.assert_allclose(
        level_interval(fitted, index), expected.level_interval(index, value), rtol=0.01
    )


@pytest.mark.parametrize(("name", "end"), [("motor u", 0), ("motor u", 1), ("sensory x", 1)])
def test_at_its_end_the_likelihood_has_fallen(fitted: PersonFit, name: str, end: int) -> None:
    """By half of 1.96^2, all else being at its best by another search."""
    index = fitted.space.own + fitted.space.names.index(name)
    value = np.log(level_interval(fitted, index - fitted.space.own)[end])
    free = np.delete(np.arange(len(fitted.theta)), index)
    information = np.array(fitted.told.information)[np.ix_(free, free)] + 0.1 * np.eye(len(free))
    root = np.linalg.inv(np.linalg.cholesky(information)).T  # steps of one are deviations

    def climbed(steps: Array) -> tuple[float, Array]:
        theta = np.insert(fitted.theta[free] + root @ steps, index, value)
        told = fitted.space.told(theta)
        gradient = told.gradient + fitted.prior.slopes(theta)[0]
        return -told.value - fitted.prior.value(theta), -root.T @ gradient[free]

    found = scipy.optimize.minimize(
        climbed, np.zeros(len(free)), jac=True, method="BFGS", options={"gtol": 1e-3}
    )
    top = fitted.log_likelihood + fitted.prior.value(fitted.theta)
    # The root of what has fallen is found to 0.04 of 1.39.
    assert top + found.fun == pytest.approx(1.920729, abs=0.12)


def test_a_level_that_may_be_none_is_told_on_one_side(fitted: PersonFit) -> None:
    index = fitted.space.names.index("sensory x")
    low, high = level_interval(fitted, index)
    assert low == 0.0
    assert 0.01 < high < 1.0
    covariance = person_covariance(fitted)
    intervals = level_intervals(fitted, covariance)
    assert covariance.levels[index] > 0.25
    np.testing.assert_array_equal(intervals[index], [low, high])
    assert intervals.shape == (len(fitted.space.names), 2)


def test_where_senses_slid_to_none_the_motor_level_is_told_less(
    slid: tuple[Subject, PersonFit],
) -> None:
    """The truth is beyond the deviation of the motor noise.

    The likelihood does not rule it out: with the true motor noise held, a search that begins at the
    truth ends higher than where an interval of 95 % does.
    """
    who, fit = slid
    expected, motor = person_covariance(fit, "expected"), float(who.person.levels[0])
    found = float(np.exp(fit.theta[fit.space.own]))
    assert not expected.level_interval(0, found)[0] < motor

    truth = true_unknowns(fit, who)
    box = reach(fit.space, truth)
    for side in box:
        side[fit.space.own] = np.log(motor)
    there, told, _, _ = climb(fit.prior, truth, box, 30)
    top = fit.log_likelihood + fit.prior.value(fit.theta)
    assert top - told.value - fit.prior.value(there) < 1.920729

    low, high = level_interval(fit, 0)
    assert low < motor < found < high


@pytest.mark.slow
def test_all_levels_have_a_profile_where_one_slid_to_none(
    slid: tuple[Subject, PersonFit],
) -> None:
    """The same person, as the page prints it."""
    who, fit = slid
    true = [*who.person.levels[who.person.levels > 0], *who.recorder]
    intervals = level_intervals(fit, person_covariance(fit, "expected"))
    assert all(low < level < high for level, (low, high) in zip(true, intervals, strict=True))
