"""Riccati, gain and their derivatives, against python-control, scipy and central differences."""

from __future__ import annotations

import control
import numpy as np
import pytest
import scipy.linalg

import impc
from impc.model.riccati import gain_gradients, lyapunov_series, metric_gradients, regulator_changes
from tests.support import extrapolated_slope, random_plant, random_weights


def continuous_plant(rng: np.random.Generator) -> impc.Plant:
    return impc.Plant(control.ss(rng.normal(size=(3, 3)), rng.normal(size=(3, 2)), np.eye(3), 0))


@pytest.mark.parametrize("seed", range(5))
def test_gain_equals_that_of_python_control(seed: int) -> None:
    rng = np.random.default_rng(seed)
    Q, R = random_weights(rng, 4), random_weights(rng, 2)
    plant = random_plant(rng, 4, 2, 1.2)
    K, P, _ = control.dlqr(plant.A, plant.B, Q, R)
    found = impc.solve_lqr(plant, impc.Weights(Q, R))
    np.testing.assert_allclose(found.K, K, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(found.P, P, rtol=1e-9)
    smooth = continuous_plant(rng)
    Q, R = random_weights(rng, 3), random_weights(rng, 2)
    K, P, _ = control.lqr(smooth.A, smooth.B, Q, R)
    found = impc.solve_lqr(smooth, impc.Weights(Q, R))
    np.testing.assert_allclose(found.K, K, rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(found.P, P, rtol=1e-8, atol=1e-9)


def test_cost_of_any_inputs_is_distance_to_the_gain() -> None:
    """The identity of docs/why/theory.md, section 2, for random inputs."""
    rng = np.random.default_rng(1)
    plant = random_plant(rng, 3, 2, 1.3)
    weights = impc.Weights(random_weights(rng, 3), random_weights(rng, 2))
    found = impc.solve_lqr(plant, weights)
    x = rng.normal(size=3)
    first = x @ found.P @ x
    cost = distance = 0.0
    for u in rng.normal(size=(7, 2)):
        v = u + found.K @ x
        cost += x @ weights.Q @ x + u @ weights.R @ u
        distance += v @ found.S @ v
        x = plant.A @ x + plant.B @ u
    assert cost + x @ found.P @ x == pytest.approx(first + distance, rel=1e-10)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("discrete", [True, False])
def test_gradients_equal_central_differences(seed: int, discrete: bool) -> None:
    rng = np.random.default_rng(seed)
    plant = random_plant(rng, 3, 2, 1.1) if discrete else continuous_plant(rng)
    Q, R = random_weights(rng, 3), random_weights(rng, 2)
    dQ, dR = (part + part.T for part in (rng.normal(size=(3, 3)), rng.normal(size=(2, 2))))
    step = 1e-5
    up, down = (impc.solve_lqr(plant, impc.Weights(Q + s * dQ, R + s * dR)) for s in (step, -step))
    here = impc.solve_lqr(plant, impc.Weights(Q, R))
    pairs = [(gain_gradients(here), up.K - down.K)]
    if discrete:
        pairs.append((metric_gradients(here), up.S - down.S))
    for gradients, difference in pairs:
        exact = np.tensordot(gradients.Q, dQ, 2) + np.tensordot(gradients.R, dR, 2)
        np.testing.assert_allclose(
            exact, difference / (2 * step), rtol=1e-6, atol=1e-6 * np.max(np.abs(exact))
        )


def test_lyapunov_series_equals_scipy_up_to_slow_loops() -> None:
    rng = np.random.default_rng(2)
    for radius in (0.0, 0.5, 0.99, 0.99999):
        F = rng.normal(size=(5, 5))
        F *= radius / np.max(np.abs(np.linalg.eigvals(F)))
        right = random_weights(rng, 5)
        np.testing.assert_allclose(
            lyapunov_series(F, right[None])[0],
            scipy.linalg.solve_discrete_lyapunov(F, right),
            rtol=1e-9,
        )


def test_a_mode_without_weight_is_an_error() -> None:
    plant = impc.Plant(control.ss(np.diag([1.0, 0.5]), [[1], [1]], np.eye(2), 0, True))
    with pytest.raises(impc.WeightsError, match="penalise every mode"):
        impc.solve_lqr(plant, impc.Weights(np.diag([0.0, 1.0]), 1))


def test_changes_of_a_regulator_along_weights_and_plant() -> None:
    """Forward differential of gain and metric against extrapolated differences."""
    rng = np.random.default_rng(3)
    plant, weights = random_plant(rng, 4, 2, 1.2), impc.Weights(random_weights(rng, 4), np.eye(2))
    dQ, dR = random_weights(rng, 4), random_weights(rng, 2)
    dA, dB = rng.normal(size=(4, 4)), rng.normal(size=(4, 2))

    def regulator(step: float) -> np.ndarray:
        moved = control.ss(plant.A + step * dA, plant.B + step * dB, plant.C, 0, plant.dt)
        there = impc.Weights(weights.Q + step * dQ, weights.R + step * dR)
        found = impc.solve_lqr(impc.Plant(moved), there)
        return np.concatenate([found.K.ravel(), found.S.ravel()])

    found = regulator_changes(
        impc.solve_lqr(plant, weights), *(part[None] for part in (dQ, dR, dA, dB))
    )
    exact = np.concatenate([part[0].ravel() for part in found])
    # Ridders' table leaves 1e-10 here.
    np.testing.assert_allclose(exact, extrapolated_slope(regulator, 1e-3), rtol=1e-7, atol=1e-8)
