"""Unknowns of single trials are eliminated: the same search as with all columns side by side."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import scipy.optimize

from impc.inverse.arrow import ArrowRows, Prior, Tolerances, arrow_least_squares
from impc.inverse.trial_span import trial_span

TRIALS, ROWS, SHARED, OWN = 30, 9, 3, 2


def curved(seed: int, singular: bool = False):  # type: ignore[no-untyped-def]
    """r_i = sin(A_i u + B_i v_i) - c_i, with its derivative; with `singular` u_2 is not seen."""
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((TRIALS, ROWS, SHARED))
    B = rng.standard_normal((TRIALS, ROWS, OWN))
    c = 0.5 * rng.standard_normal((TRIALS, ROWS))
    if singular:
        A[..., -1] = 0

    def rows(u: np.ndarray, v: np.ndarray) -> ArrowRows:
        angle = A @ u + np.einsum("twn,tn->tw", B, v)
        slope = np.cos(angle)[..., None]
        return ArrowRows(np.sin(angle) - c, slope * A, slope * B)

    return rows


def dense(rows, prior: Prior):  # type: ignore[no-untyped-def]
    """Residual and derivative with every column beside every other."""
    weights = np.concatenate([prior.shared, np.full(TRIALS * OWN, prior.own)])
    middle = np.concatenate([prior.u, prior.v.ravel()])

    def split(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return z[:SHARED], z[SHARED:].reshape(TRIALS, OWN)

    def residual(z: np.ndarray) -> np.ndarray:
        return np.concatenate([rows(*split(z)).residual.ravel(), weights * (z - middle)])

    def derivative(z: np.ndarray) -> np.ndarray:
        found, wide = rows(*split(z)), np.zeros((TRIALS, ROWS, TRIALS, OWN))
        for index in range(TRIALS):
            wide[index, :, index] = found.own[index]
        flat = np.hstack([found.shared.reshape(-1, SHARED), wide.reshape(-1, TRIALS * OWN)])
        return np.vstack([flat, np.diag(weights)])

    return residual, derivative


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("weight", [0.0, 0.3])
def test_the_search_is_that_of_scipy(seed: int, weight: float) -> None:
    """From a start far off: where it ends, and after as many steps."""
    rng = np.random.default_rng(100 + seed)
    rows, u, v = curved(seed), rng.standard_normal(SHARED), rng.standard_normal((TRIALS, OWN))
    prior = Prior(u, v, np.full(SHARED, weight), weight)
    residual, derivative = dense(rows, prior)
    ends: dict[str, Any] = {"ftol": 1e-12, "xtol": 1e-12, "gtol": 1e-13}
    expected = scipy.optimize.least_squares(
        residual, np.concatenate([u, v.ravel()]), jac=derivative, max_nfev=200, **ends
    )
    found_u, found_v, spent = arrow_least_squares(
        rows, prior, u, v, Tolerances(**ends, max_nfev=200)
    )
    found = np.concatenate([found_u, found_v.ravel()])
    # Both are converged to 1e-7 or so: a step of ftol 1e-12 changes z by its root at most.
    np.testing.assert_allclose(found, expected.x, atol=1e-5)
    assert np.sum(residual(found) ** 2) / 2 == pytest.approx(expected.cost, rel=1e-10)
    assert abs(spent - expected.nfev) <= 2


def test_what_is_not_seen_stays() -> None:
    """A column of zeros, no prior: as scipy, and nothing divides by zero."""
    rows, prior = (
        curved(0, singular=True),
        Prior(np.zeros(3), np.zeros((TRIALS, 2)), np.zeros(3), 0),
    )
    residual, derivative = dense(rows, prior)
    start = np.full(SHARED, 0.1), np.full((TRIALS, OWN), 0.1)
    z = np.concatenate([start[0], start[1].ravel()])
    expected = scipy.optimize.least_squares(residual, z, jac=derivative, max_nfev=100)
    u, v, _ = arrow_least_squares(rows, prior, *start, Tolerances(1e-8, 1e-8, 1e-8, 100))
    assert u[-1] == pytest.approx(0.1)
    cost = np.sum(residual(np.concatenate([u, v.ravel()])) ** 2) / 2
    assert cost == pytest.approx(expected.cost, rel=1e-6)


def test_a_span_of_trials_is_that_of_all_columns() -> None:
    """Against one singular value decomposition, with a column that the others explain."""
    rng, sizes = np.random.default_rng(0), [20, 30, 25]
    own, shared = rng.standard_normal((75, 3)), rng.standard_normal((75, 3))
    own[20:50, 2] = own[20:50, 0]
    wide = np.zeros((75, 9))
    for index, (first, last) in enumerate(((0, 20), (20, 50), (50, 75))):
        wide[first:last, 3 * index : 3 * index + 3] = own[first:last]
    shared[:, 2] = wide @ rng.standard_normal(9)
    left, values, _ = np.linalg.svd(np.hstack([wide, shared]), full_matrices=False)
    left = left[:, values > 1e-10 * values[0]]
    columns = rng.standard_normal((75, 4))
    found = trial_span(own, sizes, shared)
    assert sum(basis.shape[1] for basis in (*found.own, found.shared)) == left.shape[1] == 10
    np.testing.assert_allclose(
        found.without(columns), columns - left @ (left.T @ columns), atol=1e-12
    )
