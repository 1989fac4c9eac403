"""Free one more unknown of a problem for a test: limit, delay, an error of a signal.

Limit and delay have a prior at the value of the model, wide compared with the precision of the
recordings.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from impc.arrays import frozen
from impc.checking import replace
from impc.inverse.problem import Problem
from impc.model.plant_family import DELAY, LIMIT, PlantFamily, plant_at

# Prior SDs: relative for the limit, in samples for the delay.
_LIMIT, _DELAY = 0.3, 1.0


def with_limit_unknown(problem: Problem) -> Problem | None:
    """Free the control limits; None if asymmetric or if commands are plant states."""
    bounds = problem.bounds
    if np.any(bounds.u_max != -bounds.u_min) or problem.plant.commands:
        return None
    family = replace(_family(problem), limit_deviation=_LIMIT).with_limits(problem.plant, bounds)
    return _posed(problem, family)


def with_free_limit(problem: Problem, control: int, start: float) -> Problem:
    """Free the symmetric limit of one control, from `start`; a stated one keeps its prior."""
    plant, name = problem.plant, f"{LIMIT}.{problem.plant.controls[control]}"
    if problem.family is not None and name in problem.parameter_names:
        index, logarithms = problem.parameter_names.index(name), np.array(problem.logarithms)
        logarithms[index] = np.log(start / problem.family.nominal[index])
        return problem.at(problem.starts, logarithms, problem.errors)
    family = _family(problem).wider([name], [start], [np.inf])
    bounds = family.bounds_at(plant, problem.bounds, np.append(problem.logarithms, 0.0))
    return _posed(problem, family, bounds=bounds)


def with_delay_unknown(problem: Problem) -> Problem | None:
    """Free a delay of the commands; None for plants that do not support it."""
    plant, m = problem.plant, problem.plant.m
    dressed = plant.ahead or plant.commands or np.any(plant.observer)
    if plant.body is not None or dressed or problem.terminal_weight is not None:
        return None
    if DELAY in problem.parameter_names:
        return None
    family = _family(problem).with_delay(_DELAY, plant.dt)
    none, far = np.zeros(m), np.full(m, np.inf)
    bounds = replace(
        problem.bounds,
        x_min=frozen(np.append(problem.bounds.x_min, -far)),
        x_max=frozen(np.append(problem.bounds.x_max, far)),
    )
    trials = [replace(trial, x0=frozen(np.append(trial.x0, none))) for trial in problem.recordings]
    structure = problem.structure
    if structure is not None:
        wider = np.hstack([structure.features, np.zeros((len(structure.features), m))])
        structure = replace(structure, features=frozen(wider))
    parts = {"bounds": bounds, "recordings": tuple(trials), "structure": structure}
    return _posed(problem, family, **parts)


def with_errors_unknown(problem: Problem, errors: Sequence[tuple[str, str]]) -> Problem:
    """Free errors of signals, pairs of a kind and a signal, in every trial; new ones last.

    The stated timing of these signals does not count.
    """
    known = (*problem.plant.outputs, *problem.plant.disturbances)
    places = [known.index(name) for kind, name in errors if kind == "shift"]
    trials = []
    for trial in problem.recordings:
        timing = np.array(trial.timing)
        timing[places] = 0.0
        trials.append(replace(trial, timing=frozen(timing)))
    pairs = tuple(dict.fromkeys([*problem.signal_errors, *errors]))
    return replace(problem, recordings=tuple(trials), signal_errors=pairs)


def _family(problem: Problem) -> PlantFamily:
    return problem.family or PlantFamily(lambda _: problem.plant, [], [])


def _posed(problem: Problem, family: PlantFamily, **parts: object) -> Problem:
    """Problem with a wider family; the further parameters start at their nominal values."""
    more = np.zeros(len(family.names) - len(problem.logarithms))
    logarithms = np.append(problem.logarithms, more)
    known = {"plant": plant_at(family, logarithms), "logarithms": frozen(logarithms)}
    return replace(problem, family=family, **known, **parts)
