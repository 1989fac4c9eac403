"""The distribution of a cursor's steps and rests against sums over all pixels and drawn steps."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.stats

from experiments.cursor_steps import Expected, fit_steps, step_nats

pytestmark = pytest.mark.full

NUMBERS = np.array([-0.1, -0.3, 1.2, np.log(4.0)])


def one(position: float, last: float = 2.0, mean: float = 2.7, deviation: float = 0.8) -> Expected:
    return Expected(*(np.array([value]) for value in (position, last, mean, deviation)))


def test_probabilities_of_all_pixels_sum_to_one() -> None:
    # Beyond them are 5e-11.
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
    # Deviations of 20 000 steps are .01 to .07.
    np.testing.assert_allclose(found, NUMBERS, atol=0.2)
