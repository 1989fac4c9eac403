"""The quadratic program inside the proximal LASSO against an interior-point solver."""

from __future__ import annotations

import cvxpy as cp
import numpy as np
import pytest

from impc.arrays import Array
from impc.studies.selection.lasso import _box_lasso


def problem(seed: int) -> tuple[Array, Array, Array, Array, float]:
    """2 to 12 parameters, columns of sizes from 0.01 to 10, some of t and typical at a bound."""
    rng = np.random.default_rng(seed)
    k = 2 + seed % 11
    J = rng.standard_normal((k + 3, k)) * 10 ** rng.uniform(-2, 1, k)
    t = np.clip(rng.uniform(-1.3, 1.3, k), -1, 1)
    typical = np.clip(rng.uniform(-1.2, 1.2, k), -1, 1)
    typical[0] = t[0]
    g = rng.standard_normal(k) * 10 ** rng.uniform(-1, 2)
    return J.T @ J + 1e-6 * np.eye(k), g, t, typical, float(10 ** rng.uniform(-6, 2))


@pytest.mark.parametrize("seed", range(60))
def test_the_quadratic_program(seed: int) -> None:
    """No worse than Clarabel's answer, inside the bounds, and exactly typical where it is."""
    H, g, t, typical, weight = problem(seed)
    x = _box_lasso(H, g, t, typical, weight)

    def objective(at: Array) -> float:
        moved = at - t
        away = float(np.sum(np.abs(at - typical)))
        return float(g @ moved + moved @ H @ moved / 2) + weight * away

    z = cp.Variable(len(t))
    moved = z - t
    quadratic = cp.sum_squares(np.linalg.cholesky(H).T @ moved) / 2
    cost = g @ moved + quadratic + weight * cp.norm1(z - typical)
    cp.Problem(cp.Minimize(cost), [z <= 1, z >= -1]).solve(solver="CLARABEL")
    assert z.value is not None
    other = np.asarray(z.value)
    reference = objective(np.clip(other, -1, 1))
    assert objective(x) <= reference + 1e-9 * (1 + abs(reference))
    assert np.all(np.abs(x) <= 1)
    near = np.abs(other - typical) < 1e-9
    np.testing.assert_array_equal(x[near], typical[near])
