"""Measures, passband, transfer functions and CMC against closed forms and direct sums."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import scipy.signal

import impc
import plants
from impc.arrays import Array
from impc.studies.reliability.analysis import cmc
from impc.studies.reliability.measures import band_energy, passband, rms, transfer_function

RATE = 100.0
TORQUE = plants.ternary_torque(dwell=0.12, duration=29.04, rate=RATE)


def test_rms_is_about_upright() -> None:
    values = np.array([[1.0, 3.0], [1.0, -3.0]])
    np.testing.assert_allclose(rms(values), [1.0, 3.0])


def test_energy_of_sines_is_half_their_squared_amplitudes() -> None:
    """Sines at 1, 2 and 8 Hz of amplitudes 3, 1, 5; the band holds the first two: 9/2 + 1/2."""
    time = np.arange(1000) / RATE
    y = 3 * np.sin(2 * np.pi * time) + np.cos(4 * np.pi * time) + 5 * np.sin(16 * np.pi * time)
    assert band_energy(y[:, None], RATE, 0.5, 2.0)[0] == pytest.approx(5.0)
    assert band_energy(y[:, None], RATE, 0.5, 49.0)[0] == pytest.approx(np.mean(y**2))


def test_passband_of_a_ternary_torque() -> None:
    """Odd harmonics of 1/29.04 Hz, up to where sinc^2(f 0.12) falls to 3 %: f 0.12 < 0.847."""
    found = passband(TORQUE, RATE)
    assert found.low == pytest.approx(1 / 29.04)
    assert found.high == pytest.approx(0.847 / 0.12, rel=0.01)
    assert np.all(found.excited % 2 == 1)
    assert np.all(np.diff(found.excited) == 2)


def test_passband_of_an_input_that_is_cut_inside_its_period() -> None:
    found = passband(TORQUE[:2500], RATE)
    assert found.low < 0.2
    assert found.high == pytest.approx(0.847 / 0.12, rel=0.1)


def test_an_empty_passband_is_a_sentence() -> None:
    with pytest.raises(impc.DataError, match="is constant"):
        passband(np.ones(500), RATE)


def respond(torque: Array) -> Array:
    """Steady-state response of the discretised 1 / (s + 2) to a periodic input."""
    b, a = [0.01], [1.0, -np.exp(-0.02)]
    return np.asarray(scipy.signal.lfilter(b, a, np.tile(torque, 4))[-len(torque) :])


def test_transfer_function_is_the_filter_s() -> None:
    """Compare with the filter's frequency response without noise: 1e-6."""
    band = passband(TORQUE, RATE)
    found = transfer_function(TORQUE[None], respond(TORQUE)[None, :, None], RATE, band)
    _, expected = scipy.signal.freqz([0.01], [1.0, -np.exp(-0.02)], found.frequency, fs=RATE)
    np.testing.assert_allclose(found.response[:, 0], expected, rtol=1e-6)
    np.testing.assert_allclose(found.coherence, 1.0)


def test_average_and_coherence_with_noise() -> None:
    """Twelve noisy trials, seed 1: the mean of their ETFEs, and coherence |G|^2 U / (… + noise)."""
    rng = np.random.default_rng(1)
    band, clean = passband(TORQUE, RATE), respond(TORQUE)
    noisy = clean[:, None] + 0.2 * rng.standard_normal((12, len(clean), 1))
    together = transfer_function(np.tile(TORQUE, (12, 1)), noisy, RATE, band)
    alone = [transfer_function(TORQUE[None], one[None], RATE, band).response for one in noisy]
    np.testing.assert_allclose(together.response, np.mean(alone, axis=0))
    signal = np.abs(np.fft.rfft(clean)[band.excited]) ** 2
    expected = signal / (signal + 0.2**2 * len(clean))
    assert np.mean(together.coherence[:, 0] - expected) == pytest.approx(1 / 12 * 0.3, abs=0.06)


def direct(curves: np.ndarray, between: bool) -> float:
    """Kadaba's formula as explicit sums."""
    M, N, T = curves.shape
    above = below = 0.0
    for i, j, t in itertools.product(range(M), range(N), range(T)):
        if between:
            own = sum(curves[a, b, t] for a in range(M) for b in range(N)) / (M * N)
            whole = sum(curves.ravel()) / (M * N * T)
        else:
            own = sum(curves[i, b, t] for b in range(N)) / N
            whole = sum(curves[i].ravel()) / (N * T)
        above += abs(curves[i, j, t] - own) ** 2
        below += abs(curves[i, j, t] - whole) ** 2
    if between:
        ratio = (above / (T * (M * N - 1))) / (below / (M * N * T - 1))
    else:
        ratio = (above / (M * T * (N - 1))) / (below / (M * (N * T - 1)))
    return float(np.sqrt(1 - ratio))


def test_cmc_is_its_sums() -> None:
    rng = np.random.default_rng(2)
    base = np.linspace(1, 0, 7) * np.exp(1j * np.linspace(0, 3, 7))
    noise = rng.standard_normal((3, 4, 7)) + 1j * rng.standard_normal((3, 4, 7))
    curves = base + 0.1 * noise + 0.05 * rng.standard_normal((3, 1, 1))
    assert cmc(curves, (1,)) == pytest.approx(direct(curves, between=False))
    assert cmc(curves, (0, 1)) == pytest.approx(direct(curves, between=True))
    assert cmc(np.tile(base, (2, 2, 1)), (0, 1)) == pytest.approx(1.0)


def test_cmc_of_curves_that_differ_more_than_frequencies_is_not_defined() -> None:
    curves = np.array([[[1.0, -1.0]], [[-1.0, 1.0]]]) + 0j
    assert np.isnan(cmc(curves, (0, 1)))
