"""Resampling of signals whose values and means are known."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.signal

from impc.files.resampling import held_means, instants, resampled_samples, same_rate

DT = 0.01
RATES = [250.0, 1000.0, 333.3, 2048.0, 10_000.0, 100.7, 50.0, 37.0]


def lower_nyquist(rate: float) -> float:
    return min(rate, 1 / DT) / 2


def edge(rate: float) -> float:
    """Half-width of the filter in s, beyond each end."""
    return (70 - 7.95) / (2.285 * 2 * np.pi * 0.2 * lower_nyquist(rate)) / 2


@pytest.mark.parametrize("rate", RATES)
@pytest.mark.parametrize("share", [0.01, 0.3, 0.6, 0.79])
def test_a_sinusoid_below_keeps_amplitude_and_phase(rate: float, share: float) -> None:
    frequency = share * lower_nyquist(rate)
    time = np.arange(int(6 * rate)) / rate
    result = instants(np.sin(2 * np.pi * frequency * time + 0.4), 1 / rate, DT)
    at = np.arange(len(result)) * DT
    width = edge(rate)
    inside = (at >= width) & (at <= time[-1] - width)
    error = result - np.sin(2 * np.pi * frequency * at + 0.4)
    assert np.abs(error[inside]).max() < 1e-3


@pytest.mark.parametrize("rate", [rate for rate in RATES if rate > 110])
@pytest.mark.parametrize("share", [1.0, 1.2, 1.9])
def test_a_sinusoid_above_is_gone(rate: float, share: float) -> None:
    frequency = share * lower_nyquist(rate)
    time = np.arange(int(6 * rate)) / rate
    result = instants(np.sin(2 * np.pi * frequency * time + 0.4), 1 / rate, DT)
    at = np.arange(len(result)) * DT
    inside = (at >= edge(rate)) & (at <= time[-1] - edge(rate))
    assert np.abs(result[inside]).max() < 1e-3  # 60 dB


@pytest.mark.parametrize("rate", RATES)
def test_a_straight_line_stays_one_up_to_both_ends(rate: float) -> None:
    time = np.arange(int(6 * rate)) / rate
    result = instants(3.0 - 2.0 * time, 1 / rate, DT)
    np.testing.assert_allclose(result, 3.0 - 2.0 * DT * np.arange(len(result)), atol=1e-3)


def test_the_same_rate_passes_unchanged() -> None:
    values = np.random.default_rng(0).normal(size=500)
    for period in (DT, DT * (1 + 1e-6)):
        assert instants(values, period, DT) is values
        assert held_means(values, period, DT) is values
    assert not same_rate(500, DT * (1 + 1e-3), DT)


def test_against_scipy_at_a_whole_ratio() -> None:
    rng = np.random.default_rng(1)
    rough = rng.normal(size=8000)
    smooth = scipy.signal.sosfiltfilt(scipy.signal.butter(6, 20, fs=1000, output="sos"), rough)
    ours = instants(smooth, 1e-3, DT)
    theirs = scipy.signal.resample_poly(smooth, 1, 10, window=("kaiser", 7.0))
    middle = slice(50, -50)
    assert np.abs(ours - theirs)[middle].max() < 0.01 * np.abs(theirs).max()


@pytest.mark.parametrize("rate", RATES)
def test_means_of_a_sinusoid(rate: float) -> None:
    frequency, period = 2.0, 1 / rate
    time = np.arange(int(4 * rate)) * period
    result = held_means(np.cos(2 * np.pi * frequency * time), period, DT)[:-2]
    border = 2 * np.pi * frequency * DT * np.arange(len(result) + 1)
    exact = np.diff(np.sin(border)) / (2 * np.pi * frequency * DT)
    # Linear between samples: the error of the trapezoidal rule, w^2 T^2 / 8 at most.
    assert np.abs(result - exact).max() < (2 * np.pi * frequency * period) ** 2 / 8 + 1e-12


@pytest.mark.parametrize("rate", RATES)
def test_the_impulse_of_a_push_is_kept(rate: float) -> None:
    values = np.zeros(int(4 * rate))
    values[int(rate) : int(1.13 * rate)] = 7.0
    result = held_means(values, 1 / rate, DT)
    assert DT * result.sum() == pytest.approx(values.sum() / rate, rel=1e-9)


@pytest.mark.parametrize(("samples", "rate", "expected"), [(1000, 1000, 100), (1001, 1000, 101)])
def test_number_of_samples(samples: int, rate: float, expected: int) -> None:
    assert resampled_samples(samples, 1 / rate, DT) == expected
    assert len(instants(np.ones(samples), 1 / rate, DT)) == expected
    assert len(held_means(np.ones(samples), 1 / rate, DT)) == expected
