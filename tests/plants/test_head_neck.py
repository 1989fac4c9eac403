"""The head-neck model against the reference's table of its loop, and an exact delay."""

from __future__ import annotations

import numpy as np
import pytest

import plants
from plants import HEAD_NECK_FIXED, table_4_3_column

NOMINAL = table_4_3_column("nominal")


def loop(theta: np.ndarray, w: np.ndarray) -> np.ndarray:
    """L = Kvis exp(-tau s) N / D with the exact delay, from the blocks of the diagram."""
    kvis, kvcr, kccr, tau, t1a, tcns1, tc, tcns2, tms1, tms2, b, k = theta
    s = 1j * w
    inertia, converter = HEAD_NECK_FIXED["J"][0], HEAD_NECK_FIXED["tau_c"][0]
    vcr = kvcr * s**2 * (t1a * s + 1) * (tcns1 * s + 1) / ((tc * s + 1) * (tcns2 * s + 1))
    ccr = kccr * (tms1 * s + 1) * (tms2 * s + 1)
    inner = 1 / ((converter * s + 1) * (inertia * s**2 + b * s + k) + vcr + ccr)
    return np.asarray(kvis * np.exp(-tau * s) * inner)


#: Crossover rad/s, phase margin deg, gain margin, DC gain, -3 dB Hz, peak: the reference's table.
REFERENCE = {
    "nominal": (2.69, 45.8, 1.74, 0.826, 0.90, 1.83),
    "fim": (2.35, 58.3, 2.24, 0.938, 0.90, 1.20),
    "lasso": (2.89, 50.6, 1.89, 0.912, 0.99, 1.58),
}


@pytest.mark.parametrize("name", REFERENCE)
def test_margins_of_the_columns_of_table_4_3(name: str) -> None:
    """From the blocks with an exact delay, and from the one fraction with Padé's: 2 %."""
    theta = table_4_3_column(name)
    crossover, margin, gain, dc, band, peak = REFERENCE[name]
    w = np.geomspace(1e-2, 60, 200_000)
    L = loop(theta, w)
    first = int(np.flatnonzero(np.abs(L) > 1)[-1])
    assert w[first] == pytest.approx(crossover, rel=0.02)
    assert 180 + np.degrees(np.unwrap(np.angle(L)))[first] == pytest.approx(margin, rel=0.02)
    crossing = int(np.flatnonzero(np.diff(np.sign(L.imag)) * (L.real[1:] < 0))[0])
    assert 1 / abs(L[crossing]) == pytest.approx(gain, rel=0.02)
    system = plants.head_neck_plant(theta)
    assert np.all(system.poles().real < 0)
    closed = np.geomspace(1e-2, 20, 4000)
    T = np.array([system(1j * value) for value in closed])
    assert abs(system(0)) == pytest.approx(dc, rel=0.02)
    assert np.max(np.abs(T)) == pytest.approx(peak, rel=0.02)
    below = np.flatnonzero(np.abs(T) < abs(system(0)) / np.sqrt(2))[0]
    assert closed[below] / (2 * np.pi) == pytest.approx(band, rel=0.02)


def test_the_fraction_is_the_diagram_and_pitch_feels_gravity() -> None:
    """Closed loop against L / (1 + L) with the exact delay, up to 10 rad/s: 1e-4.

    In pitch the DC gain is Kvis / (Kvis + Kccr + K - m g l), .838 in the reference.
    """
    w = np.geomspace(1e-3, 10, 200)
    L, system = loop(NOMINAL, w), plants.head_neck_plant(NOMINAL)
    np.testing.assert_allclose([system(1j * value) for value in w], L / (1 + L), rtol=1e-4)
    system = plants.head_neck_plant(NOMINAL, "pitch")
    assert np.all(system.poles().real < 0)
    m, lever = HEAD_NECK_FIXED["m"][0], HEAD_NECK_FIXED["l"][0]
    kvis, kccr, k = NOMINAL[[0, 2, 11]]
    expected = kvis / (kvis + kccr + k - m * 9.81 * lever)
    assert abs(system(0)) == pytest.approx(expected)
    assert expected == pytest.approx(0.838, abs=2e-3)


def test_steps_keep_their_durations_and_sizes() -> None:
    steps = plants.step_reference(seed=3)
    changes = np.flatnonzero(np.diff(steps)) + 1
    lengths = np.diff(changes) / 60.0
    assert lengths.min() >= 0.3 - 1 / 60
    assert lengths.max() <= 0.9 + 1 / 60
    assert np.max(np.abs(steps)) <= 4.0
