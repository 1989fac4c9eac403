"""Sums over lags against the full covariance matrix of the noise."""

from __future__ import annotations

import numpy as np
import pytest

from impc.assess.long_run_covariance import _coloured


@pytest.mark.parametrize(("samples", "lags"), [(9, 1), (9, 4), (3, 5)])
def test_sums_are_those_of_the_whole_covariance_matrix(samples: int, lags: int) -> None:
    """Two outputs with asymmetric cross-covariances; more lags than samples."""
    rng = np.random.default_rng(samples + lags)
    columns = rng.standard_normal((samples, 2, 3))
    gammas = rng.standard_normal((lags, 2, 2))
    gammas[0] += gammas[0].T
    whole = np.zeros((samples, 2, samples, 2))
    for t, s in np.ndindex(samples, samples):
        if abs(t - s) < lags:
            whole[t, :, s, :] = gammas[t - s] if t >= s else gammas[s - t].T
    np.testing.assert_allclose(
        _coloured(columns, gammas), np.tensordot(whole, columns, 2), atol=1e-13
    )
