"""The study of structures, small: one subject scored; forty in the slow one."""

from __future__ import annotations

import numpy as np
import pytest

from experiments.structure_study import cart_person, score

pytestmark = pytest.mark.full


def test_a_subject_is_scored_against_its_truth() -> None:
    found = score(cart_person(0, 90.0, 0.0, 0.0), "carts", 0)
    assert found.holds == [True] * 5  # seed 0
    assert found.one_sided == [False] * 5
    assert found.excess < 0.5  # the default start ends where a search from the truth does
    assert found.freedom >= 3
    assert 0.05 < found.probability <= 1  # seed 0


@pytest.mark.slow
def test_the_level_of_the_test_and_its_power() -> None:
    """Of 40 at 5 % two are refused: 7 or more have a probability of 0.5 %."""
    people = [score(cart_person(k, 90.0, 0.8, 0.0), "", k, intervals=False) for k in range(40)]
    assert sum(item.probability < 0.05 for item in people) <= 6
    crossed = [score(cart_person(k, 90.0, 0.0, 0.5), "", k, intervals=False) for k in range(5)]
    assert np.mean([item.probability < 0.05 for item in crossed]) == 1.0
