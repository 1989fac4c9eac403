"""Human target tracking, on the recordings if present, and its baselines."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import scipy.stats

from experiments.cursor_baseline import delayed_feedback, fit_delayed_feedback
from experiments.cursor_ceiling import fit_step_response, follow
from experiments.cursor_data import RATE, Condition, data_file, read_conditions
from experiments.cursor_steps import Expected, fit_steps, step_nats
from experiments.cursor_structures import STRUCTURES, structure_rows
from experiments.cursor_tracking import left_out_vaf
from impc.errors import DataError
from tests.experiments.recordings import recorded

pytestmark = pytest.mark.full


#: Leave-one-trial-out VAF of a delayed second-order feedback, sharpest target first.
REFERENCE = (86.7, 82.7, 84.3, 80.1, 57.8, 48.4)


def test_delayed_feedback_is_its_difference_equation() -> None:
    """Compared with a simulation step by step; seed 0."""
    target = np.cumsum(np.random.default_rng(0).standard_normal((2, 200)), axis=1)
    k1, k2, delay, dt = 20.0, 6.0, 5, 1 / RATE
    moved = target - target[:, :1]
    cursor = np.zeros_like(moved)
    for k in range(199):
        past = k - delay
        error = (cursor - moved)[:, past] if past >= 0 else 0.0
        speed = (cursor[:, past] - cursor[:, past - 1]) / dt if past >= 1 else 0.0
        before = cursor[:, k - 1] if k >= 1 else 0.0
        cursor[:, k + 1] = 2 * cursor[:, k] - before - dt**2 * (k1 * error + k2 * speed)
    found = delayed_feedback(target, np.array([k1, k2]), delay)
    # The filter uses the speed between the samples `delay` and `delay + 1` ago.
    np.testing.assert_allclose(found, cursor, atol=1e-9 * np.max(np.abs(cursor)))


def test_delayed_feedback_is_found_again() -> None:
    target = np.cumsum(np.random.default_rng(1).standard_normal((3, 600)), axis=1)
    response = delayed_feedback(target, np.array([15.0, 5.0]), 9)
    gains, delay = fit_delayed_feedback(target, response)
    assert delay == 9
    np.testing.assert_allclose(gains, [15.0, 5.0], rtol=1e-4)


def test_the_free_response_finds_that_of_delayed_feedback() -> None:
    """Superposition against the recursion, whose response settles within 2 s; seed 2."""
    target = np.cumsum(np.random.default_rng(2).standard_normal((8, 1200)), axis=1)
    response = delayed_feedback(target, np.array([20.0, 8.0]), 3)
    found = fit_step_response(target[1:], response[1:])
    error = follow(target[0], found) - response[0]
    assert np.std(error) < 5e-3 * np.std(response[0])


def test_an_absent_file_is_said(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="is not there"):
        read_conditions(tmp_path / "nothing.mat")


@pytest.mark.slow
@recorded
def test_the_error_alone_predicts_as_well_as_any_weights() -> None:
    """At 13 px; a minute."""
    rows = structure_rows(read_conditions(data_file())[1])
    assert [row.structure for row in rows] == ["any weights", *STRUCTURES]
    assert np.ptp([row.held_out for row in rows]) < 0.5
    assert not any(row.refused for row in rows)
    assert rows[2].velocity == 0.0
    assert rows[2].high < 0.2


NUMBERS = np.array([-0.1, -0.3, 1.2, np.log(4.0)])


def one(position: float, last: float = 2.0, mean: float = 2.7, deviation: float = 0.8) -> Expected:
    return Expected(*(np.array([value]) for value in (position, last, mean, deviation)))


def test_probabilities_of_all_pixels_sum_to_one() -> None:
    # Pixels beyond have 5e-11.
    total = sum(np.exp(step_nats(NUMBERS, one(float(k)))) for k in range(-500, 500))
    assert total == pytest.approx(1.0, abs=1e-9)


def test_a_rest_and_a_step_have_the_probability_of_the_formula() -> None:
    still = 1 / (1 + np.exp(-0.3 + 1.2 * 0.7 / 0.8))
    wide = np.exp(-0.1) * 0.8

    def pixel(k: float) -> float:
        points = np.linspace(k - 0.5, k + 0.5, 20001)
        return float(np.trapezoid(scipy.stats.t(4).pdf((points - 2.7) / wide) / wide, points))

    rest, step = (np.exp(step_nats(NUMBERS, one(k))) for k in (2.0, 4.0))
    assert rest == pytest.approx(still + (1 - still) * pixel(2.0), rel=1e-8)
    assert step == pytest.approx((1 - still) * pixel(4.0), rel=1e-8)


def test_numbers_of_drawn_steps_are_found() -> None:
    rng, count = np.random.default_rng(3), 20000
    last = np.zeros(count)
    mean, deviation = rng.normal(0, 1.0, count), np.full(count, 0.8)
    still = 1 / (1 + np.exp(NUMBERS[1] + NUMBERS[2] * np.abs(mean) / deviation))
    steps = np.round(mean + np.exp(NUMBERS[0]) * deviation * rng.standard_t(4, count))
    position = np.where(rng.random(count) < still, last, steps)
    found = fit_steps(Expected(position, last, mean, deviation))
    # Standard errors for 20 000 steps are 0.01 to 0.07.
    np.testing.assert_allclose(found, NUMBERS, atol=0.2)


def mean_left_out(condition: Condition) -> tuple[float, float]:
    found = [left_out_vaf(condition, index)[:2] for index in range(len(condition.target))]
    ours, baseline = np.mean(found, axis=0)
    return float(ours), float(baseline)


@recorded
@pytest.mark.parametrize(
    "index", [5, *(pytest.param(index, marks=pytest.mark.slow) for index in range(5))]
)
def test_left_out_trials_are_predicted(index: int) -> None:
    """At least the reference minus a point, and as good as the delayed feedback here."""
    ours, baseline = mean_left_out(read_conditions(data_file())[index])
    assert ours >= REFERENCE[index] - 1.0
    assert ours >= baseline - 1.0
