"""Inverse LQR: weights for a given gain, or for the nearest one."""

from __future__ import annotations

import control
import numpy as np
import pytest
import scipy.linalg
from hypothesis import given
from hypothesis import strategies as st

from impc.arrays import Array
from impc.inverse.inverse_lqr import (
    _FactorSpace,
    inverse_lqr_cross_term,
    inverse_lqr_gradient,
    inverse_lqr_lmi,
)
from impc.model.plant import Plant
from impc.model.riccati import solve_lqr
from impc.model.weights import Weights, condition_number
from tests.support import draws, extrapolated_slope

EXAMPLE = Plant(control.ss([[2, -1], [1, 0.2]], [[1], [0]], np.eye(2), 0, 1.0))
NO_WEIGHTS_GAIN = np.array([[1.21183, -0.71277]])
GAIN = [[1.351294, -0.836590]]

# Priess et al. 2015, the infeasible example (T2), continuous.
PRIESS = Plant(
    control.ss(
        [[100, 0, -1], [0, 0.1, 50], [0.333, 10, 0]],
        [[-1, 0, 10], [1, 1, 0], [0.1, -20, 4]],
        np.eye(3),
        0,
    )
)
PRIESS_GAIN = np.array([[-3.47, 20.2, 49.3], [3.7, 0.0519, 0.714], [18.7, 2.21, 4.83]])


def test_lmi_of_the_published_infeasible_example_is_a_value_not_an_error() -> None:
    found = inverse_lqr_lmi(PRIESS, PRIESS_GAIN)
    assert not found.feasible
    assert found.weights is None
    assert found.gain is None
    assert found.gain_error == found.condition == np.inf
    assert "margin" in found.status


def test_lmi_of_a_gain_that_does_not_stabilise_is_infeasible() -> None:
    assert not inverse_lqr_lmi(EXAMPLE, [[0.0, 0.0]]).feasible


@pytest.mark.parametrize("samples", [1, 2, 3])
def test_lmi_of_no_gain_on_a_delay_is_feasible(samples: int) -> None:
    """A delay alone is stable: any weights have the gain 0, to rounding."""
    delay = Plant(control.ss(np.eye(samples, k=1), np.eye(samples)[:, -1:], np.eye(samples), 0, 1))
    found = inverse_lqr_lmi(delay, np.zeros((1, samples)))
    assert found.feasible
    assert found.gain_error < 1e-12


def test_lmi_branches_on_the_two_gains_of_the_example() -> None:
    assert not inverse_lqr_lmi(EXAMPLE, NO_WEIGHTS_GAIN).feasible
    found = inverse_lqr_lmi(EXAMPLE, GAIN)
    assert found.feasible
    assert found.condition == pytest.approx(3.2588, abs=5e-5)
    assert found.weights is not None
    assert condition_number(found.weights) == pytest.approx(found.condition)


def test_cross_term_of_the_published_example() -> None:
    found = inverse_lqr_cross_term(PRIESS, PRIESS_GAIN)
    assert found.norm == pytest.approx(39.5, abs=0.05)
    # The minimum is flat: both iterates agree only this far.
    Q = [[2.8112, -6.8124, -48.058], [-6.8124, 296.92, 5.928], [-48.058, 5.928, 1553.76]]
    R = [[1.0076, -1.4953, 0.2777], [-1.4953, 380.39, -75.36], [0.2777, -75.36, 16.19]]
    np.testing.assert_allclose(found.Q, Q, rtol=0.03)
    np.testing.assert_allclose(found.R, R, rtol=0.003)


@pytest.mark.parametrize(("plant", "gain"), [(PRIESS, PRIESS_GAIN), (EXAMPLE, NO_WEIGHTS_GAIN)])
def test_cross_term_weights_have_exactly_the_gain(plant: Plant, gain: Array) -> None:
    found = inverse_lqr_cross_term(plant, gain)
    joint = np.block([[found.Q, found.S], [found.S.T, found.R]])
    assert np.linalg.eigvalsh(joint)[0] > -1e-7 * np.linalg.norm(joint)
    assert np.linalg.eigvalsh(found.R)[0] > 1 - 1e-6
    # Independent check by scipy's Riccati solver with a cross term.
    if plant.discrete:
        P = scipy.linalg.solve_discrete_are(plant.A, plant.B, found.Q, found.R, s=found.S)
        right, left = plant.B.T @ P @ plant.A + found.S.T, found.R + plant.B.T @ P @ plant.B
    else:
        P = scipy.linalg.solve_continuous_are(plant.A, plant.B, found.Q, found.R, s=found.S)
        right, left = plant.B.T @ P + found.S.T, found.R
    K = np.linalg.solve(left, right)
    assert np.linalg.norm(K - gain) < 1e-4 * np.linalg.norm(gain)


