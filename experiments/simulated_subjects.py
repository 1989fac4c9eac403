"""Fit many noisy simulated subjects: VAF below that of the truth, and standard errors.

The linear seat of W2, three trials of 30 s, white noise on the angles with which the true
controller has a VAF of 90 %. For each torque limit the script prints how far the fit is below the
VAF of the true controller, and how often each true gain that the report shows (not those of single
nerves and muscles) lies within three estimated standard errors. Results: experiments/coverage.md.

    python -m experiments.simulated_subjects --subjects 100 --limits 70 6 4.5
"""

from __future__ import annotations

import argparse
import functools
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from tqdm import tqdm

from experiments.benchmarks.workloads import seat
from impc.assess.covariance import TWO_SIDED
from impc.assess.printed_gain import covariance_intervals, follows_command, gain_estimate
from impc.inverse.noisy_fit import fit_controller
from impc.model.recordings import Recording
from impc.studies.fit.asked import fit_problem
from impc.studies.fit.settings import FitSettings

if TYPE_CHECKING:
    from impc.arrays import Array, IntArray
    from impc.model.plant import Plant

__all__ = ["Subject", "noisy_recordings", "simulated_subject"]


@dataclass(frozen=True)
class Subject:
    """One fit compared with the truth.

    Attributes
    ----------
    below_ceiling : float
        VAF of the true controller minus that of the fit, percentage points, scaled outputs.
    entries : Array
        Distance of each shown entry of K from the centre of its interval, which spans 3.92.
    directions : Array
        The same along the directions of `GainCovariance`, shape (n,).
    """

    below_ceiling: float
    entries: Array
    directions: Array


def noisy_recordings(
    limit: float, seed: int, ceiling: float, seconds: float = 30.0
) -> tuple[Recording, ...]:
    """Three noisy trials of the seat whose true controller has a VAF of `ceiling` (0 to 1)."""
    rng = np.random.default_rng(seed)
    trials = []
    work = seat(3, seconds, limit)
    for trial in work.problem.recordings:
        size = np.sqrt((1 - ceiling) / ceiling * np.mean(trial.outputs**2, axis=0))
        noisy = trial.outputs + size * rng.standard_normal(trial.outputs.shape)
        trials.append(Recording(work.problem.plant, noisy, trial.disturbance))
    return tuple(trials)


def simulated_subject(seed: int, limit: float, ceiling: float = 0.9) -> Subject:
    """Simulate and fit one subject, and compare with the truth."""
    work = seat(3, 30.0, limit)
    plant, truth = work.problem.plant, np.array(work.controller.K)
    trials = noisy_recordings(limit, seed, ceiling)
    problem = fit_problem(plant, trials, FitSettings(u_max=limit))
    fitted = fit_controller(problem)
    estimate = gain_estimate(fitted)
    covariance = estimate.covariance
    noise = sum(
        float(np.sum(((noisy.outputs - clean.outputs) / problem.output_scale) ** 2))
        for noisy, clean in zip(trials, work.problem.recordings, strict=True)
    )
    samples = sum(trial.outputs.size for trial in trials)
    error = estimate.K - truth
    along = covariance.along(error)
    intervals = covariance_intervals(estimate, covariance, "sandwich")
    shown = _shown(plant)
    ends = np.array([[intervals[index].low, intervals[index].high] for index in shown])
    return Subject(
        100 * (fitted.misfit**2 - noise) / samples,
        (ends.mean(axis=1) - np.ravel(truth)[shown]) / (np.ptp(ends, axis=1) / (2 * TWO_SIDED)),
        along / covariance.deviations,
    )


def _shown(plant: Plant) -> IntArray:
    """Places of the states whose gains the report shows, for a plant with one control."""
    return np.flatnonzero(~follows_command(plant))


def _study(limit: float, count: int) -> list[Subject]:
    with ProcessPoolExecutor(2) as pool:
        found = pool.map(functools.partial(simulated_subject, limit=limit), range(count))
        return list(tqdm(found, total=count, desc=f"{limit:g} Nm", unit="subject", disable=None))


def _print(limit: float, found: list[Subject], names: tuple[str, ...]) -> None:
    below = np.array([item.below_ceiling for item in found])
    entries = np.array([item.entries for item in found])
    directions = np.array([item.directions for item in found])
    print(f"\ntorque limit {limit:g} Nm, {len(found)} subjects (seeds 0 to {len(found) - 1})")
    print(f"points below the ceiling: median {np.median(below):.3f}, most {np.max(below):.3f}")
    print("entry of K           within 3 SE           SD of error/SE")
    for index, name in enumerate(names):
        share = np.mean(np.abs(entries[:, index]) <= 3)
        print(f"  {name:<18} {100 * share:12.0f} % {np.std(entries[:, index]):22.2f}")
    print("direction, best determined first")
    for index in range(directions.shape[1]):
        share = np.mean(np.abs(directions[:, index]) <= 3)
        print(f"  {index + 1:<18} {100 * share:12.0f} % {np.std(directions[:, index]):22.2f}")


def main() -> None:
    """Run the study and print its tables."""
    parser = argparse.ArgumentParser(description="Fits of simulated noisy subjects.")
    parser.add_argument("--subjects", type=int, default=100)
    parser.add_argument("--limits", type=float, nargs="+", default=[70.0, 6.0, 4.5])
    given = parser.parse_args()
    plant = seat(1, 1.0).problem.plant
    names = tuple(plant.states[index] for index in _shown(plant))
    for limit in given.limits:
        _print(limit, _study(limit, given.subjects), names)


if __name__ == "__main__":
    main()
