"""Covariances of output-feedback fits: two kinds, and against repeated simulations."""

from __future__ import annotations

import numpy as np
import pytest

from experiments.noisy_people import recorded, subject
from experiments.noisy_people_score import blind
from impc.errors import InputError
from impc.inverse.methods import fit
from impc.output_feedback.covariance import confusion, person_covariance
from impc.output_feedback.fit import OutputFeedbackFit, fit_output_feedback
from impc.output_feedback.observer import Observer
from tests.output_feedback.test_fit import cart, posed

pytestmark = pytest.mark.full


@pytest.fixture(scope="module")
def fitted() -> OutputFeedbackFit:
    person = Observer(cart(), ["x"], motor=0.4, sensory=0.05)
    return fit_output_feedback(fit(posed(person, 0.01, 3.0, trials=4)), person)


def test_both_agree_where_the_model_is_true(fitted: OutputFeedbackFit) -> None:
    expected, sandwich = (person_covariance(fitted, kind) for kind in ("expected", "sandwich"))
    # 1600 samples: a standard error is itself known to 10 or 20 %.
    np.testing.assert_allclose(sandwich.entries, expected.entries, rtol=0.4)
    np.testing.assert_allclose(sandwich.levels, expected.levels, rtol=0.4)


def test_the_step_that_is_least_told_apart(fitted: OutputFeedbackFit) -> None:
    """Moved along it together, gain and noise SDs cost less likelihood than each alone."""
    found = confusion(fitted)
    assert 0 < found.correlation < 1
    covariance = np.array(person_covariance(fitted, "expected").covariance)
    assert found.gain.shape == (1, 2)
    assert found.levels.shape == (3,)
    direction = np.array(found.levels) / np.linalg.norm(found.levels)
    levels = slice(fitted.space.own, None)
    inside = direction @ np.linalg.inv(np.linalg.inv(covariance)[levels, levels]) @ direction
    assert inside <= direction @ covariance[levels, levels] @ direction


def test_an_unknown_kind_is_refused(fitted: OutputFeedbackFit) -> None:
    with pytest.raises(InputError, match="expected, sandwich"):
        person_covariance(fitted, "robust")


def test_a_direction_that_nothing_tells_leaves_the_others_as_they_are() -> None:
    """Two inputs without limit: the metric of the inputs affects neither command nor likelihood.

    Regression: four of seven directions had no sandwich standard error.
    """
    who = subject("pair", 0, "motor", 90.0, 5.0)
    found = fit_output_feedback(fit(recorded(who, 0).problem), blind(who))
    assert np.linalg.eigvalsh(found.identified.information)[0] < 1e-8
    robust, expected = person_covariance(found), person_covariance(found, "expected")
    assert np.linalg.eigvalsh(robust.covariance)[0] > 0
    np.testing.assert_allclose(robust.deviations, expected.deviations, rtol=0.3)
    np.testing.assert_allclose(robust.entries, expected.entries, rtol=0.3)
    off = (np.array(found.K) - np.array(who.controller.K)) / robust.entries
    assert np.all(np.abs(off) < 3)
