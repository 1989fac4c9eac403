"""What recordings leave open of the metric is said, and a given start is never left for worse."""

from __future__ import annotations

import control
import numpy as np
import pytest

import impc
from impc.inverse.problem import Problem
from impc.inverse.residuals import residual_only
from impc.model.riccati import solve_lqr
from tests.support import random_problem

RNG = np.random.default_rng(3)
PLANT = impc.Plant(
    control.ss(RNG.normal(size=(3, 3)) / 2, RNG.normal(size=(3, 2)), np.eye(3), 0, 1)
)
WEIGHTS = impc.Weights(np.eye(3), [[1.0, 0.3], [0.3, 2.0]])


def recorded(limit: float) -> Problem:
    """Exact trials from eight states; the limit decides how often inputs are saturated."""
    bounds = impc.Bounds(PLANT, u_min=-limit, u_max=limit)
    law = impc.Controller(PLANT, WEIGHTS, bounds, 5, terminal_set=False)
    starts = np.random.default_rng(1).normal(size=(8, 3))
    trials = [impc.Recording(PLANT, law.simulate(x0, 15).x) for x0 in starts]
    return impc.Problem(PLANT, bounds, 5, trials, terminal_set=False)


@pytest.mark.parametrize(("limit", "rank"), [(50.0, 0), (0.25, 2)])
def test_directions_of_the_metric_are_counted_and_said(limit: float, rank: int) -> None:
    problem = recorded(limit)
    found = impc.fit(problem)
    assert found.explained
    assert found.fit.metric_rank == rank
    said = f"identify {rank} of the 2 directions of the metric S"
    assert (said in found.summary()) == (rank < 2)
    # Independent: whether another metric with this gain gives another movement.
    other = np.array(found.metric) + np.diag([0.0, np.trace(found.metric) / 4])
    moved = residual_only(found.problem, np.array(found.gain), other)
    assert (np.linalg.norm(moved) > 1e-6) == (rank > 0)


def test_without_bounds_nothing_is_said_of_the_metric() -> None:
    problem = recorded(50.0)
    found = impc.fit(problem, "feedback_gain", start=impc.fit(problem))
    assert not any("metric" in text for text in found.doubts)


def started(problem: Problem, start: impc.Weights) -> tuple[float, float]:
    """Misfit of a start, and of the estimate from it."""
    solution = solve_lqr(problem.plant, start)
    begun = float(np.linalg.norm(residual_only(problem, solution.K, solution.S)))
    return begun, impc.fit(problem, start=start).misfit


@pytest.mark.parametrize("limit", [50.0, 0.25])
def test_an_estimate_from_the_true_weights_keeps_them(limit: float) -> None:
    begun, ended = started(recorded(limit), WEIGHTS)
    assert ended <= begun + 1e-9


@pytest.mark.parametrize("seed", range(5))
def test_no_estimate_is_worse_than_the_start_that_was_given(seed: int) -> None:
    _, problem = random_problem(seed, 2)
    begun, ended = started(problem, impc.Weights(np.eye(problem.plant.n), np.eye(2)))
    assert ended <= begun * (1 + 1e-9)
