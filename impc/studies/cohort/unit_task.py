"""What a worker does: the fit of a unit, and one bootstrap replicate of it.

Tasks carry file names and settings; a worker reads the recordings itself and keeps the last few.
What comes back is JSON, so that a result is the same whether it comes from a worker or from the
folder. Nothing here depends on the order of tasks or on how many workers there are.
"""

from __future__ import annotations

import functools
import os
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import psutil

from impc.assess.held_out import predict
from impc.assess.intent_rules import intent
from impc.assess.judged import judge
from impc.assess.printed_gain import gain_estimate
from impc.assess.resampling import DRAWS, replicate
from impc.checking import replace
from impc.control.closed_loop import simulate
from impc.errors import ImpcError
from impc.files.plant_sources import make_plant, plant_family_of, plant_source
from impc.files.reading import read_recordings
from impc.inverse.noisy_fit import fit_controller
from impc.inverse.problem import controller_for, scenarios
from impc.model.weights import Weights
from impc.reporting.rendering import plain
from impc.studies.cohort.unit_digest import require_same_inputs, unit_digest
from impc.studies.fit.settings import fit_settings
from impc.studies.fit.subject import fit_problem

if TYPE_CHECKING:
    from impc.arrays import Array
    from impc.files.configuration import Configuration
    from impc.inverse.noisy_fit import FittedController
    from impc.inverse.problem import Problem
    from impc.studies.fit.settings import FitSettings

__all__ = ["FitTask", "fit_unit", "replicate_unit"]

# Points of a trajectory that are kept for pictures.
_SHOWN = 600


@dataclass(frozen=True)
class FitTask:
    """All that a worker needs of a unit.

    Attributes
    ----------
    files : tuple of str
        Paths of the recordings.
    plant : str
        Its import path or file.
    arguments : dict
        Of the plant.
    configuration : Configuration
    digest : str
        Of all of these and of the files' content.
    """

    files: tuple[str, ...]
    plant: str
    arguments: dict[str, Any] = field(hash=False)
    configuration: Configuration = field(hash=False)
    digest: str = ""


def fit_unit(task: FitTask) -> dict[str, Any]:
    """Fit a unit; {"reason": ...} when it cannot be fitted."""
    started = time.perf_counter()
    try:
        problem, settings = _problem(task)
        fitted = fit_controller(problem)
        content = _described(problem, fitted, settings)
    except ImpcError as error:
        return {"reason": str(error)}
    content["seconds"] = time.perf_counter() - started
    content["memory_mb"] = _memory()
    found: dict[str, Any] = plain(content)
    return found


def replicate_unit(task: FitTask, fit: dict[str, Any], index: int) -> dict[str, Any]:
    """One bootstrap replicate of a fitted unit, by its number `index`; `fit` is its content."""
    started = time.perf_counter()
    try:
        problem, settings = _problem(task)
        here = problem.at(np.array(fit["starts"]), np.array(fit["logarithms"]))
        found = replicate(
            here,
            np.array(fit["K"]),
            np.array(fit["S"]),
            Weights(fit["Q"], fit["R"]),
            index,
            settings.seed,
            DRAWS[settings.bootstrap],
        )
    except ImpcError as error:
        return {"reason": str(error)}
    content = {
        "K": found.K,
        "parameters": found.parameters,
        "seconds": time.perf_counter() - started,
        "memory_mb": _memory(),
    }
    result: dict[str, Any] = plain(content)
    return result


@functools.lru_cache(maxsize=4)
def _problem(task: FitTask) -> tuple[Problem, FitSettings]:
    settings = fit_settings(task.configuration.fit)
    source = plant_source(task.plant, task.arguments)
    # A worker on another machine, or one that has run for days, may have other files and code.
    here = unit_digest(task.files, source.name, task.arguments, task.configuration)
    require_same_inputs(here, task.digest)
    recorded = tuple(task.configuration.signals)
    plant = make_plant(source, recorded)
    family = plant_family_of(source, recorded, settings.free)
    recordings = read_recordings([Path(name) for name in task.files], task.configuration, plant)
    return fit_problem(plant, recordings, settings, family), settings


