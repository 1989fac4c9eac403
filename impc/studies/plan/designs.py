"""The experiments to choose from, each tried on the presumed person.

Every experiment sees the same draws of the perturbation, scaled and held as it says, so that what
differs between two is the experiment. A person falls when no input keeps the bounds, when the
motion grows without end, or when an output passes its mechanical stop.
See docs/planning.md.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Array, Frozen, frozen
from impc.assess.expected import Expectation, expected_intervals
from impc.assess.variance_accounted_for import saturated_share
from impc.control.closed_loop import simulate
from impc.control.simulation import scenario
from impc.errors import SolverError
from impc.inverse.problem import Problem
from impc.model.recordings import Recording

if TYPE_CHECKING:
    from collections.abc import Sequence

    from impc.control.controller import Controller
    from impc.model.plant_family import PlantFamily
    from impc.model.structure import Structure


#: (amplitude, dwell, number of the draw) -> disturbance (samples, d).
Perturbation = Callable[[float, float, int], Array]

# Of the largest motion: what may be left of it after a rest that is as long as the trial.
_CALM = 0.5


@dataclass(frozen=True)
class Person(Frozen):
    """The presumed person, and how they would be recorded."""

    controller: Controller
    structure: Structure  # Of the weights
    cost_weights: Array  # Its unknowns (count,), logarithms
    deviation: Array  # Of the noise in the recorder (p,), in the outputs' units
    root: float  # Its correlation from one sample to the next
    stops: Array  # Largest magnitude of each output (p,), infinite where there is no stop
    # With the physical parameters that a fit would have to find too
    family: PlantFamily | None = None


@dataclass(frozen=True)
class Design:
    """One experiment."""

    amplitude: float  # Of the perturbation, in the disturbance's unit; a factor for one from a file
    dwell: float  # For how long each value is kept, s; NaN for one from a file


@dataclass(frozen=True)
class Outcome(Frozen):
    """What an experiment would give."""

    design: Design
    falls: float  # Share of the trials that end in a fall
    # Share of the samples at which an input stands on a bound, in trials without a fall
    at_limit: float
    peaks: Array  # Largest magnitude of each output in these (p,)
    vaf: Array  # What a fit without an error would explain of each output, % (p,)
    # The recordings, without noise, of so many trials as a person does; None where too few trials
    # end without a fall
    problem: Problem | None
    expected: Expectation | None  # What they would identify


def designs(amplitudes: Sequence[float], dwells: Sequence[float]) -> tuple[Design, ...]:
    """All pairs, amplitudes within dwells."""
    return tuple(Design(a, d) for d, a in itertools.product(dwells, amplitudes))


def try_design(
    person: Person, design: Design, perturbation: Perturbation, *, trials: int, draws: int
) -> Outcome:
    """Simulate one experiment, and say what its recordings would; `perturbation` (samples, d)."""
    plant, limits = person.controller.plant, person.controller.bounds
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
            problem, np.array(person.cost_weights), np.array(person.deviation), root=person.root
        ),
    )


def _held(person: Person, push: Array) -> tuple[Recording, Array] | None:
    """The recording of a `push` (samples, d) and its inputs (samples, m), or None for a fall."""
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
    """The inverse problem of simulated trials."""
    controller = person.controller
    return Problem(
        controller.plant,
        controller.bounds,
        controller.horizon,
        recordings,
        terminal_set=controller.terminal is not None,
        unknown_start=True,
        family=person.family,
        structure=person.structure,
    )


def best_of(outcomes: Sequence[Outcome], falls: float) -> tuple[Outcome, Outcome]:
    """The A-optimal experiment and the D-optimal one."""
    held = [
        (item, item.expected)
        for item in outcomes
        if item.expected is not None and item.falls <= falls
    ]
    if not held:
        least = min(item.falls for item in outcomes)
        raise SolverError(
            "[plan]",
            f"the person falls in {100 * least:.0f} % of the trials or more, whatever the "
            "perturbation",
            "lower amplitude, or raise u_max or falls",
        )
    return (
        min(held, key=lambda pair: pair[1].mean_variance)[0],
        min(held, key=lambda pair: pair[1].log_determinant)[0],
    )
