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
from typing import NamedTuple

import numpy as np

from experiments.benchmarks.workloads import seat
from experiments.driver import each, noisy
from experiments.summary import markdown
from impc.arrays import Array, IntArray
from impc.assess.covariance import TWO_SIDED
from impc.assess.printed_gain import covariance_intervals, follows_command, gain_estimate
from impc.inverse.noisy_fit import fit_controller
from impc.model.plant import Plant
from impc.model.recordings import Recording
from impc.studies.fit.asked import fit_problem
from impc.studies.fit.settings import FitSettings

__all__ = ["Subject", "noisy_recordings", "simulated_subject", "standard_errors_from"]


class Subject(NamedTuple):
    """One fit compared with the truth."""

    below_ceiling: float  # VAF of the truth minus that of the fit, points, scaled outputs
    # Distance of each shown entry of K to the centre of its interval in standard errors; the same
    # along the directions of `GainCovariance` (n,).
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
        noise = rng.standard_normal(trial.outputs.shape)
        outputs = noisy(np.array(trial.outputs), (1 - ceiling) / ceiling, noise)
        trials.append(Recording(work.problem.plant, outputs, trial.disturbance))
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
        float(np.sum(((trial.outputs - clean.outputs) / problem.output_scale) ** 2))
        for trial, clean in zip(trials, work.problem.recordings, strict=True)
    )
    samples = sum(trial.outputs.size for trial in trials)
    intervals = covariance_intervals(estimate, covariance, "sandwich")
    shown = _shown(plant)
    ends = np.array([[intervals[index].low, intervals[index].high] for index in shown])
    return Subject(
        100 * (fitted.misfit**2 - noise) / samples,
        standard_errors_from(np.ravel(truth)[shown], ends),
        covariance.along(estimate.K - truth) / covariance.deviations,
    )


def standard_errors_from(truth: Array, ends: Array) -> Array:
    """Distances of `truth` (k,) to the centres of 95 % intervals `ends` (k, 2) in standard errors.

    0 for an interval without ends, which contains every value.
    """
    finite = np.all(np.isfinite(ends), axis=1)
    distances, (low, high) = np.zeros(len(ends)), ends[finite].T
    distances[finite] = TWO_SIDED * (low + high - 2 * truth[finite]) / (high - low)
    return distances


def _shown(plant: Plant) -> IntArray:
    """Places of the states whose gains the report shows, for a plant with one control."""
    return np.flatnonzero(~follows_command(plant))


def main() -> None:
    """Run the study and print its tables."""
    parser = argparse.ArgumentParser(description="Fits of simulated noisy subjects.")
    parser.add_argument("--subjects", type=int, default=100)
    parser.add_argument("--limits", type=float, nargs="+", default=[70.0, 6.0, 4.5])
    given = parser.parse_args()
    plant = seat(1, 1.0).problem.plant
    for limit in given.limits:
        study = functools.partial(simulated_subject, limit=limit)
        below, entries, directions = map(
            np.array, zip(*each(study, range(given.subjects)), strict=True)
        )
        print(f"\ntorque limit {limit:g} Nm, {len(below)} subjects (seeds from 0)")
        print(
            f"points below the ceiling: median {np.median(below):.3f}, most {np.max(below):.3f}\n"
        )
        names = [f"entry {plant.states[index]}" for index in _shown(plant)]
        names += [f"direction {index + 1}, best first" for index in range(directions.shape[1])]
        rows = [
            [name, f"{100 * np.mean(np.abs(errors) <= 3):.0f}", f"{np.std(errors):.2f}"]
            for name, errors in zip(names, np.hstack([entries, directions]).T, strict=True)
        ]
        print(markdown(["of the gain", "within 3 SE, %", "SD of error / SE"], rows))


if __name__ == "__main__":
    main()
