"""The stationary filter against SciPy's Riccati solver, its derivatives against differences."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg

from impc.errors import SolverError
from impc.output_feedback.kalman import filter_changes, stationary_filter
from tests.support import extrapolated_slope, random_weights


@pytest.mark.parametrize("radius", [0.7, 0.99, 1.3])
def test_it_is_the_riccati_solution_of_scipy(radius: float) -> None:
    rng = np.random.default_rng([1, round(100 * radius)])
    for n, p in ((1, 1), (4, 2), (9, 3)):
        F = rng.normal(size=(n, n))
        F *= radius / np.max(np.abs(np.linalg.eigvals(F)))
        C, Q, R = rng.normal(size=(p, n)), random_weights(rng, n), random_weights(rng, p)
        found = stationary_filter(F, C, Q, R)
        expected = scipy.linalg.solve_discrete_are(F.T, C.T, Q, R)
        # Both are off by rounding: at most 1e-12 here.
        np.testing.assert_allclose(found.P, expected, rtol=0, atol=1e-10 * np.max(expected))
        np.testing.assert_allclose(found.S, C @ found.P @ C.T + R, rtol=1e-12)


def test_units_of_states_do_not_disturb_it() -> None:
    rng = np.random.default_rng(2)
    F, C = rng.normal(size=(4, 4)) / 3, rng.normal(size=(2, 4))
    Q, R = random_weights(rng, 4), random_weights(rng, 2)
    unit = np.diag([1e-6, 1.0, 1e4, 1e-3])
    plain = stationary_filter(F, C, Q, R)
    scaled = stationary_filter(
        unit @ F @ np.linalg.inv(unit), C @ np.linalg.inv(unit), unit @ Q @ unit, R
    )
    np.testing.assert_allclose(np.linalg.inv(unit) @ scaled.L, plain.L, rtol=0, atol=1e-11)


def test_derivatives_equal_differences() -> None:
    rng = np.random.default_rng(3)
    F, C = rng.normal(size=(4, 4)) / 2, rng.normal(size=(2, 4))
    Q, R = random_weights(rng, 4), random_weights(rng, 2)
    dF, dC = rng.normal(size=(1, 4, 4)), rng.normal(size=(1, 2, 4))
    dQ, dR = random_weights(rng, 4)[None], random_weights(rng, 2)[None]
    found = filter_changes(stationary_filter(F, C, Q, R), (F, C), dF, dC, dQ, dR)

    def at(step: float) -> np.ndarray:
        parts = stationary_filter(F + step * dF[0], C + step * dC[0], Q + step * dQ[0],
                                  R + step * dR[0])  # fmt: skip
        return np.concatenate([np.ravel(part) for part in parts])

    exact = np.concatenate([np.ravel(part) for part in found])
    slope = extrapolated_slope(at, 1e-3)
    np.testing.assert_allclose(exact, slope, rtol=0, atol=1e-8 * np.max(np.abs(slope)))


def test_what_is_not_seen_and_does_not_decay_has_no_filter() -> None:
    F = np.diag([1.2, 0.5])
    with pytest.raises(SolverError, match="no stationary Kalman filter"):
        stationary_filter(F, np.array([[0.0, 1.0]]), np.eye(2), np.eye(1))
    # Observed but without process noise: the filter that never forgets is not stable.
    with pytest.raises(SolverError, match="no stationary Kalman filter"):
        stationary_filter(F, np.eye(2), np.zeros((2, 2)), np.eye(2))


def test_senses_that_cannot_be_told_apart_have_no_filter() -> None:
    """Two almost equal signals with almost no noise: their covariance is singular."""
    F, C = np.array([[1.0, 0.1], [0.0, 1.0]]), np.array([[1.0, 0.0], [1.0, 1e-12]])
    with pytest.raises(SolverError, match="no stationary Kalman filter"):
        stationary_filter(F, C, np.eye(2), 1e-40 * np.eye(2))
