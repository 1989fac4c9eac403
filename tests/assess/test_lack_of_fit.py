"""Test of the model on carts with known errors; columns against finite differences."""

from __future__ import annotations

import functools

import numpy as np
import pytest

import impc
from experiments.residual_study import diagnosed
from experiments.uncertain_body import cart, cart_person
from impc.arrays import Array, frozen
from impc.assess import diagnosis
from impc.assess import lack_of_fit as module
from impc.assess.lack_of_fit import DELAY, LEAN, LIMIT, LackOfFit, lack_of_fit
from impc.assess.printed_gain import gain_estimate
from impc.checking import replace
from impc.inverse.further_unknowns import (
    with_delay_unknown,
    with_errors_unknown,
    with_limit_unknown,
)
from impc.inverse.laws import GainLaw
from impc.inverse.problem import Problem
from impc.inverse.refit import refit
from impc.inverse.residuals import residual_only
from impc.inverse.unknowns import Unknowns
from impc.studies.fit.settings import FitSettings
from impc.studies.fit.subject import fit_recordings
from tests.support import slopes


@functools.cache
def result_of(seed: int, error: str, root: float = 0.0) -> LackOfFit:
    person = cart_person(seed, 99, root, error)
    assert person is not None
    found = lack_of_fit(gain_estimate(impc.fit(person[0])))
    assert found is not None
    return found


def problem_and_gain() -> tuple[Problem, Array, Array]:
    """Cart at its limit for part of the time, at its true gain."""
    person = cart_person(1, 99, 0.0)
    assert person is not None
    problem, K, _ = person
    return problem.with_body_fixed(), K, np.eye(1)


def column(name: str) -> Array:
    problem, K, S = problem_and_gain()
    return module._columns(problem, K, S)[name]


@pytest.mark.parametrize(("seed", "root"), [(0, 0.0), (1, 0.0), (0, 0.9), (1, 0.9)])
def test_noise_of_the_recorder_gives_no_alarm(seed: int, root: float) -> None:
    """Body drawn from its stated uncertainty."""
    assert not result_of(seed, "none", root).alarm


@pytest.mark.parametrize(
    ("error", "name", "size"), [("delay", DELAY, 1.0), ("limit", LIMIT, np.log(1.05))]
)
def test_an_error_is_named_with_its_size(error: str, name: str, size: float) -> None:
    """Seed 1: one sample of delay, 5 % of the limit."""
    found = result_of(1, error).culprit
    assert found is not None
    assert found.name == name
    assert abs(found.size - size) < 4 * found.deviation
    assert found.deviation < 0.2 * size


def test_a_lean_is_an_error_of_a_constant() -> None:
    found = result_of(1, "lean").culprit
    assert found is not None
    assert found.name == LEAN or found.name.startswith("offset.")


def test_the_column_of_a_delay_is_a_derivative() -> None:
    """Plant with a fractional command delay, at zero delay and zero gain on the last command."""
    problem, K, S = problem_and_gain()
    wider = with_delay_unknown(problem)
    assert wider is not None
    K = np.hstack([K, np.zeros((1, 1))])
    expected = slopes(wider, K, S)[2][:, 0]
    # The planned commands include the delay, the forcing does not: columns differ at the limit.
    error = np.linalg.norm(column(DELAY)[:, 0] - expected) / np.linalg.norm(expected)
    assert error < 0.05


def test_the_column_of_a_limit_is_a_derivative() -> None:
    problem, K, S = problem_and_gain()
    wider = with_limit_unknown(problem)
    assert wider is not None
    expected = slopes(wider, K, S)[2][:, 0]
    np.testing.assert_allclose(column(LIMIT)[:, 0], expected, atol=1e-6 * np.max(np.abs(expected)))


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
    """The signal, and the size of what is the same in all trials; the second fit has no alarm."""
    person = cart_person(1, 99, 0.0)
    assert person is not None
    problem, truth, _ = person
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
        trials.append(replace(trial, outputs=frozen(y), disturbance=frozen(d)))
    wrong = replace(problem, recordings=tuple(trials))
    fitted = gain_estimate(impc.fit(wrong))
    at = refit(fitted.problem, np.array(fitted.K), np.array(fitted.S))
    cause = diagnosis.diagnosed(wrong, at, lack_of_fit(fitted))
    assert cause is not None
    assert cause.found.culprit is not None
    assert cause.found.culprit.name == name
    if kind != "drift":  # a group of one column for each trial has no size
        assert cause.found.culprit.size == pytest.approx(size, rel=0.2)
    again = cause.problem
    assert again is not None
    estimate = gain_estimate(impc.fit(again))
    last = lack_of_fit(estimate)
    assert last is not None
    assert not last.alarm
    away = (np.ravel(estimate.K) - np.ravel(truth)) / np.ravel(estimate.covariance.entries)
    assert np.max(np.abs(away)) < 3


