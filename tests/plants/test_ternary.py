"""Ternary sequences: properties of the spectrum, and sampling."""

from __future__ import annotations

import numpy as np
import pytest

from plants import ternary_sequence, ternary_torque


def test_the_default_is_one_period_of_the_published_register() -> None:
    register, expected = [2, 0, 2, 0, 2], []
    for _ in range(242):
        register = [(register[2] - register[3] - register[4]) % 3, *register[:4]]
        expected.append({0: 0, 1: 1, 2: -1}[register[0]])
    assert register == [2, 0, 2, 0, 2]
    once = ternary_sequence()
    np.testing.assert_array_equal(once, expected)
    np.testing.assert_array_equal(ternary_sequence(500), np.resize(expected, 500))
    # The register visits every state except zero, so that no part of the period repeats.
    windows = {tuple(np.roll(once, -k)[:5].tolist()) for k in range(242)}
    assert len(windows) == 242
    assert [int(np.sum(once == value)) for value in (-1, 0, 1)] == [81, 80, 81]


def test_autocorrelation_is_zero_except_at_half_periods() -> None:
    correlation = np.fft.ifft(np.abs(np.fft.fft(ternary_sequence())) ** 2).real
    expected = np.zeros(242)
    expected[[0, 121]] = 162, -162
    np.testing.assert_allclose(correlation, expected, atol=1e-9 * 242)


def test_a_seed_shifts_the_sequence_and_nothing_else() -> None:
    base, drawn = ternary_sequence(), ternary_sequence(seed=11)
    np.testing.assert_array_equal(drawn, ternary_sequence(seed=11))
    assert any(np.array_equal(np.roll(base, shift), drawn) for shift in range(242))
    torques = [ternary_torque(seed=s) for s in range(8)]
    assert any(np.any(torque != torques[0]) for torque in torques[1:])


def test_torque_holds_each_value_for_the_dwell() -> None:
    torque, sequence = ternary_torque(), ternary_sequence()
    assert torque.dtype == np.float64
    # A dwell of 12.5 samples: in integers, free of rounding.
    np.testing.assert_array_equal(torque, 5.0 * sequence[(2 * np.arange(3000)) // 25 % 242])


@pytest.mark.parametrize(("rate", "dwell", "held"), [(100.0, 0.07, 7), (1000.0, 0.003, 3)])
def test_whole_dwells_have_whole_numbers_of_samples(rate: float, dwell: float, held: int) -> None:
    # Dwells that binary fractions cannot represent.
    torque = ternary_torque(1.0, dwell, 10.0, rate)
    sequence = ternary_sequence(len(torque) // held + 1)
    np.testing.assert_array_equal(torque, np.repeat(sequence, held)[: len(torque)])
