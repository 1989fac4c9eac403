"""Time cases in turn within every repeat, so that a busy machine slows all of them."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

__all__ = ["Timing", "side_by_side"]


@dataclass(frozen=True)
class Timing:
    """Run times of one case, s."""

    seconds: tuple[float, ...]

    @property
    def median(self) -> float:
        """Median of the runs, in seconds."""
        return float(np.median(self.seconds))

    @property
    def spread(self) -> tuple[float, float]:
        """Lower and upper quartile of the runs, in seconds."""
        low, high = np.percentile(self.seconds, [25, 75])
        return float(low), float(high)


def side_by_side(
    cases: dict[str, Callable[[], object]],
    repeats: int,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[str, Timing]:
    """Run all cases `repeats` times in turn, after one warm-up run of each.

    `clock` measures wall time, or with `time.process_time` the time of all processors.
    """
    seconds: dict[str, list[float]] = {name: [] for name in cases}
    for repeat in range(repeats + 1):
        for name, call in cases.items():
            gc.collect()
            begin = clock()
            call()
            elapsed = clock() - begin
            if repeat:
                seconds[name].append(elapsed)
    return {name: Timing(tuple(values)) for name, values in seconds.items()}
