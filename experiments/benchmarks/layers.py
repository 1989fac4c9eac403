"""Closed loop of W1 with gradient, compared with cvxpylayers if installed."""

from __future__ import annotations

import importlib
import importlib.util
from typing import TYPE_CHECKING, Any

import cvxpy as cp
import numpy as np

from experiments.benchmarks.table import Row, compare
from experiments.benchmarks.timing import side_by_side
from experiments.benchmarks.workloads import Workload, example
from impc.inverse.laws import GainLaw
from impc.inverse.unknowns import linear_at
from impc.model.riccati import solve_lqr

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

__all__ = ["layer_rows"]


def layer_rows(runs: int, _: Path) -> list[Row]:
    """Row of the comparison with cvxpylayers; without a value if not installed."""
    what, against = "W1 simulation + gradient", "cvxpylayers, forward and backward"
    if not all(importlib.util.find_spec(name) for name in ("cvxpylayers", "torch")):
        note = "not installed: pip install '.[bench]'"
        return [Row(what, against, None, None, "", note)]
    work = example()
    solution = solve_lqr(work.problem.plant, work.weights)
    law = GainLaw(work.problem, np.array(solution.K), np.array(solution.S))
    timings = side_by_side(
        {
            "own": lambda: linear_at(work.problem, law, law.start),
            "layer": _layer(work),
        },
        max(3, runs // 2),
    )
    return [compare(what, against, timings["own"], timings["layer"], None)]


def _layer(work: Workload) -> Callable[[], Any]:
    # Imported by name because both are heavy and optional; `layer_rows` checks for them.
    torch = importlib.import_module("torch")
    CvxpyLayer = importlib.import_module("cvxpylayers.torch").CvxpyLayer

    plant, horizon = work.controller.plant, work.controller.horizon
    n = plant.n
    x0, K = cp.Parameter(n), cp.Parameter((1, n))
    v, x = cp.Variable((horizon, 1)), cp.Variable((horizon + 1, n))
    u = [v[k] - K @ x[k] for k in range(horizon)]
    constraints = [x[0] == x0]
    for k in range(horizon):
        constraints += [
            x[k + 1] == plant.A @ x[k] + plant.B @ u[k],
            u[k] <= 1,
            u[k] >= -1,
        ]
    program = cp.Problem(cp.Minimize(cp.sum_squares(v)), constraints)
    layer = CvxpyLayer(program, parameters=[x0, K], variables=[v])
    A, B = torch.tensor(np.array(plant.A)), torch.tensor(np.array(plant.B))

    def run() -> Any:
        gain = torch.tensor(np.array(work.controller.K), requires_grad=True)
        state = torch.tensor(np.array(work.drives[0].x0))
        total = torch.zeros((), dtype=torch.float64)
        for _ in range(work.drives[0].steps):
            (moves,) = layer(state, gain)
            state = A @ state + B @ (moves[0] - gain @ state)
            total = total + state @ state
        total.backward()
        return gain.grad

    return run
