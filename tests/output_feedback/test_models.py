"""Competing sensorimotor models, and predictions against those of the plant alone."""

from __future__ import annotations

import numpy as np
import pytest

from impc.inverse.methods import fit
from impc.model.structure import Structure
from impc.output_feedback.covariance import person_covariance
from impc.output_feedback.fit import OutputFeedbackFit, fit_output_feedback
from impc.output_feedback.models import person_report, prediction_errors
from impc.output_feedback.observer import Observer
from tests.inverse.test_regulator_span import late_body, late_problem
from tests.output_feedback.test_fit import cart, posed

pytestmark = pytest.mark.full


@pytest.fixture(scope="module")
def fitted() -> OutputFeedbackFit:
    person = Observer(cart(), ["x"], motor=0.15, sensory=0.02)
    return fit_output_feedback(fit(posed(person, 0.01, 3.0)), person)


def test_errors_ahead_are_those_that_the_filter_expects(fitted: OutputFeedbackFit) -> None:
    """One sample ahead they are the innovations; far ahead they grow to the noise in the loop."""
    ahead = (1, 5, 20)
    errors = prediction_errors(fitted, ahead)
    identified = np.concatenate([trial.innovations for trial in fitted.identified.trials])
    # A hundred starts in each of two trials: 5 % of a deviation, twice.
    np.testing.assert_allclose(errors[0], np.sqrt(np.mean(identified**2, axis=0)), rtol=0.12)
    assert errors[0] < errors[1] < errors[2]


def test_without_limit_and_perturbation_there_are_three_models() -> None:
    person = Observer(cart(), ["x"], motor=0.15, sensory=0.02)
    found = fit(posed(person, 0.01, np.inf, trials=1))
    report = person_report(found, person, np.zeros(0))
    assert [item.name for item in report.models] == [
        "estimates, perturbation known",
        "sees every state, noise in the loop",
        "sees every state, noise in the recorder alone",
    ]
    # Recording noise alone is the special case of noise in the loop without motor noise.
    fits = [item.fit for item in report.models]
    assert fits[1] is not None
    assert fits[2] is not None
    assert fits[1].log_likelihood > fits[2].log_likelihood
    assert fits[1].count == fits[2].count + 1


def test_who_cannot_estimate_has_a_reason() -> None:
    asked = Observer(cart(), ["v"], motor=0.15, sensory=0.02)
    found = fit(posed(Observer(cart()), 0.01, np.inf, trials=1))
    report = person_report(found, asked, np.zeros(0))
    assert report.models[0].fit is None
    assert "no stationary Kalman filter" in report.models[0].reason
    assert report.covariance is None


def test_a_structure_is_set_beside_any_gain() -> None:
    """Behind a delay: the same recordings, with fewer unknowns and hardly less likelihood."""
    problem = late_problem(structure=Structure(late_body(), ["p", "v"]))
    person = Observer(problem.plant, ["p", "v"], motor=0.1, sensory=[0.02, 0.02])
    report = person_report(fit(problem), person, np.zeros(0))
    found = {item.name: item.fit for item in report.models}
    kept, free = report.fit, found["estimates, perturbation known, any gain"]
    assert kept is not None
    assert free is not None
    assert free.count == kept.count + 3
    # Twice their difference is chi-squared of three, .5 for what is not the largest to the end.
    assert -0.5 < free.log_likelihood - kept.log_likelihood < 6
    assert report.covariance is not None
    assert np.all(report.covariance.entries < person_covariance(free).entries)