def _described(problem: Problem, fitted: FittedController, settings: FitSettings) -> dict[str, Any]:
    known = replace(fitted.problem, unknown_start=False, family=None, logarithms=np.zeros(0))
    plant, K, S = known.plant, np.array(fitted.solution.K), np.array(fitted.solution.S)
    fit = judge("inverse_mpc", known, problem.bounds, K, S, weights=fitted.weights, seconds=0.0)
    estimate = gain_estimate(fitted)
    sizes = np.sqrt(np.mean(np.concatenate([run.x for run in fit.runs]) ** 2, axis=0))
    moving = sizes[sizes > 0]
    sizes = np.maximum(sizes, np.min(moving) if len(moving) else 1.0)
    readings = intent(plant, K, np.array(fitted.metrics), sizes, fitted.weights)
    family = estimate.problem.family
    names = () if family is None else family.names
    limit = np.minimum(np.abs(problem.bounds.u_max), np.abs(problem.bounds.u_min))
    commands = np.concatenate([np.abs(run.u) for run in fit.runs])
    return {
        "states": plant.states,
        "controls": plant.controls,
        "outputs": plant.outputs,
        "trials": len(problem.recordings),
        "samples": sum(trial.samples for trial in problem.recordings),
        "K": estimate.K,
        "S": estimate.S,
        "K_deviation": estimate.covariance.entries,
        "K_told": estimate.covariance.told_entries,
        "K_of_weights": K,
        "Q": fitted.weights.Q,
        "R": fitted.weights.R,
        "misfit": fitted.misfit,
        "exact": fitted.exact,
        "converged": fitted.converged,
        "vaf": dict(zip(plant.outputs, fit.vaf, strict=True)),
        "held_out_vaf": dict(zip(plant.outputs, _held_out(problem, fitted, settings), strict=True)),
        "saturated": float(np.mean(np.any(commands >= limit * (1 - 1e-6), axis=1))),
        "state_sizes": sizes,
        "readings": {
            item.rule: {"Q": item.weights.Q, "dominant": item.dominant, "angle": item.angle}
            for item in readings.readings
        },
        "parameters": dict(zip(names, estimate.parameters, strict=True)),
        "starts": [trial.x0 for trial in estimate.problem.recordings],
        "logarithms": estimate.problem.logarithms,
        "findings": [trial.findings for trial in problem.recordings],
        "trajectory": _trajectory(known, fitted),
    }


def _held_out(problem: Problem, fitted: FittedController, settings: FitSettings) -> Array:
    """Mean VAF over trials left out, %; NaN when they are not wanted or there is but one."""
    count = len(problem.recordings)
    if not settings.held_out or count < 2:
        return np.full(len(problem.plant.outputs), np.nan)
    shares = []
    for index in range(count):
        others = problem.recordings[:index] + problem.recordings[index + 1 :]
        other = fit_controller(replace(problem, recordings=others))
        shares.append(predict(problem, other, fitted, index, settings.settle).vaf)
    return np.asarray(np.mean(shares, axis=0))


def _trajectory(known: Problem, fitted: FittedController) -> dict[str, Any]:
    """Recorded and simulated outputs of the first trial, a few hundred points."""
    one = replace(known, recordings=known.recordings[:1])
    controller = controller_for(one, np.array(fitted.solution.K), np.array(fitted.solution.S))
    run = simulate(controller, scenarios(one)[0])
    trial = one.recordings[0]
    step = max(1, trial.samples // _SHOWN)
    return {
        "dt": known.plant.dt * step,
        "recorded": trial.outputs[::step],
        "simulated": (run.x @ known.plant.C.T)[::step],
    }


def _memory() -> float:
    return float(psutil.Process(os.getpid()).memory_info().rss / 1e6)
