"""The auxiliary problem (3.7) against a derivative-free search."""

from __future__ import annotations

import numpy as np
import pytest

from experiments.certificates import weights_from_parameters
from impc.inverse.proximal_search import AUXILIARY_CONDITION_WEIGHT, auxiliary_weights
from impc.model.plant import Plant
from impc.model.riccati import solve_lqr
from impc.model.weights import Weights, condition_number
from tests.support import nelder_mead, random_plant, random_weights

IDENTITY = Weights(np.eye(2), 1)


def auxiliary_objective(plant: Plant, gain: np.ndarray, weights: Weights) -> float:
    distance = np.linalg.norm(solve_lqr(plant, weights).K - gain)
    return float(distance + AUXILIARY_CONDITION_WEIGHT * condition_number(weights))


def test_auxiliary_problem_reaches_what_a_derivative_free_search_reaches(
    example_plant: Plant,
) -> None:
    gain = np.array([[1.21183, -0.71277]])
    found = auxiliary_weights(example_plant, gain, IDENTITY)
    best = auxiliary_objective(example_plant, gain, found.weights)
    assert found.objective == pytest.approx(best, rel=1e-9)
    # Q_0 of the reference (section 3, case A) by Nelder-Mead, in its own scaling of the weights.
    assert best <= auxiliary_objective(
        example_plant, gain, Weights([[0.1901, 0.0716], [0.0716, 0.2163]], 1)
    )
    for seed in range(3):
        start = np.random.default_rng(seed).normal(size=3)
        search = nelder_mead(
            lambda z: auxiliary_objective(example_plant, gain, weights_from_parameters(z, 2, 1)),
            start,
            2000,
        )
        assert best <= search + 1e-9


def test_a_metric_is_come_near_too() -> None:
    """Without penalty on conditioning, known weights are recovered from gain and metric."""
    rng = np.random.default_rng(3)
    plant = random_plant(rng, 3, 2, 0.9)
    truth = solve_lqr(plant, Weights(random_weights(rng, 3), random_weights(rng, 2)))
    found = auxiliary_weights(
        plant, np.array(truth.K), None, metric=5 * np.array(truth.S), condition_weight=1e-9
    ).solution
    np.testing.assert_allclose(found.K, truth.K, atol=1e-6)
    np.testing.assert_allclose(
        np.array(found.S) / np.trace(found.S), np.array(truth.S) / np.trace(truth.S), atol=1e-6
    )
