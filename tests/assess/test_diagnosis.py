"""Mistakes in the meaning of a signal are named, and the corrected fit is right."""

from __future__ import annotations

import numpy as np
import pytest

import impc
from experiments.benchmarks.workloads import seat
from experiments.simulated_subjects import noisy_recordings
from impc.arrays import Array, frozen
from impc.assess.diagnosis import Diagnosis, diagnosed
from impc.assess.lack_of_fit import lack_of_fit
from impc.assess.printed_gain import gain_estimate
from impc.inverse.refit import refit
from impc.studies.fit.first import FitProgress, first_fits
from tests.inverse.test_signal_errors import controller, recorded

UNIT = np.eye(2)


@pytest.fixture(scope="module")
def right() -> tuple[impc.Problem, Array]:
    law = controller()
    problem, _ = recorded(law, {}, 0.003)
    return problem, np.array(law.K)


def cause_of(problem: impc.Problem) -> Diagnosis | None:
    """Cause of an alarm in a fit."""
    fitted = impc.fit(problem)
    end = refit(fitted.problem, fitted.gain, fitted.metric)
    return diagnosed(problem, end, lack_of_fit(gain_estimate(fitted)))


@pytest.mark.parametrize(
    ("name", "outputs", "push"),
    [
        ("sign.rate", np.diag([1.0, -1.0]), 1.0),
        ("sign.push", UNIT, -1.0),
        ("exchanged.angle", UNIT[::-1], 1.0),
        ("sum.rate", UNIT + np.outer(UNIT[1], UNIT[0]), 1.0),
        ("difference.angle", UNIT - np.outer(UNIT[0], UNIT[1]), 1.0),
    ],
)
def test_a_mistake_is_named_and_mended(
    right: tuple[impc.Problem, Array], name: str, outputs: Array, push: float
) -> None:
    problem, truth = right
    (trial,) = problem.recordings
    wrong = impc.replace(
        trial,
        outputs=frozen(trial.outputs @ outputs.T),
        disturbance=frozen(push * trial.disturbance),
    )
    posed = impc.replace(problem, recordings=(wrong,))
    cause = cause_of(posed)
    assert cause is not None
    assert cause.found.errors[0].name == name
    assert cause.problem is not None
    estimate = gain_estimate(impc.fit(cause.problem))
    away = (np.array(estimate.K) - truth) / np.array(estimate.covariance.entries)
    assert np.all(np.abs(away) < 3)
    last = lack_of_fit(estimate)
    assert last is not None
    assert not last.alarm


def test_a_right_recording_has_no_cause(right: tuple[impc.Problem, Array]) -> None:
    assert cause_of(right[0]) is None


@pytest.mark.full
def test_a_wrong_scale_far_from_a_minimum_is_named() -> None:
    """The first search is stuck with 10000 promised; what goes on from there names the scale."""
    recordings = noisy_recordings(6.0, 1, 0.99, seconds=15.0)
    trials = tuple(
        impc.replace(trial, disturbance=trial.disturbance / 1.15) for trial in recordings
    )
    problem = impc.replace(seat().problem, recordings=trials, unknown_start=True)
    posed, _, _, _, (first, last) = first_fits(problem, FitProgress())
    assert posed.signal_errors == (("scale", "perturbation"),)
    assert first is not None
    assert first.errors[0].name == "scale.perturbation"
    assert last is not None
    assert not last.alarm