def test_the_column_of_a_lean_is_a_difference() -> None:
    """Constant push in the first trial."""
    problem, K, S = problem_and_gain()
    first, step, ends = problem.recordings[0], 1e-5, []
    for push in (step, -step):
        moved = replace(first, disturbance=np.array(first.disturbance) + push)
        ends.append(residual_only(replace(problem, recordings=(moved,)), K, S))
    expected = (ends[0] - ends[1]) / (2 * step)
    found = column(LEAN)[: len(expected), 0]
    np.testing.assert_allclose(found, expected, atol=1e-3 * np.max(np.abs(expected)))


def test_what_is_named_is_fitted_too() -> None:
    """One sample of delay, seed 1: the second fit includes it and covers the gain."""
    person = cart_person(1, 99, 0.0, "delay")
    assert person is not None
    problem, truth, _ = person
    settings = FitSettings(horizon=10, u_max=0.55, held_out=False, intent_draws=False, methods=[])
    result = fit_recordings(problem, settings)
    first, last = result.lack
    assert first is not None
    assert last is not None
    assert first.alarm
    assert not last.alarm
    (delay,) = (item for item in result.parameters if item.name == "extra_delay")
    assert abs(delay.value - 0.05) < 3 * delay.deviation
    ends = [(item.low, item.high) for item in result.gain_intervals[:2]]
    assert all(low <= value <= high for (low, high), value in zip(ends, truth[0], strict=True))


def test_what_is_fitted_or_absent_is_not_tested() -> None:
    problem, K, S = problem_and_gain()
    offset = ("offset", problem.plant.outputs[0])
    with_offset, unlimited = with_errors_unknown(problem, [offset]), problem.without_bounds()
    for name, one, tested in (
        (".".join(offset), problem, True),
        (".".join(offset), with_offset, False),
        (LIMIT, problem, True),
        (LIMIT, unlimited, False),
    ):
        space = Unknowns(one, GainLaw(one, K, S))
        found = lack_of_fit(space.ended(space.start))
        assert found is not None
        assert (name in [*found.untestable, *(item.name for item in found.errors)]) == tested


def test_too_little_is_not_tested() -> None:
    """Exact fit, and a plant whose delay is already modelled."""
    plant = cart()
    law = impc.Controller(
        plant, impc.Weights(np.diag([4.0, 1.0]), 1), impc.Bounds(plant, u_min=-1, u_max=1), 10,
        terminal_set=False,
    )  # fmt: skip
    push = 0.2 * np.sin(np.arange(200) / 7)
    trial = impc.Recording(plant, law.simulate([0, 0], disturbance=push).x[:-1, :1], push)
    problem = Problem(plant, impc.Bounds(plant, u_min=-1, u_max=1), 10, [trial])
    assert lack_of_fit(gain_estimate(impc.fit(problem))) is None


def test_of_many_trials_some_are_tested() -> None:
    problem, *_ = problem_and_gain()
    many = replace(problem, recordings=problem.recordings * 20)
    assert len(module._some_trials(many).recordings) == 10


def test_trials_with_gaps_are_left_out_of_the_test() -> None:
    problem = problem_and_gain()[0]
    trial = problem.recordings[0]
    outputs = np.array(trial.outputs)
    outputs[50:60] = np.nan
    gapped = replace(trial, outputs=outputs)
    assert module._some_trials(replace(problem, recordings=(gapped, trial))).recordings == (trial,)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "alarms"),
    [("recorder", (0, 2)), ("coloured", (0, 2)), ("default", (9, 10)), ("motor", (9, 10))],
)
def test_ten_subjects_on_the_seat(name: str, alarms: tuple[int, int]) -> None:
    """Recording noise, nonlinear body, and motor noise at the limit: seeds 0 to 9."""
    found = [diagnosed(seed, name, order=1, horizon=4) for seed in range(10)]
    count = sum(item is not None and item.alarm for item in found)
    assert alarms[0] <= count <= alarms[1]
