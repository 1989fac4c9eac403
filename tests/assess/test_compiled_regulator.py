"""The doubled gain against the Riccati solver, and where there is none."""

from __future__ import annotations

import numpy as np
import pytest

from impc.assess.compiled_regulator import doubled_gain
from impc.model.plant import Plant
from impc.model.riccati import solve_lqr
from impc.model.weights import Weights
from plants import yalmip_example


@pytest.mark.parametrize("effort", [1e-3, 1.0, 1e3])
def test_is_the_gain_of_the_riccati_equation(effort: float) -> None:
    plant = Plant(yalmip_example())
    Q, R = np.array([[2.0, 0.5], [0.5, 1.0]]), effort * np.eye(1)
    converged, K = doubled_gain(np.array(plant.A), np.array(plant.B), Q, R, 1e-9)
    assert converged
    np.testing.assert_allclose(K, solve_lqr(plant, Weights(Q, R)).K, rtol=1e-8)


def test_tells_where_it_does_not_converge() -> None:
    A, B = np.diag([2.0, 0.5]), np.array([[0.0], [1.0]])  # what is unstable cannot be reached
    converged, K = doubled_gain(A, B, np.eye(2), np.eye(1), 1e-9)
    assert not converged
    assert not np.any(K)
