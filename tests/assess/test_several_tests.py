"""Holm's correction against statsmodels."""

from __future__ import annotations

import numpy as np
from statsmodels.stats.multitest import multipletests

from impc.assess.several_tests import holm

SEED = 5


def test_correction_for_several_tests_is_statsmodels() -> None:
    """Equal to the last bit, including ties, values capped at 1, and NaN."""
    rng = np.random.default_rng(SEED)
    for count in (0, 1, 2, 7):
        given = rng.uniform(0, 0.3, count).round(1)
        expected = multipletests(given, method="holm")[1] if count else []
        np.testing.assert_array_equal(holm(given), expected)
        np.testing.assert_array_equal(holm(np.append(np.nan, given)), [np.nan, *expected])
