"""Inverse LQR: weights for a given gain, or for the nearest one."""

from __future__ import annotations

import control
import numpy as np
import pytest

import impc
from experiments.benchmarks.workloads import seat
from experiments.certificates import weights_from_parameters
from impc.arrays import Array
from impc.inverse.inverse_lqr import inverse_lqr_cross_term
from impc.inverse.proximal_search import AUXILIARY_CONDITION_WEIGHT, auxiliary_weights
from impc.model.weights import condition_number
from tests.inverse.test_equivalent_weights import GAIN, NO_WEIGHTS_GAIN
from tests.support import (
    example_plant,
    nelder_mead,
    plant_of,
)

EXAMPLE, NONE = example_plant(), np.array(NO_WEIGHTS_GAIN)

# Priess et al. 2015, the infeasible example (T2), continuous.
PRIESS = plant_of(
    [[100, 0, -1], [0, 0.1, 50], [0.333, 10, 0]], [[-1, 0, 10], [1, 1, 0], [0.1, -20, 4]], dt=0
)
PRIESS_GAIN = np.array([[-3.47, 20.2, 49.3], [3.7, 0.0519, 0.714], [18.7, 2.21, 4.83]])


@pytest.mark.parametrize(
    ("plant", "gain"),
    # The published example, a gain that no weights have, and one that does not stabilise.
    [(PRIESS, PRIESS_GAIN), (EXAMPLE, NONE), (EXAMPLE, np.zeros((1, 2)))],
)
def test_lmi_without_weights_is_a_value_not_an_error(plant: impc.Plant, gain: Array) -> None:
    found = impc.inverse_lqr_lmi(plant, gain)
    assert not found.feasible
    assert found.weights is None
    assert found.gain is None
    assert found.gain_error == found.condition == np.inf
    assert ("margin" in found.status) == bool(np.any(gain))


@pytest.mark.parametrize("samples", [1, 2, 3])
def test_lmi_of_no_gain_on_a_delay_is_feasible(samples: int) -> None:
    """A delay alone is stable: any weights have the gain 0, to rounding."""
    delay = plant_of(np.eye(samples, k=1), np.eye(samples)[:, -1:])
    found = impc.inverse_lqr_lmi(delay, np.zeros((1, samples)))
    assert found.feasible
    assert found.gain_error < 1e-12


@pytest.mark.parametrize("start", [None, impc.Weights(np.diag([5.0, 0.1]), 2.0)])
def test_a_gain_that_weights_have_is_found_without_the_lmi(start: impc.Weights | None) -> None:
    assert inverse_lqr_cross_term(EXAMPLE, GAIN).norm < 1e-8
    found = impc.inverse_lqr_gradient(EXAMPLE, GAIN, start)
    assert found.feasible
    assert found.gain_error < 1e-10


@pytest.mark.parametrize(("plant", "gain"), [(PRIESS, PRIESS_GAIN), (EXAMPLE, NONE)])
def test_cross_term_weights_have_exactly_the_gain(plant: impc.Plant, gain: Array) -> None:
    """By python-control's regulators with a cross term; and the published solution."""
    found = inverse_lqr_cross_term(plant, gain)
    joint = np.block([[found.Q, found.S], [found.S.T, found.R]])
    assert np.linalg.eigvalsh(joint)[0] > -1e-7 * np.linalg.norm(joint)
    assert np.linalg.eigvalsh(found.R)[0] > 1 - 1e-6
    solve = control.dlqr if plant.discrete else control.lqr
    again, *_ = solve(plant.A, plant.B, found.Q, found.R, found.S)
    assert np.linalg.norm(again - gain) < 1e-4 * np.linalg.norm(gain)
    if plant is PRIESS:
        assert found.norm == pytest.approx(39.5, abs=0.05)
        # The minimum is flat: both iterates agree only this far.
        Q = [[2.8112, -6.8124, -48.058], [-6.8124, 296.92, 5.928], [-48.058, 5.928, 1553.76]]
        R = [[1.0076, -1.4953, 0.2777], [-1.4953, 380.39, -75.36], [0.2777, -75.36, 16.19]]
        np.testing.assert_allclose(found.Q, Q, rtol=0.03)
        np.testing.assert_allclose(found.R, R, rtol=0.003)


def test_gradient_approaches_the_infimum_of_the_published_example_from_above() -> None:
    errors, conditions = [], []
    for evaluations in (30, 100, 300):
        found = impc.inverse_lqr_gradient(PRIESS, PRIESS_GAIN, max_evaluations=evaluations)
        assert found.evaluations <= evaluations
        assert not found.feasible
        errors.append(found.gain_error)
        conditions.append(found.condition)
    assert errors[0] > errors[1] > errors[2] > 1.2109
    assert errors[2] < 1.25
    assert conditions[2] > 1e6


def test_gradient_of_the_example_tends_to_a_singular_Q() -> None:
    found = impc.inverse_lqr_gradient(EXAMPLE, NONE)
    assert found.gain_error == pytest.approx(0.0754, abs=5e-5)
    assert found.weights is not None
    np.testing.assert_allclose(found.weights.Q, [[0.1165, 0.1398], [0.1398, 0.1677]], atol=1e-4)
    assert found.condition > 5e5


def test_gradient_starts_from_the_identity_for_a_gain_that_does_not_stabilise() -> None:
    found = impc.inverse_lqr_gradient(EXAMPLE, [[0.5, -0.2]])
    assert found.weights is not None
    identity = impc.solve_lqr(EXAMPLE, impc.Weights(np.eye(2), 1.0)).K
    assert found.gain_error < np.linalg.norm(identity - [[0.5, -0.2]])


def test_gradient_on_the_seat_plant_comes_near_a_gain_that_no_weights_have() -> None:
    plant, Q = seat(1, 1.0).problem.plant, 1e-2 * np.eye(10)
    Q[:4, :4] = np.diag([3e5, 3e5, 3e4, 3e4])
    exact = impc.solve_lqr(plant, impc.Weights(Q, 1.0)).K
    rng = np.random.default_rng(1)
    for gain, error in ((exact, 1e-9), (exact * (1 + 0.02 * rng.normal(size=(1, 10))), 1e-3)):
        found = impc.inverse_lqr_gradient(plant, gain, max_evaluations=60)
        assert found.gain_error < error * np.linalg.norm(gain)


def auxiliary_objective(weights: impc.Weights) -> float:
    distance = np.linalg.norm(impc.solve_lqr(EXAMPLE, weights).K - NONE)
    return float(distance + AUXILIARY_CONDITION_WEIGHT * condition_number(weights))


def test_auxiliary_problem_reaches_what_a_derivative_free_search_reaches() -> None:
    found = auxiliary_weights(EXAMPLE, NONE, impc.Weights(np.eye(2), 1))
    best = auxiliary_objective(found.weights)
    assert found.objective == pytest.approx(best, rel=1e-9)
    # Q_0 of the reference (section 3, case A) by Nelder-Mead, in its own scaling of the weights.
    assert best <= auxiliary_objective(impc.Weights([[0.1901, 0.0716], [0.0716, 0.2163]], 1))
    for seed in range(3):
        start = np.random.default_rng(seed).normal(size=3)
        search = nelder_mead(
            lambda z: auxiliary_objective(weights_from_parameters(z, 2, 1)), start, 2000
        )
        assert best <= search + 1e-9
