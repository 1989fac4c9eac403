"""Mistakes in the meaning of a signal are named, and the corrected fit is right."""

from __future__ import annotations

import numpy as np
import pytest

import impc
from experiments.benchmarks.workloads import seat
from experiments.simulated_subjects import noisy_recordings
from experiments.verdicts import KINDS
from impc.arrays import Array, frozen
from impc.assess.diagnosis import Diagnosis, diagnosed
from impc.assess.lack_of_fit import LackOfFit, lack_of_fit
from impc.assess.printed_gain import gain_estimate
from impc.inverse.refit import refit
from impc.studies.fit.first import FitProgress, first_fits
from impc.studies.fit.verdict import RULES
from tests.assess.cart_fits import uncertain_cart
from tests.inverse.test_signal_errors import controller, recorded
from tests.support import present

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


def mended(wrong: impc.Problem, truth: Array) -> LackOfFit:
    """The first test; the fit after the correction has no alarm, and the gain is right."""
    cause = present(cause_of(wrong))
    estimate = gain_estimate(impc.fit(present(cause.problem)))
    assert not present(lack_of_fit(estimate)).alarm
    assert np.all(np.abs(estimate.K - truth) < 3 * np.array(estimate.covariance.entries))
    return cause.found


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
def test_a_mistake_in_the_meaning_of_a_signal_is_named_and_mended(
    right: tuple[impc.Problem, Array], name: str, outputs: Array, push: float
) -> None:
    problem, truth = right
    (trial,) = problem.recordings
    wrong = impc.replace(trial, outputs=trial.outputs @ outputs.T,
                         disturbance=push * trial.disturbance)  # fmt: skip
    posed = impc.replace(problem, recordings=(wrong,))
    assert mended(posed, truth).errors[0].name == name


def late(values: Array, samples: float) -> Array:
    """Each column of a signal, recorded so many samples late."""
    count = np.arange(len(values))
    return np.column_stack([np.interp(count - samples, count, one) for one in values.T])


@pytest.mark.parametrize(
    ("name", "size"),
    [
        ("shift.pos", 0.5),
        ("shift.push", -0.7),
        pytest.param("scale.push", 0.15, marks=pytest.mark.full),
        pytest.param("drift.pos", 0.2, marks=pytest.mark.full),
    ],
)
def test_a_wrong_recording_is_named_and_mended(name: str, size: float) -> None:
    """The signal, and the size of what is the same in all trials."""
    problem, truth, _ = uncertain_cart()
    kind, _, signal = name.partition(".")
    trials = []
    for trial in problem.recordings:
        y, d = np.array(trial.outputs), np.array(trial.disturbance)
        if kind == "drift":
            y[:, 0] += np.linspace(0, size * np.max(np.abs(y[:, 0])), len(y))
        elif kind == "scale":
            d = d / (1 + size)
        elif signal == "push":
            d = late(d, -size)
        else:
            y[:, :1] = late(y[:, :1], size)
        trials.append(impc.replace(trial, outputs=frozen(y), disturbance=frozen(d)))
    found = present(mended(impc.replace(problem, recordings=tuple(trials)), truth).culprit)
    assert found.name == name
    if kind != "drift":  # a group of one column for each trial has no size
        assert found.size == pytest.approx(size, rel=0.2)


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
    assert present(first).errors[0].name == "scale.perturbation"
    assert not present(last).alarm


@pytest.mark.full
def test_a_wrong_body_is_not_named_a_limit_that_no_sample_reaches() -> None:
    """A lower limit makes up for most of another stiffness, and its fit passes no test."""
    made, _, words = KINDS["body"]
    assert words in RULES.verdict(made(0).result).headline
