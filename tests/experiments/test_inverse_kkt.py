"""Inverse KKT, exact if its assumption holds, and the two solvers of the upper level."""

from __future__ import annotations

from collections.abc import Callable

import cvxpy
import numpy as np
import pytest

from experiments.benchmarks.upper_level import Route, prox_linear, smooth_surrogate
from experiments.benchmarks.workloads import example, seat
from experiments.inverse_kkt import Smoothed, smoothed_trials, stationarity_weights
from impc.arrays import Array
from impc.control.closed_loop import simulate
from impc.errors import DataError
from impc.inverse.problem import Problem
from impc.inverse.residuals import misfit_or_reason
from impc.inverse.table31 import CONDITION_WEIGHT
from impc.model.riccati import solve_lqr
from impc.model.weights import Weights, condition_number
from tests.support import random_plant, random_weights

SEED = 6


def optimal_runs(seed: int, n: int, m: int) -> tuple[object, Array, list[Smoothed]]:
    """Undisturbed regulators from random starts: every segment is an optimal plan."""
    rng = np.random.default_rng(seed)
    plant = random_plant(rng, n, m, 1.1)
    weights = Weights(random_weights(rng, n), random_weights(rng, m))
    K = np.array(solve_lqr(plant, weights).K)
    runs = []
    for _ in range(5):
        x, states, commands = rng.standard_normal(n), [], []
        for _ in range(25):
            states.append(x)
            commands.append(-K @ x)
            x = plant.A @ x + plant.B @ commands[-1]
        runs.append(Smoothed(np.array(states), np.array(commands)))
    return plant, K, runs


@pytest.mark.parametrize("size", [(2, 1), (3, 1), (3, 2)], ids=str)
def test_optimal_plans_give_back_their_gain(size: tuple[int, int]) -> None:
    plant, K, runs = optimal_runs(SEED, *size)
    found = stationarity_weights(plant, runs, 12, np.full(size[1], np.inf), K)  # type: ignore[arg-type]
    again = solve_lqr(plant, found).K  # type: ignore[arg-type]
    np.testing.assert_allclose(again, K, atol=1e-4 * np.max(np.abs(K)))


def test_the_residual_is_that_of_the_stationarity_conditions() -> None:
    """The same least-squares problem by cvxpy, with every lambda as a variable."""
    plant, K, runs = optimal_runs(SEED + 1, 2, 1)
    rng = np.random.default_rng(SEED)
    noisy = [Smoothed(run.x, run.u + 0.05 * rng.standard_normal(run.u.shape)) for run in runs]
    found = stationarity_weights(plant, noisy, 25, np.array([np.inf]), K)  # type: ignore[arg-type]
    Q = cvxpy.Variable((2, 2), PSD=True)
    rows, constraints = [], []
    for run in noisy:
        adjoint = cvxpy.Variable((26, 2))
        A, B = plant.A, plant.B  # type: ignore[attr-defined]
        constraints.append(adjoint[:-1] == run.x @ Q + adjoint[1:] @ A)
        rows.append(run.u + adjoint[1:] @ B)
    objective = cvxpy.Minimize(cvxpy.sum_squares(cvxpy.vstack(rows)))
    cvxpy.Problem(objective, constraints).solve(solver=cvxpy.CLARABEL)
    other = solve_lqr(plant, Weights(Q.value, 1)).K  # type: ignore[arg-type]
    ours = solve_lqr(plant, found).K  # type: ignore[arg-type]
    np.testing.assert_allclose(ours, other, atol=2e-3 * np.max(np.abs(K)))


def test_saturated_rows_are_left_out() -> None:
    """All commands at the bound: no row is left, which raises an error."""
    plant, K, runs = optimal_runs(SEED, 2, 1)
    with pytest.raises(DataError, match="no stretch"):
        stationarity_weights(plant, runs, 12, np.array([1e-300]), K)  # type: ignore[arg-type]


def test_smoothing_finds_states_and_commands() -> None:
    """Exact outputs of the disturbed seat: angles to 1e-5, rates to 1 % of their size."""
    work = seat(1, 20.0)
    (found,) = smoothed_trials(work.problem)
    run = simulate(work.controller, work.drives[0])
    size = np.sqrt(np.mean(run.x**2, axis=0))
    error = np.max(np.abs(found.x - run.x)[20:-20], axis=0) / size
    assert np.all(error[:2] < 1e-4)
    assert np.all(error[2:4] < 1e-2)


@pytest.mark.parametrize("route", [prox_linear, smooth_surrogate])
def test_a_route_says_misfit_and_condition_number_with_one_weight(
    route: Callable[[Problem, Weights], Route],
) -> None:
    """Prox-linear steps and the surrogate use the same condition weight."""
    problem = example().problem
    found = route(problem, Weights(np.diag([2.0, 0.2]), 1))
    solution = solve_lqr(problem.plant, found.weights)
    misfit, _ = misfit_or_reason(problem, solution.K, solution.S)
    expected = misfit + CONDITION_WEIGHT * condition_number(found.weights)
    assert found.objective == pytest.approx(expected, rel=1e-6)
