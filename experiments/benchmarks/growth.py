"""Growth of the time of a simulation with the horizon, the states and the inputs."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from experiments.benchmarks.table import Row
from experiments.benchmarks.timing import Timing, side_by_side
from experiments.benchmarks.workloads import Workload, chain_of_masses, seat, with_horizon
from impc.control.closed_loop import simulate, simulate_and_differentiate
from impc.control.constraint_rows import directions

__all__ = ["growth_rows"]

_HORIZONS = (5, 20, 80, 200, 400, 1000)
_STATES = (10, 20, 30, 40)
_INPUTS = (1, 2, 4, 6)


def growth_rows(runs: int) -> list[Row]:
    """Measure all three."""
    work = seat()
    sizes = {
        "horizon N (W2)": _measure({h: with_horizon(work, h) for h in _HORIZONS}, runs),
        "states n (chain of masses)": _measure({n: chain_of_masses(n) for n in _STATES}, runs),
        "inputs m (six masses, no Jacobian)": _measure(
            {m: chain_of_masses(12, inputs=m) for m in _INPUTS}, runs, moving=False
        ),
    }
    return [
        Row(
            f"time for {name}, {min(times)} to {max(times)}",
            str(min(times)),
            times[max(times)].median / times[min(times)].median,
            note=", ".join(f"{size}: {1e3 * item.median:.3g}" for size, item in times.items()),
        )
        for name, times in sizes.items()
    ]


def _measure(works: dict[int, Workload], runs: int, *, moving: bool = True) -> dict[int, Timing]:
    cases: dict[str, Callable[[], object]] = {}
    for size, work in works.items():
        n = work.controller.plant.n if moving else 0
        along = directions(work.controller, n, K=np.eye(n)[None]) if n else None
        cases[str(size)] = (
            partial(simulate, work.controller, work.drives[0])
            if along is None
            else partial(simulate_and_differentiate, work.controller, work.drives[0], along)
        )
    return {int(name): timing for name, timing in side_by_side(cases, runs).items()}
