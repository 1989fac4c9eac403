"""VAF by hand, whiteness and Holm's correction by statsmodels, saturation by counting."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.signal
from statsmodels.stats.diagnostic import acorr_ljungbox
from statsmodels.stats.multitest import multipletests

import impc
from impc.assess.several_tests import holm
from impc.assess.variance_accounted_for import centred_vaf, saturated_share, whiteness


def test_variance_accounted_for_by_hand() -> None:
    recorded = np.array([[3.0, 1.0], [4.0, 1.0]])
    simulated = np.array([[3.0, 0.0], [3.0, 1.0]])
    np.testing.assert_allclose(impc.vaf(recorded, simulated), [100 * (1 - 1 / 25), 50.0])
    # The second output is constant zero: VAF is undefined.
    np.testing.assert_allclose(centred_vaf(recorded, simulated), [0.0, np.nan])
    assert np.isnan(impc.vaf(np.zeros((5, 1)), np.ones((5, 1)))[0])
    # A shift counts in VAF and not in the centred one.
    y = np.sin(np.arange(100.0))[:, None]
    assert centred_vaf(y, y + 1)[0] == pytest.approx(100)
    assert impc.vaf(y, y + 1)[0] < 0


def test_whiteness_is_ljung_and_box() -> None:
    """Against statsmodels; seed 1."""
    noise = np.random.default_rng(1).standard_normal(500) + 0.3
    expected = acorr_ljungbox(noise, lags=[20])["lb_pvalue"].iloc[0]
    assert whiteness(noise[:, None], 20)[0] == pytest.approx(expected, rel=1e-9)
    coloured = scipy.signal.lfilter(
        [1.0], [1.0, -0.5], np.random.default_rng(2).standard_normal((2000, 1)), axis=0
    )
    assert whiteness(coloured, 50)[0] < 1e-6
    assert np.isnan(whiteness(np.zeros((100, 1)), 10)[0])


def test_saturated_share_counts_samples() -> None:
    u = np.array([[1.0, 0.0], [0.5, 0.0], [0.2, -2.0], [0.0, 0.0]])
    limits = np.array([1.0, 2.0])
    assert saturated_share(u, -limits, limits) == 0.5
    free = np.full(2, np.inf)
    assert saturated_share(u, -free, free) == 0.0


def test_correction_for_several_tests_is_statsmodels() -> None:
    """Equal to the last bit, including ties, values capped at 1, and NaN."""
    rng = np.random.default_rng(5)
    for count in (0, 1, 2, 7):
        given = rng.uniform(0, 0.3, count).round(1)
        expected = multipletests(given, method="holm")[1] if count else []
        np.testing.assert_array_equal(holm(given), expected)
        np.testing.assert_array_equal(holm(np.append(np.nan, given)), [np.nan, *expected])
