"""Both solvers of the upper level minimise the same objective."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from experiments.benchmarks.upper_level import Route, prox_linear, smooth_surrogate
from experiments.benchmarks.workloads import example
from impc.inverse.problem import Problem
from impc.inverse.residuals import misfit_or_reason
from impc.inverse.table31 import CONDITION_WEIGHT
from impc.model.riccati import solve_lqr
from impc.model.weights import Weights, condition_number


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
