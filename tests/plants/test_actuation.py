"""Delay and muscle against exact transfer functions and python-control's Padé."""

from __future__ import annotations

import control
import numpy as np
import pytest

from plants import delayed_muscle, pade_delay

DELAY, MUSCLE = 0.08, 0.06


@pytest.mark.parametrize("order", range(21))
def test_the_delay_is_the_all_pass_pade_approximant_in_its_best_form(order: int) -> None:
    """Both Gramians are multiples of the identity; python-control's form is exact to order 10."""
    realised = pade_delay(DELAY, order)
    scale = np.abs(realised.A).max(initial=1.0)
    lyapunov = realised.A + realised.A.T + 2 * DELAY * np.outer(realised.B, realised.B)
    assert np.abs(lyapunov).max(initial=0.0) < 1e-14 * scale
    np.testing.assert_allclose(
        realised.C, -2 * DELAY * realised.D * realised.B, rtol=1e-13, atol=1e-13
    )
    assert np.max(np.linalg.eigvals(realised.A).real, initial=-1.0) < 0
    assert (realised.D > 0) == (order % 2 == 0)
    numerator, denominator = control.pade(DELAY, order) if order else ([1.0], [1.0])
    for frequency in np.linspace(0.0, 60.0, 31):
        found = realised.response(frequency)
        assert abs(abs(found) - 1) < 1e-12
        s = 1j * frequency
        expected = np.polyval(numerator, s) / np.polyval(denominator, s)
        assert order > 10 or abs(found - expected) < 1e-12


def test_the_chain_of_order_five_is_exact_up_to_20_rad_per_s_and_ends_in_the_torque() -> None:
    # Largest error 1.05e-8, at 20 rad/s; it grows as the 11th power of the frequency.
    chain = delayed_muscle(DELAY, MUSCLE, 5)
    for frequency in np.linspace(0.0, 20.0, 81):
        exact = np.exp(-1j * frequency * DELAY) / (1j * frequency * MUSCLE + 1)
        assert abs(chain.response(frequency) - exact) < 1.1e-8
    np.testing.assert_array_equal(chain.C, [0, 0, 0, 0, 0, 1])
    assert chain.D == 0.0
    np.testing.assert_allclose(delayed_muscle(DELAY, MUSCLE, 0).A, [[-1 / MUSCLE]])
