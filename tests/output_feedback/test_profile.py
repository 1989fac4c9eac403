"""Profile intervals of noise SDs, against another maximiser and against standard errors."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import scipy.optimize

import impc
from experiments.noisy_people import recorded, subject
from experiments.noisy_people_score import blind
from impc.arrays import Array
from impc.output_feedback.covariance import person_covariance
from impc.output_feedback.fit import OutputFeedbackFit, fit_output_feedback
from impc.output_feedback.observer import Observer
from impc.output_feedback.profile import (
    entry_intervals,
    fallen,
    level_interval,
    level_intervals,
    profile,
)
from impc.output_feedback.search import unseen_slope
from tests.output_feedback.test_fit import cart, posed

pytestmark = pytest.mark.full


@pytest.fixture(scope="module")
def fitted() -> OutputFeedbackFit:
    """Motor noise is well identified; the noise of a sensed state that is also recorded is not."""
    person = Observer(cart(), ["x"], motor=0.4, sensory=0.01)
    return fit_output_feedback(impc.fit(posed(person, 0.01, 3.0)), person)


def test_a_level_that_is_well_told_has_the_interval_of_its_deviation(
    fitted: OutputFeedbackFit,
) -> None:
    index = fitted.space.names.index("recorder x")
    expected = person_covariance(fitted, "expected")
    assert expected.levels[index] < 0.1
    assert fitted.levels[index] == pytest.approx(fitted.recorder[0])
    # Measured: 0.8 % below, 0.0 above, of a deviation of 2.8 %.
    np.testing.assert_allclose(
        level_interval(fitted, index), expected.level_intervals(fitted.levels)[index], rtol=0.01
    )


@pytest.mark.parametrize(
    ("name", "end"), [("motor u", 0), ("motor u", 1), ("sensory x", 1), ("gain", 0), ("gain", 1)]
)
def test_at_its_end_the_likelihood_has_fallen(
    fitted: OutputFeedbackFit, name: str, end: int
) -> None:
    """By half of 1.96^2, maximised over all else by another search."""
    names, own = fitted.space.names, fitted.space.own
    index = own + names.index(name) if name in names else 0  # or the first coordinate of the gain
    value = profile(fitted, np.eye(len(fitted.theta))[index])[end]
    free = np.delete(np.arange(len(fitted.theta)), index)
    information = np.array(fitted.identified.information)[np.ix_(free, free)] + 0.1 * np.eye(
        len(free)
    )
    root = np.linalg.inv(np.linalg.cholesky(information)).T  # steps of one are deviations
    prior = fitted.prior
    unseen = unseen_slope(prior, prior.at(np.insert(np.array(fitted.theta)[free], index, value)))

    def climbed(steps: Array) -> tuple[float, Array]:
        here = prior.at(np.insert(fitted.theta[free] + root @ steps, index, value))
        gradient = here.identified.gradient + prior.slopes(here.theta)[0] + unseen
        return -here.value, -root.T @ gradient[free]

    found = scipy.optimize.minimize(
        climbed, np.zeros(len(free)), jac=True, method="BFGS", options={"gtol": 1e-3}
    )
    top = fitted.value
    if index:  # nothing is expected of the level that is held
        there = np.insert(np.array(fitted.theta)[free], index, value)
        top += (prior.unlike(np.array(fitted.theta)) - prior.unlike(there))[index - own]
    # The root of what has fallen is found to 0.04 of 1.39.
    assert top + found.fun == pytest.approx(1.920729, abs=0.12)
    assert fallen(fitted, np.eye(len(fitted.theta))[index], value) == pytest.approx(
        top + found.fun, abs=0.02
    )


def test_entries_of_the_gain_that_are_told_have_intervals(fitted: OutputFeedbackFit) -> None:
    """Near a parabola they equal those of the standard error; unidentified entries have none."""
    expected = person_covariance(fitted, "expected")
    ends = entry_intervals(fitted, expected)
    about = np.ravel(fitted.K)[:, None] + 1.96 * np.ravel(expected.entries)[:, None] * [-1, 1]
    np.testing.assert_allclose(ends, about, rtol=0.05)
    vague = dataclasses.replace(expected, entries=10 + expected.entries)
    assert np.all(np.isnan(entry_intervals(fitted, vague)))


def test_a_level_that_is_hardly_told_has_its_interval_by_profile(fitted: OutputFeedbackFit) -> None:
    index = fitted.space.names.index("sensory x")
    low, high = level_interval(fitted, index)
    assert 0 <= low < 0.01 < high < 1.0
    covariance = person_covariance(fitted)
    intervals = level_intervals(fitted, covariance)
    assert covariance.levels[index] > 0.25
    np.testing.assert_array_equal(intervals[index], [low, high])
    assert intervals.shape == (len(fitted.space.names), 2)


def test_a_level_that_may_be_none_is_told_on_one_side() -> None:
    """A subject whose senses are almost exact."""
    person = Observer(cart(), ["x", "v"], motor=0.4, sensory=[1e-4, 1e-4])
    fit = fit_output_feedback(impc.fit(posed(person, 0.01, 3.0)), person)
    low, high = level_interval(fit, fit.space.names.index("sensory x"))
    assert low == 0.0
    assert 1e-4 < high < 10.0  # metres: closed above, whatever is not expected of it


@pytest.mark.parametrize("seed", [0, 3])
def test_a_sense_that_is_hardly_told_leaves_the_motor_noise_its_own(seed: int) -> None:
    """Without a prior a sensory noise SD tends to zero here, and motor noise takes its part."""
    who = subject("cart", seed, "both", 90.0, 0.7)
    first, motor = impc.fit(recorded(who, seed).problem), float(who.person.levels[0])
    fit = fit_output_feedback(first, blind(who))
    low, high = person_covariance(fit, "expected").level_intervals(fit.levels)[0]
    assert low < motor < high
    free = fit_output_feedback(first, blind(who), spread=np.inf)
    deviations = person_covariance(free, "expected").levels
    assert np.max(deviations) > 10
    assert free.observer.motor[0] > fit.observer.motor[0]


@pytest.mark.slow
def test_all_levels_are_in_their_intervals() -> None:
    """A subject with noise in motor and senses, at the limit, as the report prints it."""
    who = subject("cart", 1, "both", 90.0, 0.7)
    fit = fit_output_feedback(impc.fit(recorded(who, 1).problem), blind(who))
    true = [*who.person.levels[who.person.levels > 0], *who.recorder]
    intervals = level_intervals(fit, person_covariance(fit, "expected"))
    assert all(low < level < high for level, (low, high) in zip(true, intervals, strict=True))
