"""What a fit will take, told before it is begun: seconds and memory, to their order of magnitude.

The largest arrays are the rows of the constraints, r = 2 N m for bounded inputs, and their
derivatives along p directions, r x N m x p; and those of the states, samples x n x p
(`impc.control.constraint_rows`, `impc.control.closed_loop`). Seconds are those of
docs/benchmarks/results.md: 5.4 ms for a simulation of 3000 samples with ten states, N = 20 and ten
directions, and as many simulations as a fit, a replicate and a profile took there.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from impc.inverse.problem import Problem
    from impc.studies.fit.settings import FitSettings

#: Seconds for each sample, state and sample of the horizon.
SECONDS_A_SAMPLE = 5.4e-3 / (3000 * 10 * 20)
# For each number of the derivatives of the rows, which are built again for each simulation.
_A_NUMBER = 1e-8
# Times of a simulation with other solvers over the compiled one, docs/benchmarks/results.md.
_SLOWER = {"compiled": 1.0, "daqp": 18.0, "qpoases": 24.0, "ipopt": 225.0}
# What a simulation takes however short the trial is: the calls around the compiled loop.
_A_TRIAL = 1e-3
# Simulations of all trials: of a fit (4 s of three trials of 15 ms), of a replicate (0.6 s of it),
# of a profile, which fits again at each of its points.
_FIT, _REPLICATE, _PROFILE = 300, 40, 1000


@dataclass(frozen=True)
class Effort:
    """An estimate of what a request takes."""

    seconds: float  # s, on one core of an ordinary machine
    gigabytes: float  # Of the arrays that are alive at a time

    def shared(self, parts: float, threads: int) -> Effort:
        """Of so many such `parts`, as many at a time as there are `threads`."""
        at_once = min(float(threads), parts)
        return Effort(self.seconds * parts / max(at_once, 1.0), self.gigabytes * at_once)


def fit_effort(problem: Problem, settings: FitSettings) -> Effort:
    """What `impc.studies.fit.subject` will take; nothing of its size is made."""
    plant, trials = problem.plant, problem.recordings
    n, m = plant.n, plant.m
    along = m * n + m**2 + n + len(problem.logarithms)
    horizon = max(problem.horizon, *settings.horizons, 1)
    sides = (problem.bounds.x_min, problem.bounds.x_max, problem.bounds.u_min, problem.bounds.u_max)
    rows = float(sum(int(np.isfinite(side).sum()) for side in sides) * horizon)
    samples = sum(trial.samples for trial in trials)
    longest = max(trial.samples for trial in trials)
    derivatives = rows * horizon * m * along
    numbers = derivatives + 4 * rows * horizon * m + rows**2
    numbers += 2 * longest * (n + m) * along + 2 * samples * len(plant.outputs) * along
    once = samples * n * horizon * SECONDS_A_SAMPLE * _SLOWER[problem.solver]
    once += derivatives * _A_NUMBER + len(trials) * _A_TRIAL
    left_out = len(trials) if settings.held_out and len(trials) > 1 else 0
    structures = (settings.structure is not None) + len(settings.structures)
    fits = 2 + left_out + len(settings.horizons) + m * settings.unknown_limit
    fits += structures * (1 + left_out)
    simulations = _FIT * fits + _REPLICATE * settings.replicates + _PROFILE * len(settings.profiles)
    return Effort(simulations * once, 8e-9 * numbers)
