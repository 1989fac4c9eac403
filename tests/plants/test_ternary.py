"""Ternary sequences: properties of the spectrum, and sampling."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from plants import maximal_recurrence, ternary_sequence, ternary_torque

STAGES = range(1, 8)


@pytest.mark.parametrize("stages", STAGES)
def test_period_counts_and_half_period_antisymmetry(stages: int) -> None:
    period = 3**stages - 1
    twice = ternary_sequence(stages, 2 * period)
    once = twice[:period]
    np.testing.assert_array_equal(twice[period:], once)
    assert all(
        np.any(np.roll(once, shift) != once) for shift in range(1, period) if period % shift == 0
    )
    third = 3 ** (stages - 1)
    assert [int(np.sum(once == value)) for value in (-1, 0, 1)] == [third, third - 1, third]
    np.testing.assert_array_equal(once[period // 2 :], -once[: period // 2])


@pytest.mark.parametrize("stages", STAGES)
def test_autocorrelation_is_zero_except_at_half_periods(stages: int) -> None:
    values = ternary_sequence(stages)
    period = len(values)
    correlation = np.fft.ifft(np.abs(np.fft.fft(values)) ** 2).real
    expected = np.zeros(period)
    expected[0] = 2 * 3 ** (stages - 1)
    expected[period // 2] = -expected[0]
    np.testing.assert_allclose(correlation, expected, atol=1e-9 * period)


@pytest.mark.parametrize("stages", [2, 3, 4, 5])
def test_each_window_occurs_once_in_a_period(stages: int) -> None:
    # Independent of the polynomial: the register visits every state except zero.
    values = ternary_sequence(stages)
    windows = {tuple(np.roll(values, -k)[:stages].tolist()) for k in range(len(values))}
    assert len(windows) == 3**stages - 1
    assert (0,) * stages not in windows


def test_default_is_the_published_register() -> None:
    assert maximal_recurrence(5) == (0, 0, 1, 2, 2)
    register, expected = [2, 0, 2, 0, 2], []
    for _ in range(242):
        register = [(register[2] - register[3] - register[4]) % 3, *register[:4]]
        expected.append({0: 0, 1: 1, 2: -1}[register[0]])
    assert register == [2, 0, 2, 0, 2]
    np.testing.assert_array_equal(ternary_sequence(), expected)


def test_a_seed_shifts_the_sequence_and_nothing_else() -> None:
    seed = int(np.random.default_rng().integers(2**31))
    print(f"seed {seed}")
    base = ternary_sequence(4)
    drawn = ternary_sequence(4, seed=seed)
    np.testing.assert_array_equal(drawn, ternary_sequence(4, seed=seed))
    assert any(np.array_equal(np.roll(base, shift), drawn) for shift in range(80))
    torques = [ternary_torque(stages=4, seed=s) for s in range(8)]
    assert any(np.any(torque != torques[0]) for torque in torques[1:])


def test_torque_holds_each_value_for_the_dwell() -> None:
    torque = ternary_torque()
    assert torque.shape == (3000,)
    assert torque.dtype == np.float64
    sequence = ternary_sequence()
    for k in range(3000):
        # A dwell of 12.5 samples: in integers, free of rounding.
        assert torque[k] == 5.0 * sequence[(2 * k) // 25 % 242]


@pytest.mark.parametrize(("rate", "dwell", "held"), [(100.0, 0.07, 7), (1000.0, 0.003, 3)])
def test_whole_dwells_have_whole_numbers_of_samples(rate: float, dwell: float, held: int) -> None:
    # Dwells that binary fractions cannot represent.
    torque = ternary_torque(1.0, dwell, 10.0, rate)
    sequence = ternary_sequence(5, len(torque) // held + 1)
    np.testing.assert_array_equal(torque, np.repeat(sequence, held)[: len(torque)])


def test_period_of_four_stages_lasts_thirty_seconds() -> None:
    torque = ternary_torque(2.0, 0.375, 60.0, 100.0, 4)
    # 37.5 samples a step: the period of 80 steps is 3000 samples.
    np.testing.assert_array_equal(torque[3000:], torque[:3000])
    assert set(torque) == {-2.0, 0.0, 2.0}


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("stages", {"stages": 0}),
        ("stages", {"stages": 2.5}),
        ("length", {"length": -1}),
        ("start", {"start": [0, 0, 0, 0, 0]}),
        ("start", {"start": [1, 0]}),
        ("start", {"start": [3, 0, 0, 0, 0]}),
        ("seed", {"seed": 1, "start": [1, 0, 0, 0, 0]}),
        ("seed", {"seed": -1}),
    ],
)
def test_bad_sequences_are_refused_by_name(name: str, arguments: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=rf"^{name}: .*; ") as error:
        ternary_sequence(**arguments)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("name", "value"),
    [("amplitude", -1.0), ("dwell", 0.001), ("duration", 0.0), ("rate", float("inf"))],
)
def test_bad_torques_are_refused_by_name(name: str, value: float) -> None:
    arguments: dict[str, Any] = {name: value}
    with pytest.raises(ValueError, match=rf"^{name}: expected .*, got .*; "):
        ternary_torque(**arguments)
