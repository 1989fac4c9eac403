"""Covariances of a person at the largest likelihood: three ways, and against repeated people."""

from __future__ import annotations

import numpy as np
import pytest

from impc.assess.person_covariance import (
    HARDLY,
    confusion,
    person_covariance,
    with_curvature,
)
from impc.errors import InputError
from impc.inverse.likelihood_fit import PersonFit, fit_person
from impc.inverse.likelihood_search import climb
from impc.inverse.methods import estimate
from impc.model.observer import Observer
from tests.inverse.test_likelihood_fit import cart, posed


@pytest.fixture(scope="module")
def fitted() -> PersonFit:
    person = Observer(cart(), ["x"], motor=0.4, sensory=0.05)
    return fit_person(estimate(posed(person, 0.01, 3.0, trials=4)), person)


def test_the_three_agree_where_the_model_is_true(fitted: PersonFit) -> None:
    found = {kind: person_covariance(fitted, kind) for kind in ("expected", "observed", "sandwich")}
    for kind in ("observed", "sandwich"):
        # 1600 samples: a deviation is itself told to a tenth or two.
        np.testing.assert_allclose(found[kind].entries, found["expected"].entries, rtol=0.4)
        np.testing.assert_allclose(found[kind].levels, found["expected"].levels, rtol=0.4)


def test_the_observed_information_is_the_curvature(fitted: PersonFit) -> None:
    """Second differences of the likelihood along a line."""
    space, theta = fitted.space, np.array(fitted.theta)
    information = np.linalg.inv(np.array(person_covariance(fitted, "observed").covariance))
    step = np.zeros(len(theta))
    step[[0, 1, -1]] = 0.3, -0.2, 0.5
    h = 1e-3
    values = [space.value(theta + sign * h * step) for sign in (-1, 0, 1)]
    curvature = -(values[0] - 2 * values[1] + values[2]) / h**2
    # Rounding of 1e-12 of 5000 nats over 1e-6, and h^2.
    assert step @ information @ step == pytest.approx(curvature, rel=1e-3)


def test_curvature_is_where_searches_end_with_a_level_held(fitted: PersonFit) -> None:
    """The noise of the sense is hardly told: all else is searched with it held, forth and back."""
    found, prior, theta = person_covariance(fitted), fitted.prior, np.array(fitted.theta)
    told = [*found.deviations, found.levels[0], found.levels[2]]
    assert max(told) < HARDLY < found.levels[1]
    others = np.delete(np.eye(len(theta)), fitted.space.own + 1, axis=1)
    way, losing = np.eye(len(theta))[fitted.space.own + 1], np.array(fitted.losing)
    bend = prior.parabola(prior.placed(theta, fitted.told), losing)[1]
    ridge = -others @ np.linalg.solve(others.T @ bend @ others, others.T @ bend @ way) + way
    added = np.zeros((len(theta), len(theta)))
    for sign in (1, -1):
        start = theta + sign * found.levels[1] * ridge
        place, _, _, settled = climb(prior, prior.at(start), 20, others, losing)
        assert settled
        shift = (place.theta - start) * (np.arange(len(theta)) < fitted.space.own)
        added += np.outer(shift, shift) / 2
    curved = with_curvature(fitted, found)
    units = np.sqrt(np.outer(np.diag(added), np.diag(added)))
    difference = np.abs(curved.covariance - found.covariance - added)
    assert np.all(difference <= 0.01 * units + 1e-12)  # a search ends at a tenth of a deviation
    assert np.all(curved.entries > found.entries)
    np.testing.assert_array_equal(curved.levels, found.levels)
    assert curved.kind == "sandwich"


def test_what_is_told_bends_nothing(fitted: PersonFit) -> None:
    seeing = Observer(cart(), motor=0.4)
    plain = fit_person(estimate(posed(seeing, 0.01, 3.0)), seeing)
    found = person_covariance(plain)
    assert max([*found.deviations, *found.levels]) < HARDLY
    assert with_curvature(plain, found) is found


def test_the_step_that_is_least_told_apart(fitted: PersonFit) -> None:
    """Moved along it together, gain and levels cost less than each of them alone."""
    found = confusion(fitted)
    assert 0 < found.correlation < 1
    covariance = np.array(person_covariance(fitted, "expected").covariance)
    assert found.gain.shape == (1, 2)
    assert found.levels.shape == (3,)
    direction = np.array(found.levels) / np.linalg.norm(found.levels)
    levels = slice(fitted.space.own, None)
    inside = direction @ np.linalg.inv(np.linalg.inv(covariance)[levels, levels]) @ direction
    assert inside <= direction @ covariance[levels, levels] @ direction


def test_an_unknown_kind_is_refused(fitted: PersonFit) -> None:
    with pytest.raises(InputError, match="expected, observed, sandwich"):
        person_covariance(fitted, "robust")
