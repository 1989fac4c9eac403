"""Jumps of a push are found on their lattice, and means over a sample are exact."""

from __future__ import annotations

import numpy as np
import pytest

from impc.files.resampling import held_means, steps_of
from plants.ternary import ternary_torque

DT, DWELL, DURATION = 0.01, 0.125, 15.0
FINE = 8000.0  # samples/s at which the exact means are counted


def exact_means(seed: int, samples: int) -> np.ndarray:
    """Means over samples of `DT`, from a recording that has every jump on a sample."""
    fine = ternary_torque(dwell=DWELL, duration=DURATION, rate=FINE, seed=seed)
    whole = fine[: samples * round(DT * FINE)].reshape(samples, -1)
    return np.asarray(whole.mean(axis=1))


@pytest.mark.parametrize("rate", [1000.0, 500.0, 250.0, 200.0, 125.0, 100.0, 80.0])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_means_are_exact_at_any_rate(rate: float, seed: int) -> None:
    recorded = ternary_torque(dwell=DWELL, duration=DURATION, rate=rate, seed=seed)
    steps = steps_of(recorded)
    assert steps is not None
    assert steps.dwell / rate == pytest.approx(DWELL, rel=1e-9)
    found = held_means(recorded, 1 / rate, DT, steps)
    inside = len(found) - 15  # the last value lasts beyond the end
    np.testing.assert_allclose(found[:inside], exact_means(seed, inside), atol=1e-9)


@pytest.mark.parametrize("rate", [1000.0, 200.0, 100.0])
def test_a_clock_that_begins_between_jumps_moves_all_by_less_than_a_sample(rate: float) -> None:
    """Only a common part of a sample stays unknown, and jumps are never early by more than that."""
    fine = ternary_torque(dwell=DWELL, duration=DURATION, rate=FINE, seed=4)
    every = round(FINE / rate)
    for first in range(0, every, max(every // 7, 1)):
        steps = steps_of(fine[first::every])
        assert steps is not None
        late = (steps.edges + first / every) / rate / DWELL
        away = (late - np.round(late)) * DWELL * rate
        np.testing.assert_allclose(away, away[0], atol=1e-9)
        assert -1e-9 <= away[0] < 1


def test_a_shift_moves_the_jumps() -> None:
    values = ternary_torque(dwell=DWELL, duration=DURATION, rate=100.0, seed=5)
    steps = steps_of(values)
    assert steps is not None
    borders = np.arange(1001.0)
    np.testing.assert_allclose(
        steps.delayed(0.5).means(borders[1:]), steps.means(borders[1:] - 0.5), atol=1e-12
    )


def test_held_samples_stay_as_they_are() -> None:
    """Jumps at whole numbers of samples: each sample is its own mean."""
    values = ternary_torque(dwell=0.12, duration=DURATION, rate=100.0, seed=6)
    steps = steps_of(values)
    assert steps is not None
    np.testing.assert_allclose(held_means(values, DT, DT, steps), values, atol=1e-9)


@pytest.mark.parametrize("kind", ["noise", "sine", "few", "irregular", "moved"])
def test_other_signals_have_no_lattice(kind: str) -> None:
    rng = np.random.default_rng(7)
    values = ternary_torque(dwell=DWELL, duration=DURATION, rate=200.0, seed=7)
    if kind == "noise":
        values = values + 1e-3 * rng.standard_normal(len(values))
    elif kind == "sine":
        values = np.sin(np.arange(3000) / 20)
    elif kind == "few":
        values = np.repeat([0.0, 5.0, 0.0], 1000)
    elif kind == "irregular":
        values = np.repeat(rng.choice([-5.0, 5.0], 60), rng.integers(20, 60, 60))
    else:  # one jump is two samples late
        jump = np.flatnonzero(np.diff(values))[5] + 1
        values[jump : jump + 2] = values[jump - 1]
    assert steps_of(values) is None
