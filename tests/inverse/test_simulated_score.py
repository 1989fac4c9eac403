"""The mean score of a person where that person is the truth."""

from __future__ import annotations

import numpy as np
import pytest

from experiments.noisy_people import recorded, subject
from impc.checking import replace
from impc.errors import SolverError
from impc.inverse.coordinates import Point
from impc.inverse.likelihood_fit import PersonFit, fit_person
from impc.inverse.likelihood_start import Asked, gain_space, prior_about
from impc.inverse.methods import estimate
from impc.inverse.person_coordinates import PersonCoordinates
from impc.inverse.simulated_score import left_behind, simulated_score
from impc.model.recordings import Recording
from tests.inverse.noisy_cart import person, problem
from tests.inverse.test_likelihood_fit import cart

pytestmark = pytest.mark.full


def fitted(limit: float) -> PersonFit:
    return fit_person(estimate(problem(limit)), person())


@pytest.fixture(scope="module")
def free() -> PersonFit:
    return fitted(50.0)


def test_it_is_zero_where_the_likelihood_is_exact(free: PersonFit) -> None:
    """And scatters as Fisher's information says: of 60 sets a variance is known to a fifth."""
    theta = np.array(free.theta)
    found = simulated_score(free.prior, theta, 0, 60)
    shared = np.r_[0 : free.space.shared, free.space.after : len(theta)]
    root = np.linalg.cholesky(free.told.information[np.ix_(shared, shared)])
    whitened = np.linalg.solve(root, found.mean[shared]) * np.sqrt(60)
    assert np.max(np.abs(whitened)) < 4
    half = np.linalg.solve(root, found.spread[np.ix_(shared, shared)])
    spread = 60 * np.linalg.solve(root, half.T)
    assert np.all((np.diag(spread) > 0.3) & (np.diag(spread) < 2.5))


def test_it_is_not_on_a_seat_at_its_limit_with_loud_senses() -> None:
    """At the truth, in deviations of three trials: more than one, and fresh draws say the same."""
    who = subject("seat", 1, "sensory", 70.0, 9.0)
    own, law = recorded(who, 1).problem, who.controller
    point = Point(np.array(law.K), np.array(law.S), own.at(own.starts, own.logarithms))
    space = PersonCoordinates(gain_space(point, None), who.person, np.array(who.recorder))
    prior = prior_about(space, Asked(who.person, None, (), 1.0, 0))
    gain, whitened = space.gain, []
    for seed in (0, 1):
        found = simulated_score(prior, np.array(space.start), seed, 20)
        root = np.linalg.cholesky(20 * found.spread[:gain, :gain])
        whitened.append(np.linalg.solve(root, found.mean[:gain]))
    # Without bias 20 w'w is Hotelling's T^2; the inner product of two draws has no mean then.
    assert whitened[0] @ whitened[1] > 1.0


def test_the_same_seed_says_the_same(free: PersonFit) -> None:
    theta = np.array(free.theta)
    one, two, other = (simulated_score(free.prior, theta, seed, 5) for seed in (0, 0, 1))
    np.testing.assert_array_equal(one.mean, two.mean)
    assert np.all(one.mean != other.mean)


def test_what_never_moved_is_not_left_behind() -> None:
    trial = Recording(cart(), np.array([[0.0], [0.0]]), np.zeros((2, 1)))
    moving = replace(trial, outputs=np.array([[0.2], [-0.3]]))
    assert left_behind((trial,)) == np.inf
    assert left_behind((trial, moving)) == pytest.approx(3.0)


def test_who_runs_away_in_every_trial_has_none() -> None:
    """Recordings that hardly move, and noise that is a thousand times theirs."""
    fit = fitted(50.0)
    loud = np.array(fit.theta)
    loud[fit.space.own :] += 10.0
    with pytest.raises(SolverError, match="runs away in every simulated trial"):
        simulated_score(fit.prior, loud, 0, 5)
