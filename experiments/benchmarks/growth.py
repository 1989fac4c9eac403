"""Growth of the time of simulation + Jacobian with the horizon and the number of states."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from experiments.benchmarks.table import Row
from experiments.benchmarks.timing import Timing, side_by_side
from experiments.benchmarks.workloads import chain_of_masses, seat, with_horizon
from impc.control.closed_loop import simulate_and_differentiate
from impc.control.constraint_rows import directions

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from experiments.benchmarks.workloads import Workload

__all__ = ["growth_rows"]

_HORIZONS = (20, 30, 40, 60, 80)
_STATES = (10, 20, 30, 40)


def growth_rows(runs: int, folder: Path) -> list[Row]:
    """Measure both, fit exponents by least squares in the logarithms, and plot."""
    work = seat()
    horizons = _measure({h: with_horizon(work, h) for h in _HORIZONS}, runs)
    states = _measure({n: chain_of_masses(n) for n in _STATES}, runs)
    _plot(horizons, states, folder)
    return [
        Row(
            f"exponent of the time in {name}, {min(times)} to {max(times)}",
            "",
            _exponent(times),
            None,
            "",
            ", ".join(f"{size}: {1e3 * item.median:.3g}" for size, item in times.items()),
        )
        for name, times in (
            ("the horizon (W2)", horizons),
            ("the states (chain of masses)", states),
        )
    ]


def _measure(works: dict[int, Workload], runs: int) -> dict[int, Timing]:
    cases: dict[str, Callable[[], object]] = {}
    for size, work in works.items():
        n = work.controller.plant.n
        along = directions(work.controller, n, K=np.eye(n)[None])
        cases[str(size)] = partial(
            simulate_and_differentiate, work.controller, work.drives[0], along
        )
    return {int(name): timing for name, timing in side_by_side(cases, runs).items()}


def _exponent(times: dict[int, Timing]) -> float:
    medians = [item.median for item in times.values()]
    return float(np.polyfit(np.log(list(times)), np.log(medians), 1)[0])


def _plot(horizons: dict[int, Timing], states: dict[int, Timing], folder: Path) -> None:
    figure = Figure(figsize=(7.0, 2.8), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    for axes, times, label in (
        (left, horizons, "horizon N (samples), seated subject"),
        (right, states, "states n, chain of masses, N = 20"),
    ):
        medians = np.array([1e3 * item.median for item in times.values()])
        spread = np.array([[1e3 * side for side in item.spread] for item in times.values()]).T
        errors = np.abs(spread - medians)
        axes.errorbar(list(times), medians, yerr=errors, marker="o", color="black", capsize=3)
        axes.set(xscale="log", yscale="log", xlabel=label)
        axes.set_xticks(list(times), [str(size) for size in times])
        axes.minorticks_off()
        axes.set_title(f"time ~ size^{_exponent(times):.2f}", fontsize=9)
        axes.grid(visible=True, alpha=0.3)
    ticks = [5, 10, 20, 50]
    left.set_yticks(ticks, [str(tick) for tick in ticks])
    left.set_ylabel("simulation + Jacobian (ms)")
    folder.mkdir(parents=True, exist_ok=True)
    for kind in ("png", "pdf"):
        figure.savefig(folder / f"growth.{kind}", dpi=200)
