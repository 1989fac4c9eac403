"""Bounds of semidefinite programs are proofs, however early the solver stops."""

from __future__ import annotations

import clarabel
import numpy as np
import pytest

from impc.errors import SolverError
from impc.inverse.semidefinite import matrix_inequality, norm_bound, solve_semidefinite
from tests.support import random_weights


@pytest.mark.parametrize("tolerance", [0.3, 1e-2, 1e-4, 1e-6, 1e-9])
def test_a_bound_is_never_above_the_largest_eigenvalue(tolerance: float) -> None:
    """min s with s I >= M is the largest eigenvalue, which LAPACK knows."""
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
    """min s with ||a + V'y|| <= s is the distance of a to a space, by least squares."""
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


def test_a_panic_inside_the_solver_is_an_error_of_ours(monkeypatch: pytest.MonkeyPatch) -> None:
    """As of an eigenvalue decomposition that fails; an interrupt stays what it is."""

    class PanicException(BaseException):
        pass

    def solver_that_raises(error: BaseException) -> type:
        class Solver:
            def __init__(self, *_: object) -> None:
                pass

            def solve(self) -> None:
                raise error

        return Solver

    cone = norm_bound(np.eye(1), np.zeros(1), constant=1.0)
    monkeypatch.setattr(clarabel, "DefaultSolver", solver_that_raises(PanicException("Eigval")))
    with pytest.raises(SolverError, match="Clarabel broke off"):
        solve_semidefinite(np.ones(1), [cone])
    monkeypatch.setattr(clarabel, "DefaultSolver", solver_that_raises(KeyboardInterrupt()))
    with pytest.raises(KeyboardInterrupt):
        solve_semidefinite(np.ones(1), [cone])
