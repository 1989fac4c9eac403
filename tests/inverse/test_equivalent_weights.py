"""Equivalent weights of a gain, the choice among them, and bounds of semidefinite programs."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import control
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import impc
from experiments.benchmarks.workloads import seat
from impc.arrays import Array
from impc.inverse.equivalent_weights import SLACK, analytic_centre, inverse_factor, weights_margin
from impc.inverse.semidefinite import matrix_inequality, norm_bound, solve_semidefinite
from impc.inverse.solution_set import GainFibre
from impc.model.weights import condition_number
from tests.support import draws, example_plant, plant_of, present, random_weights

INTEGRATOR = plant_of([[1, 1], [0, 1]], [[0.5], [1]])
GAIN = [[1.351294, -0.836590]]  # of the example
NO_WEIGHTS_GAIN = [[1.21183, -0.71277]]

# Priess et al. 2015, the feasible example (T1), continuous: plant, gain, and weights.
PRIESS = plant_of(
    [[0, 1, 7, 9], [4, -8, -5, -3], [8, -7, 7, -6], [10, -5, -5, -5]],
    [[2, 2, 5, -9], [-1, 1, 5, -9], [-3, 9, -3, 1], [7, -4, 1, 6]],
    dt=0,
)
PRIESS_GAIN = [
    [2.376, -1.328, 1.188, 1.847], [4.294, -0.8621, 3.77, 1.509],
    [-2.279, 1.366, -2.067, -1.323], [-2.7, -0.06092, -2.036, -0.7217],
]  # fmt: skip
PRIESS_Q = [
    [13.6214, -1.173, 4.0657, 2.7301], [-1.173, 7.3251, 3.4964, -2.4546],
    [4.0657, 3.4964, 4.9217, 0.1421], [2.7301, -2.4546, 0.1421, 4.4088],
]  # fmt: skip
PRIESS_R = [
    [10.5486, 0.3483, 6.5105, -1.7114], [0.3483, 4.3186, 1.8088, 3.5052],
    [6.5105, 1.8088, 6.9223, -0.4818], [-1.7114, 3.5052, -0.4818, 6.5442],
]  # fmt: skip


def random_case(seed: int, n: int, m: int, dt: float) -> tuple[impc.Plant, impc.Weights]:
    rng = np.random.default_rng(seed)
    plant = plant_of(rng.normal(size=(n, n)), rng.normal(size=(n, m)), dt=dt)
    return plant, impc.Weights(random_weights(rng, n), random_weights(rng, m))


def fibre_of(plant: impc.Plant, weights: impc.Weights) -> GainFibre:
    return impc.gain_fibre(plant, impc.solve_lqr(plant, weights).K)


def rescaled(plant: impc.Plant, states: Array) -> impc.Plant:
    """The same plant with x = states @ z."""
    back = np.linalg.inv(states)
    A, B, C = back @ plant.A @ states, back @ plant.B, plant.C @ states
    return impc.Plant(control.ss(A, B, C, 0, plant.dt, inputs=plant.m))


@pytest.mark.parametrize(
    ("plant", "gain", "condition", "within", "Q", "R"),
    [
        (INTEGRATOR, [[0.434483, 1.028466]], 1.0, 7e-5, np.eye(2), 1.0),
        (INTEGRATOR, [[0.692029, 1.226288]], 4.0, 7e-5, np.diag([4.0, 1.0]), 1.0),
        (example_plant(), GAIN, 3.25881, 5e-6, [[1.32597, 0.39116], [0.39116, 1.46938]], 3.25881),
        (PRIESS, PRIESS_GAIN, 15.84287, 5e-6, PRIESS_Q, PRIESS_R),
    ],
)
def test_least_condition_of_published_examples(
    plant: impc.Plant, gain: Any, condition: float, within: float, Q: Any, R: Any
) -> None:
    found = impc.least_condition_weights(impc.gain_fibre(plant, gain))
    assert found.least is not None
    assert found.least == pytest.approx(condition, abs=within)  # the gains are rounded
    assert found.least * (1 - 1e-14) <= found.condition <= found.least * (1 + 2 * SLACK)
    assert found.gain_error < (1e-14 if plant.discrete else 1e-11)
    assert present(found.gap) < 1e-8
    lmi = impc.inverse_lqr_lmi(plant, gain)
    assert lmi.feasible
    assert lmi.condition == pytest.approx(found.condition)
    # Largest eigenvalues: the reference is within 1e-5 of the least condition; here the least norm.
    size = np.sqrt(SLACK) * (condition / 5 if plant.discrete else 15)
    scaled, n = found.weights.block / np.linalg.eigvalsh(found.weights.block)[0], plant.n
    np.testing.assert_allclose(scaled[:n, :n], Q, atol=size)
    np.testing.assert_allclose(scaled[n:, n:], R, atol=size)


def test_least_condition_and_centre_agree_with_a_fine_grid_over_the_fibre() -> None:
    fibre = impc.gain_fibre(example_plant(), GAIN)
    angles = np.linspace(0, np.pi, 200_001)
    coordinates = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    Q, R = np.tensordot(coordinates, fibre.Q, 1), np.tensordot(coordinates, fibre.R, 1)
    values = np.concatenate([np.linalg.eigvalsh(Q), R[:, :, 0]], axis=1) * np.sign(R[:, 0])
    least, largest = values.min(axis=1), values.max(axis=1)
    conditions = np.where(least > 0, largest / np.maximum(least, 1e-300), np.inf)
    found = impc.least_condition_weights(fibre)
    assert found.least is not None
    assert found.least <= conditions.min()
    assert found.least == pytest.approx(conditions.min(), rel=1e-4)
    volumes = np.where(least > 0, np.linalg.det(Q) / R[:, 0, 0] ** 2, 0.0)
    best = Q[np.argmax(volumes)] / R[np.argmax(volumes)]
    np.testing.assert_allclose(analytic_centre(fibre).weights.Q, best, rtol=1e-3)


@pytest.mark.parametrize("dt", [0, 1.0])
@pytest.mark.parametrize("m", [1, 2, 3])
@draws(5)
@given(seed=st.integers(0, 2**32 - 1), more=st.integers(1, 3))
def test_a_fibre_is_all_weights_of_a_gain_and_of_a_metric(
    m: int, dt: float, seed: int, more: int
) -> None:
    """It contains the truth and nothing with another gain; S matters up to its scale.

    S K A^-1 B = B'PB is symmetric: the gain leaves m of the m(m+1)/2 entries of S free.
    """
    n = m + more
    plant, truth = random_case(seed, n, m, dt)
    solution, unit = impc.solve_lqr(plant, truth), np.eye(m)
    S, numbers = np.array(solution.S), n * (n + 1) // 2 + m * (m + 1) // 2 - n * m
    every = np.array([np.outer(a, b) + np.outer(b, a) for a in unit for b in unit])
    for metrics, dimension in (
        (every, numbers), (None, numbers), (3.0 * S[None], numbers - (m - 1)),
        (np.array([S, np.diag(unit[0])]), None),
    ):  # fmt: skip
        fibre = impc.gain_fibre(plant, solution.K, metrics)
        assert dimension in {fibre.dimension, None}
        X, basis = fibre.to_natural(truth), fibre.natural_basis()
        inside = np.tensordot(np.tensordot(basis, X, 2), basis, 1)
        assert np.linalg.norm(X - inside) < 1e-8 * np.linalg.norm(X)
        found = impc.least_condition_weights(fibre)
        assert found.least is not None
        assert found.least <= condition_number(truth) * (1 + 1e-8)
        assert found.condition <= found.least * (1 + 2 * SLACK)
        for member in (found, *impc.other_weights(fibre, 3)):
            assert member.gain_error < 1e-7
            span = (every if metrics is None else metrics).reshape(-1, m * m).T
            metric = impc.solve_lqr(plant, member.weights).S.ravel()
            left = metric - span @ np.linalg.lstsq(span, metric)[0]
            assert np.linalg.norm(left) < 1e-8 * np.linalg.norm(metric)


def test_seat_plant_in_two_units() -> None:
    """Margin and centre do not depend on the units, the least condition does."""
    work, scale = seat(1, 1.0), np.diag(np.logspace(-3, 2, 10))
    plant, truth = work.problem.plant, work.weights
    moved = impc.Weights(scale @ truth.Q @ scale, truth.R)
    fibre, other = fibre_of(plant, truth), fibre_of(rescaled(plant, scale), moved)
    assert fibre.dimension == 46
    assert fibre.singular_values[-1] > 1e-3 * fibre.singular_values[0]
    found = impc.least_condition_weights(fibre)
    # The reference's 1.69e7 belongs to another realisation of the delay.
    assert found.condition == pytest.approx(2.368523e7, rel=1e-4)
    assert present(found.gap) < 1e-6
    assert found.condition < condition_number(truth)
    centre, *others = analytic_centre(fibre), *impc.other_weights(fibre)
    assert len(others) == 2
    for member in (found, centre, *others):
        assert member.gain_error < 1e-9
    eigenvalues, vectors = np.linalg.eigh(centre.weights.Q)
    np.testing.assert_allclose(eigenvalues[-3:], [2.8e4, 9.5e4, 8.9e5], rtol=0.05)
    np.testing.assert_allclose(np.abs(vectors[:2, -1]), [0.625, 0.779], atol=0.01)
    assert weights_margin(other).margin == pytest.approx(weights_margin(fibre).margin, rel=1e-6)
    again = analytic_centre(other).weights
    np.testing.assert_allclose(scale @ centre.weights.Q @ scale, again.Q, rtol=1e-5, atol=1e-6)
    assert impc.least_condition_weights(other).condition != pytest.approx(found.condition, rel=0.5)


def test_analytic_centre_with_two_inputs_does_not_depend_on_their_coordinates() -> None:
    plant, truth = random_case(3, 4, 2, 1.0)
    gain, inputs = impc.solve_lqr(plant, truth).K, np.array([[1.0, 0.4], [0.0, 50.0]])
    moved = plant_of(plant.A, plant.B @ inputs)
    centre = analytic_centre(impc.gain_fibre(plant, gain)).weights
    other = analytic_centre(impc.gain_fibre(moved, np.linalg.solve(inputs, gain))).weights
    expected = impc.Weights(centre.Q, inputs.T @ centre.R @ inputs)
    assert impc.weight_error(expected, other) < 1e-6 * np.linalg.norm(other.block)


def test_a_gain_that_no_weights_have() -> None:
    fibre = impc.gain_fibre(example_plant(), NO_WEIGHTS_GAIN)
    found = weights_margin(fibre)
    assert not found.exist
    assert found.weights is None
    assert found.margin < -1
    for function in (impc.least_condition_weights, analytic_centre, impc.other_weights):
        with pytest.raises(impc.WeightsError, match="no positive definite weights"):
            function(fibre)
    with pytest.raises(impc.WeightsError, match="not stable"):
        impc.gain_fibre(example_plant(), [[0.0, 0.0]])
    with pytest.raises(impc.DataError, match="shape"):
        impc.gain_fibre(example_plant(), [0.0, 0.0])


@pytest.mark.parametrize(
    ("A", "B"),
    [
        ([[2, 1], [0, 0.5]], [[1], [0]]),  # not controllable
        ([[1.1, 0, 0], [1, 0, 0], [0, 1, 0]], [[1], [0], [0]]),  # singular A, hence A - BK
    ],
)
def test_an_unbounded_fibre_has_a_least_condition_but_no_centre(A: object, B: object) -> None:
    plant = plant_of(A, B)
    fibre = fibre_of(plant, impc.Weights(np.eye(plant.n), 1.0))
    assert impc.least_condition_weights(fibre).condition == pytest.approx(1.0, abs=1e-9)
    with pytest.raises(impc.WeightsError, match="no analytic centre"):
        analytic_centre(fibre)


@pytest.mark.parametrize(
    ("seed", "n", "m", "dt"),
    [(55, 8, 2, 1.0), (107, 6, 3, 1.0), (199, 8, 2, 1.0), (209, 8, 3, 1.0), (306, 8, 3, 0)],
)
def test_a_fibre_with_members_is_never_called_empty(seed: int, n: int, m: int, dt: float) -> None:
    """With the trace as an equality Clarabel stopped at the first iterations on these."""
    found = weights_margin(fibre_of(*random_case(seed, n, m, dt)))
    assert found.exist
    assert found.margin > 1e-6


def test_others_are_unlike_and_a_single_member_has_none() -> None:
    fibre = impc.gain_fibre(INTEGRATOR, [[0.434483, 1.028466]])
    found, others = impc.least_condition_weights(fibre), impc.other_weights(fibre)
    assert len(others) == 2
    for member in others:
        assert member.condition == pytest.approx(10 * found.condition, rel=1e-6)
        assert impc.weight_error(member.weights, found.weights) > 0.5
        assert member.gain_error < 1e-14
    assert impc.weight_error(others[0].weights, others[1].weights) > 0.5
    single = impc.gain_fibre(plant_of([[1.2]], [[1]]), [[0.7]])
    assert impc.other_weights(single) == ()
    pair = analytic_centre(single).weights, impc.least_condition_weights(single).weights
    assert impc.weight_error(*pair) < 1e-9


def test_the_reported_weights_do_not_depend_on_rounding() -> None:
    """Members of equal condition differ by a half in Q; the one of least norm is unique."""
    A = np.random.default_rng(3).normal(size=(6, 6)) / 2.2
    L = np.random.default_rng(5).normal(size=(6, 6))
    plant = plant_of(A, np.random.default_rng(4).normal(size=(6, 2)))
    K = impc.solve_lqr(plant, impc.Weights(L @ L.T + 0.1 * np.eye(6), np.eye(2))).K
    first = impc.least_condition_weights(impc.gain_fibre(plant, K)).weights
    for seed in range(4):
        # Rotated states keep norm and condition number, and change the rounding.
        U, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(6, 6)))
        found = impc.least_condition_weights(impc.gain_fibre(rescaled(plant, U), K @ U)).weights
        size = 1e-4 * np.max(np.abs(first.Q))
        np.testing.assert_allclose(U @ found.Q @ U.T, first.Q, atol=size)
        np.testing.assert_allclose(found.R, first.R, atol=1e-4)


def test_weights_on_the_border_of_the_set_are_refused() -> None:
    """`_by_convention` then reports the weights of the search."""
    fibre = fibre_of(plant_of([[1.1, 0.1], [0, 0.9]], [[0], [1]]), impc.Weights(np.eye(2), 1))
    with pytest.raises(impc.SolverError, match="singular to working precision"):
        inverse_factor(fibre, impc.Weights(np.diag([1.0, 0.0]), 1))


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
