"""The protocols find given thresholds to within a step, and raise errors if they cannot."""

from __future__ import annotations

import math

import pytest

from experiments.protocols import critical_stiffness, torque_amplitude
from impc.errors import InputError, SolverError


@pytest.mark.parametrize("threshold", [40.0, 61.3, 117.5, 249.0])
def test_a_planted_stiffness_is_the_first_failing_level(threshold: float) -> None:
    """By hand: the first of 250, 240, ... below the threshold, then of steps of 5."""
    found = critical_stiffness(lambda k: k >= threshold)
    coarse = 250 - 10 * math.ceil((250 - threshold) / 10 + (1e-12 if (250 - threshold) % 10 else 1))
    assert found.coarse == coarse
    assert found.levels == (coarse, coarse, *[found.fine] * 3)
    assert found.fine < threshold <= found.fine + 5
    assert found.experimental == 2 * found.fine


def test_the_lower_coarse_search_counts_and_the_fine_ones_are_averaged() -> None:
    thresholds = iter([100.0, 80.0, 90.0, 80.0, 100.0])
    level = {"now": 0.0, "last": -1.0}

    def balances(k: float) -> bool:
        if k > level["last"]:
            level["now"] = next(thresholds)
        level["last"] = k if k >= level["now"] else -1.0
        return k >= level["now"]

    found = critical_stiffness(balances)
    assert found.levels == (90.0, 70.0, 85.0, 75.0, 95.0)
    assert found.coarse == 70.0
    assert found.fine == pytest.approx(85.0)


def test_a_planted_torque() -> None:
    found = torque_amplitude(lambda a: 1.5 * a, lambda a: a <= 4, angle=8.0)
    assert (found.coarse, found.amplitude) == (6.0, 4.0)
    assert found.trials == 6 + 2 + 2


def test_what_cannot_be_found_is_said() -> None:
    with pytest.raises(SolverError, match="never lost"):
        critical_stiffness(lambda _: True)
    with pytest.raises(SolverError, match="already"):
        critical_stiffness(lambda _: False)
    with pytest.raises(InputError, match="step"):
        critical_stiffness(lambda _: True, fine_step=0.0)
    with pytest.raises(SolverError, match="reaches the angle"):
        torque_amplitude(lambda _: 0.0, lambda _: True, angle=8.0)
    with pytest.raises(SolverError, match="passed twice"):
        torque_amplitude(lambda _: 9.0, lambda _: False, angle=8.0)
