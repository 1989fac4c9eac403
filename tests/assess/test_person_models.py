"""Models side by side: which there are, and predictions against those of the plant alone."""

from __future__ import annotations

import numpy as np
import pytest

from impc.assess.person_models import person_report, prediction_errors
from impc.inverse.likelihood_fit import PersonFit, fit_person
from impc.inverse.methods import estimate
from impc.model.observer import Observer
from tests.inverse.test_likelihood_fit import cart, posed


@pytest.fixture(scope="module")
def fitted() -> PersonFit:
    person = Observer(cart(), ["x"], motor=0.15, sensory=0.02)
    return fit_person(estimate(posed(person, 0.01, 3.0)), person)


def test_errors_ahead_are_those_that_the_filter_expects(fitted: PersonFit) -> None:
    """One sample ahead they are the innovations; far ahead they grow to the noise in the loop."""
    ahead = (1, 5, 20)
    errors = prediction_errors(fitted, ahead)
    told = np.concatenate([trial.innovations for trial in fitted.told.trials])
    # A hundred starts in each of two trials: 5 % of a deviation, twice.
    np.testing.assert_allclose(errors[0], np.sqrt(np.mean(told**2, axis=0)), rtol=0.12)
    assert errors[0] < errors[1] < errors[2]


def test_without_limit_and_perturbation_there_are_three_models() -> None:
    person = Observer(cart(), ["x"], motor=0.15, sensory=0.02)
    found = estimate(posed(person, 0.01, np.inf, trials=1))
    report = person_report(found, person, np.zeros(0))
    assert [item.name for item in report.models] == [
        "estimates, perturbation known",
        "sees every state, noise in the loop",
        "sees every state, noise in the recorder alone",
    ]
    # The recorder alone is a special case of noise in the loop, where the motor has none.
    fits = [item.fit for item in report.models]
    assert fits[1] is not None
    assert fits[2] is not None
    assert fits[1].log_likelihood > fits[2].log_likelihood
    assert fits[1].count == fits[2].count + 1


def test_who_cannot_estimate_has_a_reason() -> None:
    asked = Observer(cart(), ["v"], motor=0.15, sensory=0.02)
    found = estimate(posed(Observer(cart()), 0.01, np.inf, trials=1))
    report = person_report(found, asked, np.zeros(0))
    assert report.models[0].fit is None
    assert "no stationary gain" in report.models[0].reason
    assert report.covariance is None
