"""Candidate experiments of a plan, simulated for the assumed subject (docs/howto/plan.md).

All experiments use the same random draws of the perturbation, scaled and held as specified. A trial
ends in a fall if no input keeps the bounds, if the motion has not decayed after a rest of the
length of the trial, or if an output exceeds its mechanical stop.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from impc.arrays import Array, BoolArray, Frozen, frozen
from impc.assess.expected import Expectation, expected_intervals
from impc.assess.printed_gain import follows_command
from impc.assess.variance_accounted_for import saturated_share
from impc.control.closed_loop import simulate
from impc.control.controller import Controller
from impc.control.simulation import scenario
from impc.errors import SolverError
from impc.inverse.problem import Problem
from impc.model.plant import Plant
from impc.model.plant_family import PlantFamily
from impc.model.recordings import Recording

#: (amplitude, hold time, number of the draw) -> disturbance (samples, d).
Perturbation = Callable[[float, float, int], Array]

# Share of the peak that may remain after a rest of the length of the trial.
_CALM = 0.5


@dataclass(frozen=True)
class Person(Frozen):
    """Assumed subject and recording noise."""

    controller: Controller
    deviation: Array  # SD of the recording noise (p,), in the units of the outputs
    root: float  # Correlation of the noise between neighbouring samples
    stops: Array  # Largest magnitude of each output (p,); infinite without a stop
    # Plant with physical parameters that the fit estimates too
    family: PlantFamily | None = None


@dataclass(frozen=True)
class Design:
    """One experiment."""

    amplitude: float  # Amplitude in the disturbance's unit; a factor for recorded perturbations
    dwell: float  # Hold time of each value, s; NaN for recorded perturbations


@dataclass(frozen=True)
class Outcome(Frozen):
    """Simulated outcome of an experiment."""

    design: Design
    falls: float  # Share of trials that end in a fall
    at_limit: float  # Share of samples with an input at its bound, in trials without a fall
    peaks: Array  # Largest magnitude of each output in these trials (p,)
    vaf: Array  # VAF of the true controller with recording noise, % (p,)
    # Noise-free recordings of the planned number of trials; None if too many trials end in a fall
    problem: Problem | None
    expected: Expectation | None  # Expected standard errors


def designs(amplitudes: Sequence[float], dwells: Sequence[float]) -> tuple[Design, ...]:
    """All pairs of amplitude and hold time; the amplitude varies fastest."""
    return tuple(Design(a, d) for d, a in itertools.product(dwells, amplitudes))


def try_design(
    person: Person, design: Design, perturbation: Perturbation, *, trials: int, draws: int
) -> Outcome:
    """Simulate one experiment and compute the expected intervals."""
    controller = person.controller
    plant, limits = controller.plant, controller.bounds
    numbers = range(max(draws, trials))
    tried = [_held(person, perturbation(design.amplitude, design.dwell, k)) for k in numbers]
    kept = [trial for trial in tried if trial is not None]
    falls = 1 - len(kept) / len(tried)
    if len(kept) < trials:
        nothing = frozen(np.full(len(plant.outputs), np.nan))
        return Outcome(design, falls, float("nan"), nothing, nothing, None, None)
    outputs = np.concatenate([trial.outputs for trial, _ in kept])
    power = np.mean(outputs**2, axis=0)
    sides = np.array(limits.u_min), np.array(limits.u_max)
    problem = _problem_of(person, [trial for trial, _ in kept[:trials]])
    return Outcome(
        design,
        falls,
        float(np.mean([saturated_share(inputs, *sides) for _, inputs in kept])),
        frozen(np.max(np.abs(outputs), axis=0)),
        frozen(100 * power / (power + person.deviation**2)),
        problem,
        expected_intervals(
            problem,
            controller.K,
            np.array(person.deviation),
            metric=controller.S,
            root=person.root,
        ),
    )


def _held(person: Person, push: Array) -> tuple[Recording, Array] | None:
    """Recording of a `push` (samples, d) and its inputs (samples, m); None for a fall."""
    plant, samples = person.controller.plant, len(push)
    alone = np.vstack([push, np.zeros_like(push)])
    run = simulate(person.controller, scenario(plant, np.zeros(plant.n), disturbance=alone))
    if not run.complete:
        return None
    motion = np.abs(run.x @ plant.C.T)
    peaks, end = np.max(motion[:samples], axis=0), np.max(motion[-samples // 10 :], axis=0)
    if np.any(peaks > person.stops) or np.any(end > _CALM * peaks):
        return None
    outputs = (run.x @ plant.C.T)[:samples]
    return Recording(plant, outputs, push, np.zeros(plant.n)), np.array(run.u)[:samples]


def _problem_of(person: Person, recordings: Sequence[Recording]) -> Problem:
    """Inverse problem of simulated trials."""
    controller = person.controller
    return Problem(
        controller.plant,
        controller.bounds,
        controller.horizon,
        recordings,
        terminal_set=controller.terminal is not None,
        unknown_start=True,
        family=person.family,
    )


def gain_places(plant: Plant) -> BoolArray:
    """Mask of the entries of a gain (m, n) whose single values have a meaning."""
    inner = follows_command(plant)
    return np.broadcast_to(~inner | np.all(inner), (plant.m, plant.n))


def relative_errors(person: Person, deviations: Array) -> Array:
    """Standard errors (..., m, n) of the gains that a plan shows, relative to them (..., k)."""
    shown, K = gain_places(person.controller.plant), np.array(person.controller.K)
    own = np.abs(K[shown])
    unknown = np.full(deviations[..., shown].shape, np.inf)
    return np.asarray(np.divide(deviations[..., shown], own, out=unknown, where=own > 0))


def best_of(person: Person, outcomes: Sequence[Outcome], falls: float) -> Outcome:
    """Experiment with the smallest mean variance of the gains, among those with few enough falls.

    Variances are relative to the gain and, for a mean that exists if nothing is known of a gain,
    those after a prior with an SD of the gain's size.
    """
    held = []
    for item in outcomes:
        if item.expected is not None and item.falls <= falls:
            errors = relative_errors(person, np.array(item.expected.gain.entries))
            held.append((float(np.mean(1 / (1 + np.maximum(errors, 1e-100) ** -2))), item))
    if not held:
        least = min(item.falls for item in outcomes)
        raise SolverError(
            "[plan]",
            f"in every experiment the simulated subject falls in at least {100 * least:.0f} % of "
            "the trials",
            "reduce amplitude, or increase u_max or the allowed share falls",
        )
    return min(held, key=lambda pair: pair[0])[1]
