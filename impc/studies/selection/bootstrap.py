"""Model-based bootstrap of a subset of parameters: percentile intervals.

fit -> residuals, centred -> drawn again, one by one or in blocks -> added to the fit's outputs ->
fitted again from the fit -> percentiles. Residuals of people are coloured: drawn one by one they
give intervals that are too narrow, in blocks they do not (`impc.assess.resampling.block_length`).
Replicate k draws from the k-th child of the seed. Source: chapter 4; Künsch 1989 for the blocks.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Array, Frozen, frozen, percentiles
from impc.studies.selection.estimation import estimate, residuals
from impc.studies.selection.model import Trial

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from impc.assess.resampling import Draw
    from impc.studies.selection.estimation import Estimate
    from impc.studies.selection.model import ParametricModel

__all__ = ["BootstrapIntervals", "bootstrap_subset", "draw_single"]

_THREADS = 2


@dataclass(frozen=True)
class BootstrapIntervals(Frozen):
    """Percentiles of the replicates."""

    names: tuple[str, ...]  # Free parameters
    value: Array  # (free,), in their units
    low: Array
    high: Array
    level: float  # Share of the replicates inside
    drawn: Array  # (replicates, free)

    @property
    def width(self) -> Array:
        """Of the intervals (free,), in the parameters' units."""
        return np.asarray(self.high - self.low)


def draw_single(parts: list[Array], rng: np.random.Generator) -> list[Array]:
    """A `Draw` row by row: residuals `parts` (samples, p) of each trial to as many, (samples, p).

    Rows come from all trials; `rng` is what is drawn from.
    """
    pooled = np.concatenate([item - np.mean(item, axis=0) for item in parts])
    return [pooled[rng.integers(len(pooled), size=len(item))] for item in parts]


def bootstrap_subset(
    model: ParametricModel,
    trials: Sequence[Trial],
    fit: Estimate,
    replicates: int,
    seed: int,
    draw: Draw = draw_single,
    *,
    level: float = 0.95,
    progress: Callable[[], None] = lambda: None,
) -> BootstrapIntervals:
    """Intervals of the free parameters of a fit."""
    theta = np.array(fit.theta)
    left = residuals(model, theta, trials)
    clean = [np.asarray(model.simulate(theta, item.input)) for item in trials]

    def one(index: int) -> Array:
        rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(index,)))
        again = [
            Trial(item.input, outputs + noise)
            for item, outputs, noise in zip(trials, clean, draw(left, rng), strict=True)
        ]
        found = np.array(estimate(model, again, fit.free, theta).theta)[list(fit.free)]
        progress()
        return found

    # The compiled recursion lets other threads run.
    with ThreadPoolExecutor(_THREADS) as pool:
        drawn = np.array(list(pool.map(one, range(replicates))))
    low, high = percentiles(drawn, level)
    return BootstrapIntervals(
        tuple(model.names[index] for index in fit.free),
        frozen(theta[list(fit.free)]),
        frozen(low),
        frozen(high),
        level,
        frozen(drawn),
    )
