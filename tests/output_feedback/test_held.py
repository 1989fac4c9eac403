"""Profile points: the fixed coordinate stays, and all others are optimal."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.optimize

from impc.inverse.methods import fit
from impc.output_feedback.fit import OutputFeedbackFit, fit_output_feedback
from impc.output_feedback.observer import Observer
from impc.output_feedback.profile import held_person
from tests.output_feedback.test_fit import cart, posed

pytestmark = pytest.mark.full


@pytest.fixture(scope="module")
def fitted() -> OutputFeedbackFit:
    person = Observer(cart(), ["x"], motor=0.4, sensory=0.05)
    return fit_output_feedback(fit(posed(person, 0.01, 3.0)), person)


def test_all_else_is_at_its_best(fitted: OutputFeedbackFit) -> None:
    """Against a search without derivatives, along a combination of gain and motor noise."""
    prior, unseen = fitted.prior, np.array(fitted.unseen)
    here, along = (
        prior.placed(np.array(fitted.theta), fitted.identified),
        np.zeros(len(fitted.theta)),
    )
    along[[0, 1, fitted.space.own]] = np.array([2.0, -1.0, 2.0]) / 3
    found = held_person(prior, here, along, 0.1, unseen, 60)
    assert found is not None
    place, _ = found
    assert along @ (place.theta - here.theta) == pytest.approx(0.1, abs=1e-12)
    across = scipy.linalg.null_space(along[None])
    information = across.T @ (here.identified.information + 0.1 * np.eye(len(along))) @ across
    scale = np.linalg.inv(np.linalg.cholesky(information)).T

    def lower(steps: np.ndarray[tuple[int], np.dtype[np.float64]]) -> float:
        there = prior.tried(here.theta + 0.1 * along + across @ scale @ steps)
        return 1e3 if there is None else here.value - there.value

    best = scipy.optimize.minimize(
        lower, np.zeros(len(along) - 1), method="Powell", options={"xtol": 1e-3, "ftol": 1e-7}
    )
    assert here.value - place.value == pytest.approx(best.fun, abs=0.02)


def test_where_there_is_nobody_there_is_none(fitted: OutputFeedbackFit) -> None:
    """A noise SD whose square overflows."""
    prior, here = fitted.prior, fitted.prior.placed(np.array(fitted.theta), fitted.identified)
    level = np.eye(len(fitted.theta))[fitted.space.own]
    assert held_person(prior, here, level, 1e3, np.array(fitted.unseen), 10) is None
