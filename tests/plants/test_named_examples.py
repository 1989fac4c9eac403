"""The named examples: matrices, names, poles, and the gains that the reference reports."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import scipy.linalg

import plants

CASES = [
    # function, poles (descending modulus), rank of the controllability matrix, outputs
    (plants.yalmip_example, [1.1 + 0.43589j, 1.1 - 0.43589j], 2, ["x1", "x2"]),
    (plants.bbm_example, [2.0, 0.5], 1, ["x1", "x2"]),
    (plants.cannon_example, [1.1, 0.95], 2, ["y"]),
    (plants.unstable_integrator_example, [1.2, 1.0], 2, ["x1", "x2"]),
]


@pytest.mark.parametrize(("make", "poles", "rank", "outputs"), CASES)
def test_poles_names_and_controllability(
    make: Callable[[], Any], poles: list[complex], rank: int, outputs: list[str]
) -> None:
    plant = make()
    found = sorted(np.linalg.eigvals(plant.A), key=lambda pole: (-abs(pole), -pole.imag))
    np.testing.assert_allclose(found, poles, atol=1e-5)
    assert np.linalg.matrix_rank(np.hstack([plant.B, plant.A @ plant.B])) == rank
    assert plant.dt == 1.0
    assert plant.state_labels == ["x1", "x2"]
    assert plant.input_labels == ["u"]
    assert plant.output_labels == outputs
    assert plant.C.shape == (len(outputs), 2)
    assert not np.any(plant.D)
    assert make.__doc__ is not None
    for word in ("Source", "Confidence", "available"):
        assert word in make.__doc__


def test_yalmip_gain_and_riccati_solution_are_those_of_the_reference() -> None:
    plant = plants.yalmip_example()
    P = scipy.linalg.solve_discrete_are(plant.A, plant.B, np.eye(2), np.eye(1))
    K = np.linalg.solve(1 + plant.B.T @ P @ plant.B, plant.B.T @ P @ plant.A)
    np.testing.assert_allclose(K, [[1.49383, -0.88111]], atol=5e-6)
    np.testing.assert_allclose(P, [[5.36016, -1.21933], [-1.21933, 1.98969]], atol=5e-6)
