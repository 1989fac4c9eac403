"""Autocorrelation of residuals and its correction for the fit, against Toeplitz matrices."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg
import scipy.signal

from impc.arrays import Array
from impc.assess import long_run_covariance
from impc.inverse.columns import trial_span

_TRIALS, _SAMPLES, _OUTPUTS, _DRAWS = 2, 400, 2, 60


def _regression() -> tuple[Array, Array]:
    """Slow regressors (r, 10), and decaying ones of each trial (r, 3); seed 3."""
    rng = np.random.default_rng(3)
    size = (_TRIALS * _SAMPLES, _OUTPUTS, 10)
    slow = scipy.signal.lfilter([1.0], [1.0, -0.95], rng.standard_normal(size), axis=0)
    decay = np.exp(-np.arange(_SAMPLES) / 25)[:, None, None] * rng.standard_normal((1, _OUTPUTS, 3))
    rows = _TRIALS * _SAMPLES * _OUTPUTS
    return slow.reshape(rows, 10), np.concatenate([decay] * _TRIALS).reshape(rows, 3)


def _noise(rng: np.random.Generator, root: float) -> Array:
    white = rng.standard_normal((_TRIALS, 300 + _SAMPLES, _OUTPUTS))
    return np.asarray(scipy.signal.lfilter([1.0], [1.0, -root], white, axis=1)[:, 300:])


def test_colour_of_a_first_order_process() -> None:
    """Seed 5: the variance of a sum is N times the spectral density at zero, 1/(1 - a)^2."""
    rng = np.random.default_rng(5)
    noise = rng.standard_normal((40000, 1))
    for a in (0.0, 0.5, 0.9):
        series = scipy.signal.lfilter([1.0], [1.0, -a], noise, axis=0)
        found = long_run_covariance.residual_noise([series])
        assert found.root[0] == pytest.approx(a, abs=0.01)
        spread = long_run_covariance.spread_of_sum(found, [np.ones((10000, 1, 1))])[0, 0]
        assert spread / 10000 == pytest.approx(1 / (1 - a) ** 2, rel=0.05)


def test_spread_of_a_weighted_sum_is_that_of_its_toeplitz_matrix() -> None:
    """Known autocorrelation, two outputs: against the full covariance matrix of the noise."""
    a, rng = np.array([0.6, -0.3]), np.random.default_rng(8)
    mixing = np.array([[1.0, 0.4], [0.0, 0.8]])
    found = long_run_covariance.ResidualNoise(a, (mixing @ mixing.T)[None])
    samples, before = 30, 200
    columns = rng.standard_normal((samples, 2, 3))
    response = np.zeros((samples, 2, before + samples, 2))  # of e_t to eps_s
    for t in range(samples):
        for s in range(before + t + 1):
            response[t, :, s, :] = np.diag(a ** (before + t - s)) @ mixing
    weighted = np.tensordot(columns, response, ((0, 1), (0, 1))).reshape(3, -1)
    np.testing.assert_allclose(
        long_run_covariance.spread_of_sum(found, [columns]), weighted @ weighted.T, rtol=1e-9
    )


@pytest.mark.parametrize(("root", "short"), [(0.0, 0.99), (0.5, 0.98), (0.9, 0.85)])
def test_deviations_of_a_regression_are_those_of_the_noise(root: float, short: float) -> None:
    """60 draws: mean variance of ten coefficients equals theory only with the correction."""
    # The mean of 60 draws has a standard error of about 1 % (.5) to 3 % (.9).
    slow, own = _regression()
    sizes = [_SAMPLES * _OUTPUTS] * _TRIALS
    fitted = trial_span(own, sizes, slow)
    left = trial_span(own, sizes, np.zeros((len(own), 0))).without(slow)
    coefficients = np.linalg.solve(left.T @ left, left.T)  # (10, r)
    one = scipy.linalg.toeplitz(root ** np.arange(_SAMPLES)) / (1 - root**2)
    noise = np.kron(np.eye(_TRIALS), np.kron(one, np.eye(_OUTPUTS)))
    true = np.diagonal(coefficients @ noise @ coefficients.T)
    columns = [np.array(part) for part in coefficients.T.reshape(_TRIALS, _SAMPLES, _OUTPUTS, -1)]
    rng, shares = np.random.default_rng(5), []
    for _ in range(_DRAWS):
        residual = fitted.without(_noise(rng, root).reshape(-1, 1))
        trials = list(residual.reshape(_TRIALS, _SAMPLES, _OUTPUTS))
        kinds = (
            long_run_covariance.residual_noise(trials, fitted),
            long_run_covariance.residual_noise(trials),
            long_run_covariance.white_noise(trials, fitted),
        )
        shares.append(
            [
                np.mean(np.diagonal(long_run_covariance.spread_of_sum(kind, columns)) / true)
                for kind in kinds
            ]
        )
    given_back, bare, white = np.mean(shares, axis=0)
    assert given_back == pytest.approx(1, abs=0.04)
    assert bare < short
    assert root > 0 or white == pytest.approx(1, abs=0.01)


@pytest.mark.parametrize(("samples", "lags"), [(9, 1), (9, 4), (3, 5), (60, 40)])
def test_sums_over_lags_are_those_of_the_whole_covariance_matrix(samples: int, lags: int) -> None:
    """Two outputs with asymmetric cross-covariances; more lags than samples; many lags."""
    rng = np.random.default_rng(samples + lags)
    columns = rng.standard_normal((samples, 2, 3))
    gammas = rng.standard_normal((lags, 2, 2))
    gammas[0] += gammas[0].T
    whole = np.zeros((samples, 2, samples, 2))
    for t, s in np.ndindex(samples, samples):
        if abs(t - s) < lags:
            whole[t, :, s, :] = gammas[t - s] if t >= s else gammas[s - t].T
    flat = columns.reshape(-1, 3)
    expected = flat.T @ whole.reshape(len(flat), -1) @ flat
    found = long_run_covariance.spread_of_sum(
        long_run_covariance.ResidualNoise(np.zeros(2), gammas), [columns]
    )
    np.testing.assert_allclose(found, expected, atol=1e-10)
