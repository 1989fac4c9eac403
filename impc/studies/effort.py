"""Order of magnitude of the run time and memory of a command.

The largest arrays are the rows of the constraints, r = 2 N m for bounded inputs, their derivatives
along p directions, r x N m x p, and those of the states, samples x n x p
(`impc.control.constraint_rows`, `impc.control.closed_loop`). Run times are from
experiments/benchmarks/results.md.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from impc.control.closed_loop import first_stages
from impc.inverse.problem import Problem
from impc.studies.fit.settings import FitSettings
from impc.studies.selection.model import ParametricModel, Trial, sensitivity
from impc.studies.selection.settings import SelectSettings

#: Seconds per sample, state and sample of the horizon: 5.4 ms for 3000 samples, n = 10, N = 20.
SECONDS_A_SAMPLE = 5.4e-3 / (3000 * 10 * 20)
# Seconds per number of the derivatives of the rows, which are rebuilt for each simulation.
_A_NUMBER = 1e-8
# Run time of a simulation relative to the compiled solver (experiments/benchmarks/results.md).
_SLOWER = {"compiled": 1.0, "daqp": 18.0, "qpoases": 24.0, "ipopt": 225.0}
# Seconds per simulation outside the compiled loop.
_A_TRIAL = 1e-3
# Number of simulations of all trials in a fit, a bootstrap replicate and a profile.
_FIT, _REPLICATE, _PROFILE = 300, 40, 1000
# Evaluations with derivatives of a fit from a distant start, of a fit from a close start, and of a
# LASSO with refit. Counts on the drug: 7, 5, 74; on the head, whose twelve parameters are poorly
# determined: 200, 17, 23.
_START, _REFIT, _LASSO = 30, 9, 100
# Arrays of the size of the derivative in a fit; parallel fits in a bootstrap.
_COPIES, _THREADS = 6, 2


@dataclass(frozen=True)
class Effort:
    """Estimated run time and memory of a request."""

    seconds: float  # Run time on one core, s
    gigabytes: float  # Memory of the arrays in use at the same time, GB

    def shared(self, parts: float, threads: int) -> Effort:
        """Effort of several such `parts`, run in parallel on `threads`."""
        at_once = min(float(threads), parts)
        return Effort(self.seconds * parts / max(at_once, 1.0), self.gigabytes * at_once)


def fit_effort(problem: Problem, settings: FitSettings) -> Effort:
    """Effort of `impc.studies.fit.subject`; allocates no large arrays."""
    plant, trials = problem.plant, problem.recordings
    n, m = plant.n, plant.m
    along = m * n + m**2 + n + len(problem.logarithms)
    horizon = max(problem.horizon, *settings.horizons, 1)
    sides = (problem.bounds.x_min, problem.bounds.x_max, problem.bounds.u_min, problem.bounds.u_max)
    stages = first_stages(horizon, problem.solver)
    families = float(sum(int(np.isfinite(side).sum()) for side in sides))
    rows = families * stages
    samples = sum(trial.samples for trial in trials)
    longest = max(trial.samples for trial in trials)
    derivatives = rows * stages * m * along
    numbers = derivatives + 2 * (rows + families * horizon) * stages * m + rows**2
    numbers += 2 * longest * (n + m) * along + 2 * samples * len(plant.outputs) * along
    once = samples * n * stages * SECONDS_A_SAMPLE * _SLOWER[problem.solver]
    once += derivatives * _A_NUMBER + len(trials) * _A_TRIAL
    left_out = len(trials) if settings.held_out and len(trials) > 1 else 0
    structures = (settings.structure is not None) + len(settings.structures)
    fits = 2 + left_out + len(settings.horizons) + m * settings.unknown_limit
    fits += structures * (1 + left_out)
    simulations = _FIT * fits + _REPLICATE * settings.replicates + _PROFILE * len(settings.profiles)
    return Effort(simulations * once, 8e-9 * numbers)


def select_evaluations(settings: SelectSettings) -> int:
    """Evaluations of the model with derivative for one subject of `impc select`."""
    return _START * (settings.starts + 1) + _REFIT * settings.replicates + _LASSO


def key_evaluations(settings: SelectSettings, most: int = 20) -> int:
    """Evaluations of the model with derivative per subject and visit of `impc key-parameters`."""
    return _START * (settings.starts + most)


def selection_effort(
    model: ParametricModel, recorded: Iterable[Sequence[Trial]], evaluations: int
) -> Effort:
    """Mean effort for one subject; calls the model three times to measure its run time."""
    subjects = [tuple(trials) for trials in recorded]
    samples = [sum(len(trial.input) for trial in trials) for trials in subjects]
    first = subjects[0][0]
    # The first call may include compilation.
    times = []
    for _ in range(3):
        begun = time.perf_counter()
        outputs, _slopes = sensitivity(model, np.array(model.typical), first.input)
        times.append(time.perf_counter() - begun)
    one = min(times) / len(first.input)
    numbers = max(samples) * outputs.shape[1] * model.size * _COPIES * _THREADS
    return Effort(one * float(np.mean(samples)) * evaluations, 8e-9 * numbers)
