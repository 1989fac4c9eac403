"""Quadratic programs by other solvers than the compiled one, and the loop as a function."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import casadi as ca
import numpy as np

from experiments.benchmarks.table import Row, compare
from experiments.benchmarks.timing import side_by_side
from experiments.benchmarks.workloads import example, seat
from impc.arrays import Array
from impc.checking import replace
from impc.control.closed_loop import simulate_and_differentiate
from impc.control.constraint_rows import directions
from impc.control.loop_function import closed_loop_function
from impc.control.named_solver import COMPILED, SOLVERS
from impc.inverse.estimates import Estimate
from impc.inverse.table31 import inverse_mpc_reduced
from impc.model.weights import weight_error

__all__ = ["solver_rows"]

# IPOPT needs 3 ms for each of 430 programs.
_FITS = ("daqp", "qpoases")


def solver_rows(runs: int) -> list[Row]:
    """Time and compare: trajectories to 1e-9, derivatives to 1e-8, gains of fits to 1e-6."""
    return [*_simulations(runs), *_example_fits(runs), *_seat_fits(max(3, runs // 2))]


def _simulations(runs: int) -> list[Row]:
    work = seat()
    controller, drive = work.controller, work.drives[0]
    n = controller.plant.n
    along = directions(controller, n, K=np.eye(n)[None])
    run, exact = simulate_and_differentiate(controller, drive, along)
    cases: dict[str, Callable[[], object]] = {
        solver: partial(
            simulate_and_differentiate, replace(controller, solver=solver), drive, along
        )
        for solver in (COMPILED, *SOLVERS)
    }
    for solver in SOLVERS:
        other, found = simulate_and_differentiate(replace(controller, solver=solver), drive, along)
        np.testing.assert_allclose(other.x, run.x, atol=1e-9)
        _require_close(found.x, exact.x, 1e-8)
    K = ca.MX.sym("K", 1, n)
    loop = closed_loop_function(controller, disturbance=drive.disturbance)
    x, _ = loop(K, controller.S, drive.x0)
    slope = ca.Function("slope", [K], [ca.jacobian(x, K)])
    _require_close(slope(controller.K).full(), np.moveaxis(exact.x, 1, 0).reshape(-1, n), 1e-8)
    steps = iter(np.arange(1, 10**6))

    def by_function() -> object:
        # A new gain at each call, because CasADi caches the last one.
        return slope(np.array(controller.K) * (1 + 1e-12 * next(steps)))

    timings = side_by_side({**cases, "function": by_function}, runs)
    what = "W2 simulation + exact Jacobian in K (ten directions)"
    rows = [
        compare(f"{what}, solver {name}", "compiled", timings[name], timings[COMPILED])
        for name in SOLVERS
    ]
    function = "the same from closed_loop_function, a casadi.Function"
    return [*rows, compare(function, "compiled", timings["function"], timings[COMPILED])]


def _example_fits(runs: int) -> list[Row]:
    work = example()
    problems = {name: replace(work.problem, solver=name) for name in (COMPILED, *SOLVERS)}
    for name, problem in problems.items():
        if weight_error(inverse_mpc_reduced(problem).stage_weights, work.weights) > 1e-6:
            raise AssertionError(f"W1 missed the true weights with {name}")
    timings = side_by_side(
        {name: partial(inverse_mpc_reduced, problem) for name, problem in problems.items()}, runs
    )
    return [
        compare(f"W1 reduced fit, solver {name}", "compiled", timings[name], timings[COMPILED])
        for name in SOLVERS
    ]


def _seat_fits(runs: int) -> list[Row]:
    work = seat()
    fits: dict[str, Callable[[], Estimate]] = {
        name: partial(inverse_mpc_reduced, replace(work.problem, solver=name))
        for name in (COMPILED, *_FITS)
    }
    found = {name: np.array(fit().gain) for name, fit in fits.items()}
    for name in _FITS:
        _require_close(found[name], found[COMPILED], 1e-6)
    timings, rows = side_by_side(dict(fits), runs), []
    for name in _FITS:
        off = np.max(np.abs(found[name] - found[COMPILED])) / np.max(np.abs(found[name]))
        what = f"W2 fit, one trial, solver {name} (gains within {off:.0e})"
        rows.append(compare(what, "compiled", timings[name], timings[COMPILED]))
    return rows


def _require_close(found: Array, expected: Array, tolerance: float) -> None:
    """Raise if the largest difference, relative to the largest entry, is above `tolerance`."""
    if np.max(np.abs(found - expected)) > tolerance * np.max(np.abs(expected)):
        raise AssertionError(f"differs by {np.max(np.abs(found - expected)):.3g}")
