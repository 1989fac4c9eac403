"""Registry of the measures computed for every estimate, independent of its method.

`impc fit`, `impc compare`, `impc cohort` and `impc.report` print them in their tables and write
them to result.json under `methods.<method>.<assessment>` (docs/ref/results.md). For analyses that
need further fits (intervals, other horizons) see `impc.studies.fit.uncertainty`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from impc.arrays import Array, Frozen, frozen
from impc.assess.variance_accounted_for import explained_share
from impc.control.simulation import Simulation
from impc.inverse.estimates import Estimate
from impc.model.bounds import Bounds
from impc.model.plant import Plant
from impc.model.recordings import Recording
from impc.model.weights import condition_number


@dataclass(frozen=True)
class MethodFit(Frozen):
    """One method on all recordings."""

    estimate: Estimate  # Estimate; its problem has the bounds that the method uses
    bounds: Bounds  # Bounds of the subject
    runs: tuple[Simulation, ...]  # One per trial; empty without a gain
    vaf: Array  # (3.24) over all trials, % (p,); NaN if a simulation stops early
    trial_vaf: Array  # (trials, p), per trial
    # (trials, p), VAF of each trial predicted from the others; NaN without a gain or if the
    # simulation stops early; (0, p) if not computed, as by `evaluate_method`
    held_out: Array
    largest_input: Array  # Largest magnitude of each input (m,)
    # Share of simulated samples that exceed an input bound by more than 1e-6 of it
    exceeded: float
    # Time in s at which the simulation of each trial stopped early; None if complete
    fell: tuple[float | None, ...]

    @property
    def name(self) -> str:
        """Name of the method."""
        return self.estimate.method

    @property
    def keeps_bounds(self) -> bool:
        """Whether there is a gain and it never exceeds an input bound."""
        return self.estimate.K is not None and self.exceeded == 0

    @property
    def commands(self) -> Array:
        """Commands of all simulated samples (samples, m), in input units."""
        none = np.empty((0, self.estimate.problem.plant.m))
        return np.concatenate([none, *(run.applied for run in self.runs)])


def evaluate_method(estimate: Estimate, bounds: Bounds) -> MethodFit:
    """Simulate all recordings with an estimate."""
    problem, runs = estimate.problem, () if estimate.K is None else estimate.simulations
    plant, trials, p = problem.plant, problem.recordings, len(problem.plant.outputs)
    commands = np.concatenate([np.empty((0, plant.m)), *(run.applied for run in runs)])
    beyond = (commands > bounds.u_max + 1e-6 * np.abs(bounds.u_max)) | (
        commands < bounds.u_min - 1e-6 * np.abs(bounds.u_min)
    )
    largest = np.max(np.abs(commands), axis=0, initial=0.0) if runs else np.full(plant.m, np.nan)
    each = [simulated_vaf(plant, (one,), (run,)) for one, run in zip(trials, runs, strict=False)]
    return MethodFit(
        estimate,
        bounds,
        runs,
        frozen(simulated_vaf(plant, trials, runs) if runs else np.full(p, np.nan)),
        frozen(each or np.full((len(trials), p), np.nan)),
        frozen(np.empty((0, p))),
        frozen(largest),
        float(np.count_nonzero(np.any(beyond, axis=1)) / max(len(commands), 1)),
        tuple(None if run.complete else run.reached * plant.dt for run in runs)
        or (None,) * len(trials),
    )


def estimate_vaf(estimate: Estimate) -> Array:
    """Variance accounted for (3.24) of each output over all trials, in %, shape (p,)."""
    return evaluate_method(estimate, estimate.problem.bounds).vaf


def simulated_vaf(plant: Plant, trials: Sequence[Recording], runs: Sequence[Simulation]) -> Array:
    """VAF (3.24) over trials (p,), NaN if a simulation stops early."""
    if not all(run.complete for run in runs):
        return np.full(len(plant.outputs), np.nan)
    return explained_share(
        [trial.outputs for trial in trials],
        [trial.corrected for trial in trials],
        [run.x @ plant.C.T for run in runs],
    )


@dataclass(frozen=True)
class Assessment:
    """One measure of an estimate and its simulation of all trials (docs/ref/results.md)."""

    name: str  # Key in result.json and head of CSV columns
    sentence: str  # Explanation for readers who do not know it
    # Plant -> names of the k signals with a value: outputs, inputs, or `whole` for a single value
    signals: Callable[[Plant], tuple[str, ...]]
    find: Callable[[MethodFit], Array]  # MethodFit -> values (k,); NaN if undefined

    def keys(self, plant: Plant) -> list[str]:
        """Column names in a table."""
        return [f"{self.name}_{name}".rstrip("_") for name in self.signals(plant)]


def _held_out(fit: MethodFit) -> Array:
    """Mean over held-out trials."""
    missing = np.full(fit.vaf.shape, np.nan)
    return np.mean(fit.held_out, axis=0) if len(fit.held_out) else missing


def whole(_: Plant) -> tuple[str, ...]:
    """A single value for the method."""
    return ("",)


def _first_fall(fit: MethodFit) -> Array:
    return np.array([min((time for time in fit.fell if time is not None), default=np.nan)])


def _condition(fit: MethodFit) -> Array:
    weights = fit.estimate.weights
    return np.array([np.nan if weights is None else condition_number(weights)])


#: Measures by name, in the order of the tables.
ASSESSMENTS: dict[str, Assessment] = {
    item.name: item
    for item in (
        Assessment(
            "vaf",
            "Variance accounted for, over all trials, %.",
            lambda plant: plant.outputs,
            lambda fit: fit.vaf,
        ),
        Assessment(
            "held_out_vaf",
            "VAF of each trial predicted from the other trials, without the first part of the "
            "trial, which serves to estimate its initial state; mean over trials, %.",
            lambda plant: plant.outputs,
            _held_out,
        ),
        Assessment(
            "largest_input",
            "Largest magnitude of the input, in its unit.",
            lambda plant: plant.controls,
            lambda fit: fit.largest_input,
        ),
        Assessment(
            "beyond_bound",
            "Share of the time beyond the limit of an input, %.",
            whole,
            lambda fit: np.array([np.nan if fit.estimate.K is None else 100 * fit.exceeded]),
        ),
        Assessment(
            "first_fall",
            "Time at which the first simulated trial stops before its end, s.",
            whole,
            _first_fall,
        ),
        Assessment(
            "condition_number",
            "Largest over smallest eigenvalue of blkdiag(Q, R), in the units of the plant.",
            whole,
            _condition,
        ),
    )
}


def assessed(fit: MethodFit) -> Mapping[str, dict[str, float] | float]:
    """All measures of a method by name: a number, or one number per signal."""
    plant = fit.estimate.problem.plant
    found: dict[str, dict[str, float] | float] = {}
    for item in ASSESSMENTS.values():
        signals, values = item.signals(plant), [float(value) for value in item.find(fit)]
        found[item.name] = (
            values[0] if signals == ("",) else dict(zip(signals, values, strict=True))
        )
    return found
