"""Delay and muscle against exact transfer functions and python-control's Padé."""

from __future__ import annotations

import control
import numpy as np
import pytest

from plants import delayed_muscle, pade_delay

DELAY, MUSCLE = 0.08, 0.06


@pytest.mark.parametrize("order", range(11))
def test_realisation_has_the_transfer_function_of_the_pade_approximant(order: int) -> None:
    realised = pade_delay(DELAY, order)
    numerator, denominator = control.pade(DELAY, order) if order else ([1.0], [1.0])
    for frequency in np.linspace(0.0, 60.0, 31):
        s = 1j * frequency
        expected = np.polyval(numerator, s) / np.polyval(denominator, s)
        assert abs(realised.response(frequency) - expected) < 1e-12
        # All-pass, therefore with direct feedthrough.
        assert abs(abs(realised.response(frequency)) - 1) < 1e-12
    assert (realised.D > 0) == (order % 2 == 0)


@pytest.mark.parametrize("order", range(1, 21))
def test_gramians_are_multiples_of_the_identity(order: int) -> None:
    realised = pade_delay(DELAY, order)
    scale = np.abs(realised.A).max()
    lyapunov = realised.A + realised.A.T + 2 * DELAY * np.outer(realised.B, realised.B)
    assert np.abs(lyapunov).max() < 1e-14 * scale
    np.testing.assert_allclose(
        realised.C, -2 * DELAY * realised.D * realised.B, rtol=1e-13, atol=1e-13
    )
    assert np.max(np.linalg.eigvals(realised.A).real) < 0


def test_fifth_order_chain_is_exact_up_to_20_rad_per_s() -> None:
    # Largest error 1.05e-8, at 20 rad/s; it grows as the 11th power of the frequency.
    chain = delayed_muscle(DELAY, MUSCLE, 5)
    for frequency in np.linspace(0.0, 20.0, 81):
        exact = np.exp(-1j * frequency * DELAY) / (1j * frequency * MUSCLE + 1)
        assert abs(chain.response(frequency) - exact) < 1.1e-8


def test_chain_ends_in_the_muscle_torque_without_feedthrough() -> None:
    chain = delayed_muscle(DELAY, MUSCLE, 5)
    np.testing.assert_array_equal(chain.C, [0, 0, 0, 0, 0, 1])
    assert chain.D == 0.0
    assert chain.response(0.0) == pytest.approx(1.0, abs=1e-13)
    np.testing.assert_allclose(delayed_muscle(DELAY, MUSCLE, 0).A, [[-1 / MUSCLE]])
