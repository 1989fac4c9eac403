"""Dual bounds of semidefinite programs hold at any solver accuracy."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

import impc
from impc.inverse.semidefinite import matrix_inequality, norm_bound, solve_each, solve_semidefinite
from tests.support import random_weights


@pytest.mark.parametrize("tolerance", [0.3, 1e-2, 1e-4, 1e-6, 1e-9])
def test_a_bound_is_never_above_the_largest_eigenvalue(tolerance: float) -> None:
    """min s with s I >= M is the largest eigenvalue."""
    rng = np.random.default_rng(4)
    for size in (1, 2, 5, 9):
        for scale in (1e-3, 1.0, 1e3):
            M = scale * random_weights(rng, size)
            truth = float(np.linalg.eigvalsh(M)[-1])
            cone = matrix_inequality(-M, np.eye(size)[None])
            reach = np.array([10 * truth])
            found = solve_semidefinite(np.ones(1), [cone], reach=reach, tolerance=tolerance)
            assert found.bound <= truth * (1 + 1e-14)
            assert found.bound >= truth - 30 * tolerance * max(1.0, truth)


def test_a_bound_with_a_norm_is_never_above_the_distance() -> None:
    """min s with ||a + V'y|| <= s is the distance of a to a subspace (least squares)."""
    rng = np.random.default_rng(5)
    for tolerance in (1e-1, 1e-4, 1e-8):
        V, a = rng.normal(size=(3, 8)), rng.normal(size=8)
        best = np.linalg.lstsq(V.T, -a)[0]
        truth = float(np.linalg.norm(a + V.T @ best))
        cone = norm_bound(np.vstack([V, np.zeros((1, 8))]), np.eye(4)[3], offset=a)
        found = solve_semidefinite(
            np.eye(4)[3], [cone], reach=np.full(4, 10.0), tolerance=tolerance
        )
        assert found.bound <= truth * (1 + 1e-14)
        assert found.bound >= truth - 100 * tolerance


def test_each_objective_over_the_same_cone_has_its_own_end() -> None:
    """min c'y over the disc |y| <= 1 is -|c| for each of several objectives."""
    rng = np.random.default_rng(6)
    basis = np.array([[[1.0, 0.0], [0.0, -1.0]], [[0.0, 1.0], [1.0, 0.0]]])
    cone = matrix_inequality(np.eye(2), basis)
    objectives = rng.normal(size=(20, 2)) * 10 ** rng.uniform(-3, 1, size=(20, 1))
    sizes = np.linalg.norm(objectives, axis=1)
    found = solve_each(objectives, [cone], reach=np.full(2, 2.0))
    for objective, size, one in zip(objectives, sizes, found, strict=True):
        np.testing.assert_allclose(one.y, -objective / size, atol=2e-5)
        assert -size * (1 + 1e-8) <= one.bound <= -size * (1 - 1e-14)


def test_a_solver_that_breaks_off_is_an_error_of_ours(monkeypatch: pytest.MonkeyPatch) -> None:
    """A Rust panic becomes a SolverError; other non-Exceptions, such as an interrupt, pass."""

    def broken(kind: type[BaseException]) -> Callable[..., None]:
        def solver(*_: object) -> None:
            raise kind("Eigval error: Eigen(1)")

        return solver

    cone = matrix_inequality(np.eye(2), np.eye(2)[None])
    panic = type("PanicException", (BaseException,), {})
    monkeypatch.setattr("clarabel.DefaultSolver", broken(panic))
    with pytest.raises(impc.SolverError, match="Clarabel: Eigval error"):
        solve_semidefinite(np.ones(1), [cone])
    monkeypatch.setattr("clarabel.DefaultSolver", broken(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        solve_semidefinite(np.ones(1), [cone])
