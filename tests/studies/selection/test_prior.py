"""Intervals with a prior on other parameters: coverage, closed form, bounds, truth."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

import impc
from impc.arrays import Array
from impc.assess.long_run_covariance import residual_noise, white_noise
from impc.cli.main import main
from impc.studies.selection.estimation import estimate, estimate_with_prior
from impc.studies.selection.model import Trial, parametric_model
from impc.studies.selection.report import note_of, read_truths
from tests.studies.selection.heads import line_model
from tests.studies.selection.test_methods import MINE, blood_study

RANGE, NOISE, SAMPLES = 10.0, 0.5, 150
DEVIATION = np.array([1.0, 0.8, 0.5])
PEOPLE = line_model(RANGE, deviation=[*DEVIATION])
KNOWN = line_model(RANGE, deviation=[0.0] * 3)


def person(rng: np.random.Generator, root: float = 0.0) -> tuple[Array, Trial]:
    """A random person; correlated inputs, so that fixing b and c biases a."""
    theta = DEVIATION * rng.standard_normal(3)
    u = rng.standard_normal((SAMPLES, 3)) @ np.array([[1, 0.8, 0.7], [0, 0.6, 0], [0, 0, 0.7]])
    noise = np.zeros(SAMPLES)
    for k in range(SAMPLES):
        noise[k] = root * noise[k - 1] + np.sqrt(1 - root**2) * rng.standard_normal()
    return theta, Trial(u, (u @ theta + NOISE * noise)[:, None])


def test_it_is_the_posterior_of_a_linear_model() -> None:
    """Closed form: flat prior of a, normal priors of b and c, residual variance."""
    _, trial = person(np.random.default_rng(1))
    found = estimate_with_prior(PEOPLE, [trial], (0,), np.zeros(3), white_noise)
    left = trial.outputs[:, 0] - trial.input @ found.fit.theta
    s2 = left @ left / (SAMPLES - 3)
    P = np.diag([0, *DEVIATION[1:] ** -2.0])
    H = trial.input.T @ trial.input / s2 + P
    mean = np.linalg.solve(H, trial.input.T @ trial.outputs[:, 0] / s2)
    half = 1.959964 * np.sqrt(np.linalg.inv(H)[0, 0])
    np.testing.assert_allclose(found.fit.theta, mean, atol=0.02 * half)
    np.testing.assert_allclose([found.low[0], found.high[0]], [mean[0] - half, mean[0] + half],
                               atol=0.03 * half)  # fmt: skip


@pytest.mark.parametrize(("root", "noise_of"), [(0.0, white_noise), (0.7, residual_noise)])
def test_intervals_of_people_hold_the_truth(root: float, noise_of: object) -> None:
    """Seed 2, 100 people: coverage 95 % within three standard errors; low if others are fixed."""
    rng = np.random.default_rng(2)
    inside = {True: 0, False: 0}
    for _ in range(100):
        theta, trial = person(rng, root)
        for known, model in ((True, PEOPLE), (False, KNOWN)):
            found = estimate_with_prior(model, [trial], (0,), np.zeros(3), noise_of)  # type: ignore[arg-type]
            inside[known] += bool(found.low[0] <= theta[0] <= found.high[0])
    assert 88 <= inside[True] <= 99
    assert inside[False] < 35


def test_without_deviations_it_is_the_fit_of_the_chosen_parameters() -> None:
    """To 1e-6 of the range, and the interval is that of ordinary least squares."""
    _, trial = person(np.random.default_rng(3))
    found = estimate_with_prior(KNOWN, [trial], (0, 1), np.zeros(3), white_noise)
    assert found.fit.free == (0, 1)
    alone = estimate(KNOWN, [trial], (0, 1), np.zeros(3))
    np.testing.assert_allclose(found.fit.theta, alone.theta, atol=1e-6 * RANGE)
    u = trial.input[:, :2]
    left = trial.outputs[:, 0] - u @ found.value
    expected = np.sqrt(np.diag(np.linalg.inv(u.T @ u)) * (left @ left) / (SAMPLES - 2))
    np.testing.assert_allclose((found.high - found.value) / 1.959964, expected, rtol=0.02)


def test_an_estimate_at_its_bound_has_a_one_sided_interval() -> None:
    """True value 1.5 beyond the bound of 1; the lower end is inside the bounds."""
    rng = np.random.default_rng(4)
    u = rng.standard_normal((SAMPLES, 3))
    trial = Trial(u, (u @ [1.5, 0, 0] + NOISE * rng.standard_normal(SAMPLES))[:, None])
    model = line_model(1.0, deviation=[0.0] * 3)
    found = estimate_with_prior(model, [trial], (0,), np.zeros(3), white_noise)
    assert found.value[0] == pytest.approx(1, abs=1e-6)
    assert found.high[0] == 1
    assert 0.8 < found.low[0] < 0.97


@pytest.mark.parametrize(
    ("value", "low", "high", "note"),
    [
        (50, 10, 90, ""),
        (100, 90, 100, "one-sided: ends at the upper limit; estimate at a limit"),
        (30, 0, 60, "one-sided: ends at the lower limit"),
        (0, 0, 100, "not determined; estimate at a limit"),
        (50, 0, 100, "not determined"),
    ],
)
def test_a_note_says_what_reaches_the_search_range(
    value: float, low: float, high: float, note: str
) -> None:
    assert note_of(value, low, high) == note


def test_a_parameter_without_effect_is_not_determined() -> None:
    """c has no effect in these recordings: its interval is its range."""
    _, trial = person(np.random.default_rng(5))
    silent = Trial(trial.input * [1, 1, 0], trial.outputs)
    found = estimate_with_prior(PEOPLE, [silent], (0, 2), np.zeros(3), white_noise)
    assert (found.low[1], found.high[1]) == (-RANGE, RANGE)


def test_deviations_are_checked_and_default_to_a_quarter_of_the_range() -> None:
    given = ["a"], [0.0], [4.0], [1.0], lambda p, u: u * p
    assert parametric_model(*given).deviation == [1.0]
    for wrong in (-1.0, float("nan"), float("inf")):
        with pytest.raises(impc.InputError, match="deviation"):
            parametric_model(*given, deviation=[wrong])
    with pytest.raises(impc.InputError, match="one per parameter"):
        parametric_model(*given, deviation=[1.0, 1.0])


def test_truth_beside_simulated_recordings_is_compared(tmp_path: Path) -> None:
    """One person: the check, the table and result.json."""
    study, out = blood_study(tmp_path, 1, 1), tmp_path / "out"
    truth = {"1 visit 1": {"ka": 1.0, "ke": 0.1, "V": 1e3}}
    (tmp_path / "truth.json").write_text(json.dumps({"recordings": truth}))
    command = ["select", str(study), *MINE, "--out", str(out), "--workers", "1"]
    done = CliRunner().invoke(main, command)
    assert done.exit_code == 0, done.output
    found = json.loads((out / "result.json").read_text())
    page = (out / "report.html").read_text()
    table = found["findings"]["intervals"]["table"]
    assert table["truth"][2] == 1e3
    assert not table["inside"][2]
    assert f"inside the interval: {sum(table['inside'])} of 3;" in found["truth"]
    assert f"true value inside the interval: {sum(table['inside'])} of 3" in page.lower()


def test_truths_of_others_are_left_alone(tmp_path: Path) -> None:
    assert read_truths(tmp_path, PEOPLE) == {}
    for content in (b"no json", b"[1]", b'{"recordings": {"1": {"a": 1}}}', b"\xff"):
        (tmp_path / "truth.json").write_bytes(content)
        assert read_truths(tmp_path, PEOPLE) == {}
    (tmp_path / "truth.json").write_text('{"recordings": {"1": {"a": 1, "b": 2, "c": 3, "d": 4}}}')
    np.testing.assert_array_equal(read_truths(tmp_path, PEOPLE)["1"], [1, 2, 3])
