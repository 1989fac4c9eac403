"""Compare two solvers of the upper level: objective reached, simulations, seconds."""

from __future__ import annotations

import numpy as np

from experiments.benchmarks.table import Row
from experiments.benchmarks.upper_level import Route, prox_linear, smooth_surrogate
from experiments.benchmarks.workloads import example, seat
from impc.inverse.table31 import starting_weights
from impc.model.weights import Weights

__all__ = ["route_rows"]


def route_rows(_: int) -> list[Row]:
    """Run each case once; the compared objective does not vary."""
    short, person = example(), seat()
    cases = {
        "W1 from the Table 3.1 start": (short, starting_weights(short.problem)),
        "W1 from diag(2, 0.2)": (short, Weights(np.diag([2.0, 0.2]), 1)),
        "W2 from the Table 3.1 start": (person, starting_weights(person.problem)),
    }
    rows = []
    for name, (work, start) in cases.items():
        own = prox_linear(work.problem, start)
        other = smooth_surrogate(work.problem, start)
        what = f"objective (3.6) of prox-linear, {name}"
        ratio, note = own.objective / other.objective, f"{_say(own)} / {_say(other)}"
        rows.append(Row(what, "L-BFGS on a smooth surrogate", ratio, note=note))
    return rows


def _say(route: Route) -> str:
    return f"{route.objective:.9g} in {route.simulations} simulations, {1e3 * route.seconds:.3g} ms"
