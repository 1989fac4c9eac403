"""How far weights are identified, in words; sentences of whole fits are in `test_structures`."""

from __future__ import annotations

import numpy as np
import pytest

from impc.assess.weight_profiles import WeightInterval
from impc.studies.fit.structure_words import ends, factor_of, probability


@pytest.mark.parametrize(
    ("low", "high", "said"),
    [
        (np.log(2.0), np.log(8.0), "2 to 8"),
        (-np.inf, np.log(8.0), "at most 8"),
        (np.log(2.0), np.inf, "at least 2"),
        (-np.inf, np.inf, "not identified"),
    ],
)
def test_an_interval_says_which_ends_it_has(low: float, high: float, said: str) -> None:
    assert ends(WeightInterval(np.log(4.0), low, high, 0.95)) == said


def test_a_deviation_is_a_factor_at_95_percent() -> None:
    assert factor_of(np.log(1.5) / 1.96) == "to 50 %"
    assert factor_of(np.log(3.0) / 1.96) == "to a factor of 3"
    assert factor_of(np.log(11.0) / 1.96) == "not at all"
    assert factor_of(np.inf) == "not at all"


def test_a_small_probability_is_not_written_out() -> None:
    assert probability(0.78123) == "p = 0.78"
    assert probability(1e-9) == "p < 0.001"
