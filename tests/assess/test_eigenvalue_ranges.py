"""Ranges of the eigenvalues of Q over a set of weights, and the nearest diagonal member."""

from __future__ import annotations

import control
import cvxpy
import numpy as np
import pytest

from experiments.benchmarks.workloads import example, seat
from impc.arrays import Array
from impc.assess.bounded_weights import WeightsSet, weights_set
from impc.assess.extreme_weights import entry_ranges, extreme_eigenvalue, nearest_diagonal
from impc.assess.weights_ranges import eigenvalue_ranges
from impc.inverse.solution_set import gain_fibre
from impc.model.plant import Plant
from impc.model.riccati import solve_lqr
from impc.model.weights import Weights, condition_number
from tests.assess.test_bounded_weights import random_members, set_of


def eigenvalues(found: WeightsSet, members: list[Array]) -> Array:
    n = found.fibre.plant.n
    return np.array([np.linalg.eigvalsh(X[:n, :n]) for X in members])


def test_two_states_against_random_search() -> None:
    """No sampled member goes beyond the proved ends by rounding; all ends are met to 1 %."""
    found = set_of(example())
    ranges = eigenvalue_ranges(found)
    sampled = eigenvalues(found, random_members(found, 4000))
    for index, item in enumerate(ranges):
        width = item.high - item.low
        low, high = sampled[:, index].min(), sampled[:, index].max()
        assert item.low <= low + 1e-2 * width
        assert item.high >= high - 1e-2 * width
        assert low <= item.low + 1e-2 * width
        assert high >= item.high - 1e-2 * width
    assert ranges[1].low_proved
    assert ranges[0].high_proved
    assert sampled[:, 1].min() >= ranges[1].low * (1 - 1e-7)
    assert sampled[:, 0].max() <= ranges[0].high * (1 + 1e-7)


def test_ten_states_reach_at_least_what_sampling_does() -> None:
    found = set_of(seat(1, 1.0))
    members = [
        weights.block
        for item in entry_ranges(found, [0, 1]).values()
        for weights in (item.least.weights, item.most.weights)
    ]
    ranges = eigenvalue_ranges(found, members)
    sampled = eigenvalues(found, [*random_members(found, 200), *members])
    for index, item in enumerate(ranges):
        assert item.low <= sampled[:, index].min() * (1 + 1e-6)
        assert item.high >= sampled[:, index].max() * (1 - 1e-6)


def test_program_ends_are_members() -> None:
    found = set_of(seat(1, 1.0))
    for largest in (True, False):
        end = extreme_eigenvalue(found, largest=largest)
        assert condition_number(end.weights) <= found.limit
        assert end.value == pytest.approx(end.bound, rel=1e-6)
        assert (end.bound <= end.value) == largest


def test_nearest_diagonal_against_cvxpy() -> None:
    """The same program written down by cvxpy, for ten states of different size."""
    found = set_of(seat(1, 1.0), 2.0)
    n = found.fibre.plant.n
    sizes = np.logspace(0, 1, n)
    ours = nearest_diagonal(found, sizes)
    y, t = cvxpy.Variable(len(found.level)), cvxpy.Variable()
    inverse = found.inverse
    unit = np.linalg.eigvalsh(found.least.weights.block)[0]
    X = found.first + sum(y[k] * level for k, level in enumerate(found.level))
    seen = inverse @ found.first @ inverse.T
    seen = seen + sum(y[k] * (inverse @ level @ inverse.T) for k, level in enumerate(found.level))
    off = cvxpy.multiply(X[:n, :n], np.outer(sizes, sizes) * (1 - np.eye(n)))
    scale = ours.value
    problem = cvxpy.Problem(
        cvxpy.Minimize(cvxpy.norm(off / scale, "fro")),
        [
            seen >> t * unit * inverse @ inverse.T,
            X / (found.limit * unit) << t * np.eye(n + 1),
        ],
    )
    problem.solve(solver=cvxpy.CLARABEL)
    assert ours.value == pytest.approx(scale * problem.value, rel=1e-4)
    assert condition_number(ours.weights) <= found.limit


def test_nearest_diagonal_of_the_seat_is_proved() -> None:
    """105277.96203 is by a barrier method in 400 bits from A, B and K alone, with P for unknown.

    It brackets the optimum to 2e-5. Programs as seen from the member of least condition number
    ended between 105396 and 105449, whichever the processor, with a gap of 1e-8.
    """
    found = set_of(seat(1, 1.0), 2.0)
    end = nearest_diagonal(found, np.logspace(0, 1, found.fibre.plant.n))
    assert end.bound <= 105277.96205
    assert end.value >= 105277.96200
    assert end.value - end.bound <= 1e-6 * end.value
    assert condition_number(end.weights) <= found.limit


def test_ends_are_proved_without_an_analytic_centre() -> None:
    """A state that is gone in one step: its cost is free but for the limit."""
    plant = Plant(control.ss([[1.2, 0.5], [0.0, 0.0]], [[1.0], [0.3]], np.eye(2), 0, True))
    K = solve_lqr(plant, Weights(np.diag([2.0, 1.0]), 1.0)).K
    assert abs(np.linalg.det(plant.A - plant.B @ K)) < 1e-12
    found = weights_set(gain_fibre(plant, K))
    values = eigenvalues(found, random_members(found, 500))
    for index, largest in ((-1, True), (0, False)):
        end = extreme_eigenvalue(found, largest=largest)
        assert end.value == pytest.approx(end.bound, rel=1e-6)
        worse = values[:, index] - end.bound
        assert np.all(worse >= 0) if largest else np.all(worse <= 0)


def test_a_diagonal_member_is_found_where_there_is_one() -> None:
    found = set_of(example())
    end = nearest_diagonal(found, np.array([1.0, 3.0]))
    np.testing.assert_allclose(end.weights.Q, np.diag(np.diag(end.weights.Q)), atol=1e-6)
    checked = Weights(end.weights.Q, end.weights.R)
    assert condition_number(checked) <= found.limit
