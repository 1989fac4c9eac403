"""The named example: poles, and the gain that the reference reports."""

from __future__ import annotations

import numpy as np
import scipy.linalg

import plants


def test_poles_gain_and_riccati_solution_are_those_of_the_reference() -> None:
    plant = plants.yalmip_example()
    np.testing.assert_allclose(
        sorted(np.linalg.eigvals(plant.A), key=np.imag), [1.1 - 0.43589j, 1.1 + 0.43589j], atol=1e-5
    )
    P = scipy.linalg.solve_discrete_are(plant.A, plant.B, np.eye(2), np.eye(1))
    K = np.linalg.solve(1 + plant.B.T @ P @ plant.B, plant.B.T @ P @ plant.A)
    np.testing.assert_allclose(K, [[1.49383, -0.88111]], atol=5e-6)
    np.testing.assert_allclose(P, [[5.36016, -1.21933], [-1.21933, 1.98969]], atol=5e-6)