def test_cross_term_vanishes_for_a_gain_that_weights_have() -> None:
    assert inverse_lqr_cross_term(EXAMPLE, GAIN).norm < 1e-8


def test_gradient_approaches_the_infimum_of_the_published_example_from_above() -> None:
    errors, conditions = [], []
    for evaluations in (30, 100, 300):
        found = inverse_lqr_gradient(PRIESS, PRIESS_GAIN, max_evaluations=evaluations)
        assert found.evaluations <= evaluations
        assert not found.feasible
        errors.append(found.gain_error)
        conditions.append(found.condition)
    assert errors[0] > errors[1] > errors[2] > 1.2109
    assert errors[2] < 1.25
    assert conditions[2] > 1e6


def test_gradient_of_the_example_tends_to_a_singular_Q() -> None:
    found = inverse_lqr_gradient(EXAMPLE, NO_WEIGHTS_GAIN)
    assert found.gain_error == pytest.approx(0.0754, abs=5e-5)
    assert found.weights is not None
    np.testing.assert_allclose(found.weights.Q, [[0.1165, 0.1398], [0.1398, 0.1677]], atol=1e-4)
    assert found.condition > 5e5


def test_gradient_finds_a_gain_that_weights_have() -> None:
    for start in (None, Weights(np.diag([5.0, 0.1]), 2.0)):
        found = inverse_lqr_gradient(EXAMPLE, GAIN, start)
        assert found.feasible
        assert found.gain_error < 1e-10


def test_gradient_starts_from_the_identity_for_a_gain_that_does_not_stabilise() -> None:
    found = inverse_lqr_gradient(EXAMPLE, [[0.5, -0.2]])
    assert found.weights is not None
    identity = solve_lqr(EXAMPLE, Weights(np.eye(2), 1.0)).K
    assert found.gain_error < np.linalg.norm(identity - [[0.5, -0.2]])


def test_gradient_on_the_seat_plant_comes_near_a_gain_that_no_weights_have() -> None:
    from plants.seated_balance import seated_balance_plant  # noqa: PLC0415  # CasADi, for one test

    plant = Plant(seated_balance_plant(), controls=["command"])
    Q = 1e-2 * np.eye(10)
    Q[:4, :4] = np.diag([3e5, 3e5, 3e4, 3e4])
    exact = solve_lqr(plant, Weights(Q, 1.0)).K
    rng = np.random.default_rng(1)
    for gain, error in ((exact, 1e-9), (exact * (1 + 0.02 * rng.normal(size=(1, 10))), 1e-3)):
        found = inverse_lqr_gradient(plant, gain, max_evaluations=60)
        assert found.gain_error < error * np.linalg.norm(gain)


@pytest.mark.parametrize(
    ("seed", "n", "m", "dt"),
    [
        # Gain 256 from a P of condition 1e5: differences over 2e-5 err by 2e-4.
        (1675, 3, 1, 0.0),
        (3, 4, 3, 1.0),
    ],
)
def test_gradient_agrees_with_differences(seed: int, n: int, m: int, dt: float) -> None:
    require_gradient(seed, n, m, dt)


@draws(6)
@given(
    seed=st.integers(0, 2**32 - 1),
    n=st.integers(1, 4),
    m=st.integers(1, 3),
    dt=st.sampled_from([0, 1.0]),
)
def test_gradient_agrees_with_finite_differences(seed: int, n: int, m: int, dt: float) -> None:
    require_gradient(seed, n, m, dt)


def require_gradient(seed: int, n: int, m: int, dt: float) -> None:
    """Derivative of the gain against finite differences, to 1e-6 of its largest entry."""
    rng = np.random.default_rng(seed)
    plant = Plant(control.ss(rng.normal(size=(n, n)), rng.normal(size=(n, m)), np.eye(n), 0, dt))
    space = _FactorSpace.around(plant, Weights(np.eye(n), np.eye(m)), 1e-3)
    at = space.start + 0.1 * rng.normal(size=space.start.shape)

    def gain(parameters: Array) -> Array:
        solution = space.solution(parameters)
        assert solution is not None
        return solution.K.ravel()

    jacobian = space.jacobian(at)
    size = max(1.0, float(np.max(np.abs(jacobian))))
    for index, direction in enumerate(np.eye(len(at))):
        slope = extrapolated_slope(lambda step, along=direction: gain(at + step * along))  # type: ignore[misc]
        np.testing.assert_allclose(jacobian[:, index], slope, atol=1e-6 * size)
