"""Doubts of a fit with sensory noise, in Python: none of a true model, some of a wrong one."""

from __future__ import annotations

import functools

import numpy as np
import pytest

from impc.checking import replace
from impc.inverse.methods import fit
from impc.inverse.problem import Problem
from impc.model.recordings import Recording
from impc.output_feedback.doubts import driven
from impc.output_feedback.fit import OutputFeedbackFit, fit_output_feedback
from impc.output_feedback.intervals import person_covariance
from impc.output_feedback.observer import Observer
from tests.output_feedback.fits import cart, fitted, law

pytestmark = pytest.mark.full


@functools.cache
def machine(late: int) -> OutputFeedbackFit:
    """Fit, without delay, of a machine that acts on the states of `late` samples ago."""
    plant, K, trials = cart(), law(np.inf).K, []
    for seed in range(2):
        rng = np.random.default_rng(seed)
        push, states = np.repeat(rng.choice([-0.7, 0.0, 0.7], 40), 10), [np.zeros(2)]
        for t in range(len(push) - 1):
            u = -K @ states[max(t - late, 0)] + 0.15 * rng.standard_normal(1)
            states.append(plant.A @ states[-1] + plant.B @ u + plant.E @ push[t : t + 1])
        y = np.array(states)[:, :1] + 0.01 * rng.standard_normal((len(push), 1))
        trials.append(Recording(plant, y, push))
    problem = Problem(plant, law(np.inf).bounds, 5, trials, terminal_set=False, unknown_start=True)
    return fit_output_feedback(fit(problem), Observer(plant, ["x"], motor=0.15, sensory=0.02))


def deviations(found: OutputFeedbackFit) -> float:
    """Largest error of a gain entry in standard errors."""
    apart = np.abs(np.array(found.K) - law(np.inf).K) / person_covariance(found).entries
    return float(np.max(apart))


def test_a_true_model_has_no_doubts() -> None:
    for found in (machine(0), fitted("free")):
        assert found.converged
        assert deviations(found) < 3
        assert found.doubts == ()
        assert str(found).startswith("output feedback: K = [[")


def test_a_recording_that_is_not_of_the_model_is_doubted() -> None:
    """A delay of 0.4 s: narrow intervals, white errors, and another gain."""
    found = machine(8)
    assert found.converged
    assert deviations(found) > 10
    assert np.all(found.whiteness > 0.01)
    (doubt,) = found.doubts
    assert doubt.startswith("Prediction errors of x follow the perturbation: the model is incompl")
    assert doubt in str(found)


def test_errors_of_a_machine_without_perturbation_follow_none() -> None:
    found = machine(0)
    still = [replace(one, disturbance=0 * one.disturbance) for one in found.problem.recordings]
    quiet = replace(found, problem=replace(found.problem, recordings=tuple(still)))
    assert driven(quiet) == pytest.approx([1.0])


def test_scores_that_vary_more_than_the_model_says_are_doubted() -> None:
    """Scores of three times the size: standard errors by the sandwich are three times as large."""
    found = machine(0)
    wild = [3 * one for one in found.identified.scores]
    said = replace(found, identified=replace(found.identified, scores=wild)).doubts
    assert any("Standard errors that allow for a wrong model are up to" in one for one in said)
