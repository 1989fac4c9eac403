"""Competing sensorimotor models, stored when interrupted, and predictions of the filter."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from impc.inverse.methods import fit
from impc.model.structure import Structure
from impc.output_feedback.intervals import person_covariance
from impc.output_feedback.models import PersonModel, person_report, prediction_errors
from impc.output_feedback.observer import Observer
from impc.studies.fit.memory import open_memory
from impc.studies.fit.settings import FitSettings
from tests.inverse.test_regulator_span import late_body, late_problem
from tests.output_feedback.fits import cart, fitted, least_squares, posed
from tests.output_feedback.test_fit import check_stored

pytestmark = pytest.mark.full


def test_errors_ahead_are_those_that_the_filter_expects() -> None:
    """One sample ahead they are the innovations; far ahead they grow to the noise in the loop."""
    fit = fitted("vague")
    errors = prediction_errors(fit, (1, 5, 20))
    identified = np.concatenate([trial.innovations for trial in fit.identified.trials])
    # A hundred starts in each of two trials: 5 % of a deviation, twice.
    np.testing.assert_allclose(errors[0], np.sqrt(np.mean(identified**2, axis=0)), rtol=0.12)
    assert errors[0] < errors[1] < errors[2]


def test_without_limit_and_perturbation_there_are_three_models() -> None:
    person = Observer(cart(), ["x"], motor=0.15, sensory=0.02)
    report = person_report(fit(posed(person, 0.01, np.inf, 1)), person, np.zeros(0))
    assert [item.name for item in report.models] == [
        "estimates, perturbation known",
        "sees every state, noise in the loop",
        "sees every state, noise in the recorder alone",
    ]
    # Recording noise alone is the special case of noise in the loop without motor noise.
    _, loop, quiet = (item.fit for item in report.models)
    assert loop is not None
    assert quiet is not None
    assert loop.log_likelihood > quiet.log_likelihood
    assert loop.count == quiet.count + 1


def test_who_cannot_estimate_has_a_reason() -> None:
    asked = Observer(cart(), ["v"], motor=0.15, sensory=0.02)
    report = person_report(fit(posed(Observer(cart()), 0.01, np.inf, 1)), asked, np.zeros(0))
    assert report.models[0].fit is None
    assert "no stationary Kalman filter" in report.models[0].reason
    assert report.covariance is None
    assert report.models[0].reason in report.sentences()[0]
    assert report.data().keys() == {"models"}


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
    check_stored(kept)


def test_persons_of_an_interrupted_fit_are_not_fitted_again(tmp_path: Path) -> None:
    """`test_subject.py` has checkpoints of the other parts of a fit."""
    person, found = least_squares("limited")
    settings = FitSettings(horizon=5, u_max=0.9)
    stopped, computed = "sees every state, noise in the loop", []

    def interrupt(name: str) -> None:
        if name == stopped:
            raise KeyboardInterrupt

    whole = person_report(found, person, np.zeros(0))
    memory = open_memory(tmp_path, found.problem, settings)
    with pytest.raises(KeyboardInterrupt):
        person_report(found, person, np.zeros(0), done=interrupt, remember=memory.part)
    again = open_memory(tmp_path, found.problem, settings)

    def counted(name: str, compute: Any, encode: Any, decode: Any) -> PersonModel:
        def counting() -> PersonModel:
            computed.append(name)
            model: PersonModel = compute()
            return model

        model: PersonModel = again.part(name, counting, encode, decode)
        return model

    report = person_report(found, person, np.zeros(0), remember=counted)
    names = [model.name for model in whole.models]
    assert computed == names[names.index(stopped) + 1 :] != []
    np.testing.assert_array_equal(report.entries, whole.entries)
    np.testing.assert_array_equal(report.levels, whole.levels)
    assert [one.criterion for one in report.models] == [one.criterion for one in whole.models]
