"""Test of the model on carts with known errors; columns against finite differences."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import pytest

import impc
from experiments.residual_study import diagnosed
from experiments.uncertain_body import Person, cart, cart_person
from impc.arrays import Array
from impc.assess import lack_of_fit as module
from impc.assess.lack_of_fit import DELAY, LEAN, LIMIT, OFFSET, PUSH, LackOfFit, lack_of_fit
from impc.assess.printed_gain import gain_estimate
from impc.inverse import further_unknowns
from impc.inverse.residuals import evaluate, residual_only
from impc.studies.fit.subject import fit_recordings
from tests.support import differences, posed, regulator


@functools.cache
def person_of(seed: int, error: str = "none", root: float = 0.0) -> Person:
    found = cart_person(seed, 99, root, error)
    assert found is not None
    return found


@functools.cache
def result_of(seed: int, error: str, root: float = 0.0) -> LackOfFit:
    found = lack_of_fit(gain_estimate(impc.fit(person_of(seed, error, root).problem)))
    assert found is not None
    return found


@functools.cache
def problem_and_gain() -> tuple[impc.Problem, Array, Array]:
    """Cart at its limit for part of the time, at its true gain."""
    problem, K, _ = person_of(1)
    return problem.with_body_fixed(), K, np.eye(1)


@functools.cache
def columns() -> dict[str, Array]:
    return {name: found[:, 0] for name, found in module._columns(*problem_and_gain())}


# The body is drawn from its stated uncertainty.
@pytest.mark.parametrize(("seed", "root"), [(0, 0.0), (1, 0.0), (0, 0.9), (1, 0.9)])
def test_noise_of_the_recorder_gives_no_alarm(seed: int, root: float) -> None:
    assert not result_of(seed, "none", root).alarm


@pytest.mark.parametrize(
    ("error", "names", "size"),
    # Seed 1: one sample of delay, 5 % of the limit; a lean is an error of a constant.
    [("delay", (DELAY,), 1.0), ("limit", (LIMIT,), np.log(1.05)), ("lean", (LEAN, OFFSET), None)],
)
def test_an_error_is_named_with_its_size(
    error: str, names: tuple[str, ...], size: float | None
) -> None:
    found = result_of(1, error).culprit
    assert found is not None
    assert found.name in names
    if size is not None:
        assert abs(found.size - size) < 4 * found.deviation
        assert found.deviation < 0.2 * size


def test_the_column_of_a_delay_is_a_derivative() -> None:
    """Plant with a fractional command delay, at zero delay and zero gain on the last command."""
    problem, K, S = problem_and_gain()
    wider = further_unknowns.with_delay_unknown(problem)
    assert wider is not None
    expected = evaluate(wider, np.hstack([K, np.zeros((1, 1))]), S).dparameters[:, 0]
    # The planned commands include the delay, the forcing does not: columns differ at the limit.
    assert np.linalg.norm(columns()[DELAY] - expected) < 0.05 * np.linalg.norm(expected)


@pytest.mark.parametrize(
    ("name", "wider"),
    [(LIMIT, further_unknowns.with_limit_unknown), (PUSH, further_unknowns.with_strength_unknown)],
)
def test_columns_are_derivatives(name: str, wider: Any) -> None:
    problem, K, S = problem_and_gain()
    expected = evaluate(wider(problem), K, S).dparameters[:, 0]
    np.testing.assert_allclose(columns()[name], expected, atol=1e-6 * np.max(np.abs(expected)))


def test_the_column_of_a_lean_is_a_difference() -> None:
    """Constant push in the first trial."""
    problem, K, S = problem_and_gain()
    first = problem.recordings[0]

    def leaning(push: Array) -> Array:
        moved = impc.replace(first, disturbance=np.array(first.disturbance) + push)
        return residual_only(impc.replace(problem, recordings=(moved,)), K, S)

    (expected,) = differences(leaning, [0.0], 1e-5).T
    found = columns()[LEAN][: len(expected)]
    np.testing.assert_allclose(found, expected, atol=1e-3 * np.max(np.abs(expected)))


def test_what_is_named_is_fitted_too() -> None:
    """One sample of delay, seed 1: the second fit includes it and covers the gain."""
    problem, truth, _ = person_of(1, "delay")
    settings = impc.FitSettings(
        horizon=10, u_max=0.55, held_out=False, intent_draws=False, methods=[]
    )
    result = fit_recordings(problem, settings)
    first, last = result.lack
    assert first is not None
    assert last is not None
    assert (first.alarm, last.alarm) == (True, False)
    (delay,) = (item for item in result.parameters if item.name == "extra_delay")
    assert abs(delay.value - 0.05) < 3 * delay.deviation
    for item, value in zip(result.gain_intervals[:2], truth[0], strict=True):
        assert item.low <= value <= item.high


def test_offsets_are_no_error_where_they_are_fitted() -> None:
    problem, K, S = problem_and_gain()
    wider = further_unknowns.with_offsets_unknown(problem)
    assert wider is not None
    assert OFFSET not in dict(module._columns(wider, K, S))


def test_an_exact_fit_is_not_tested() -> None:
    law, push = regulator(cart(), np.diag([4.0, 1.0]), 1, 10), 0.2 * np.sin(np.arange(200) / 7)
    trial = impc.Recording(law.plant, law.simulate([0, 0], disturbance=push).x[:-1, :1], push)
    assert lack_of_fit(gain_estimate(impc.fit(posed(law, trial)))) is None


def test_ten_trials_without_gaps_are_tested() -> None:
    problem = problem_and_gain()[0]
    trial = problem.recordings[0]
    many = impc.replace(problem, recordings=problem.recordings * 20)
    assert len(module._some_trials(many).recordings) == 10
    outputs = np.array(trial.outputs)
    outputs[50:60] = np.nan
    gapped = impc.replace(problem, recordings=(impc.replace(trial, outputs=outputs), trial))
    assert module._some_trials(gapped).recordings == (trial,)


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
