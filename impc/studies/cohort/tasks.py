"""Tasks of a study: the fit of each unit, and its bootstrap replicates.

A task contains file names and settings; workers read the recordings and cache the last few. Results
do not depend on the order of tasks or the number of workers.
"""

from __future__ import annotations

import functools
import inspect
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import psutil

from impc.arrays import frozen
from impc.assess.assessments import assessed, evaluate_method
from impc.assess.covariance import TWO_SIDED
from impc.assess.intent import intent
from impc.assess.lack_of_fit import lack_of_fit
from impc.assess.printed_gain import covariance_intervals, gain_estimate
from impc.assess.resampling import replicate
from impc.assess.structures import assess_structure
from impc.assess.variance_accounted_for import left_out, saturated_share
from impc.assess.weights_test import weights_test
from impc.checking import replace
from impc.errors import DataError, ImpcError, SolverError, WeightsError
from impc.files.digests import content_digest, digest, source_digest, versions
from impc.files.plant_sources import plant_source
from impc.files.reading import read_unit
from impc.inverse.noisy_fit import fit_controller
from impc.inverse.structured import fit_structured
from impc.model.plant import gain_unit, weight_unit
from impc.reporting.rendering import plain
from impc.reporting.shown_units import angles_in, shown_unit, signal_name
from impc.studies.cohort.unit_verdict import unit_verdict
from impc.studies.effort import Effort, fit_effort
from impc.studies.fit.asked import asked_plant, fit_structures
from impc.studies.fit.settings import fit_settings
from impc.studies.fit.subject import fit_problem, state_sizes

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from impc.arrays import Array
    from impc.assess.assessments import MethodFit
    from impc.assess.printed_gain import GainEstimate
    from impc.files.configuration import Configuration
    from impc.files.plant_sources import PlantSource
    from impc.inverse.estimates import Estimate
    from impc.inverse.problem import Problem
    from impc.model.plant import Plant
    from impc.studies.cohort.study import Study
    from impc.studies.fit.settings import FitSettings


@dataclass(frozen=True)
class FitTask:
    """Inputs of the fit of a unit."""

    files: tuple[str, ...]  # Paths of the recordings
    plant: str  # Import path or file of the plant
    arguments: dict[str, Any] = field(hash=False)  # Arguments of the plant
    configuration: Configuration = field(hash=False)
    digest: str = ""  # Digest of all these and of the content of the files


def study_tasks(study: Study, source: PlantSource) -> tuple[dict[str, FitTask], dict[str, str]]:
    """Tasks by unit, and reasons for units without a task; reads all files for the digests."""
    unused = set(unused_columns(study, source))
    tasks: dict[str, FitTask] = {}
    failed: dict[str, str] = {}
    for unit in study.units:
        person = {name: value for name, value in unit.person.items() if name not in unused}
        arguments = dict(study.configuration.plant) | person
        files = tuple(str(file.resolve()) for file in unit.files)
        try:
            made_of = unit_digest(files, source.name, arguments, study.configuration)
        except DataError as error:
            failed[unit.name] = str(error)
        else:
            tasks[unit.name] = FitTask(files, source.name, arguments, study.configuration, made_of)
    return tasks, failed


def unused_columns(study: Study, source: PlantSource) -> tuple[str, ...]:
    """Columns of the participants that are not arguments of the plant."""
    names = {name: None for unit in study.units for name in unit.person}
    if ":" not in source.name:  # a file with matrices has no arguments
        return tuple(names)
    taken = inspect.signature(source.make).parameters
    if any(one.kind is inspect.Parameter.VAR_KEYWORD for one in taken.values()):
        return ()
    return tuple(name for name in names if name not in taken)


def unit_digest(
    files: Sequence[str], plant: str, arguments: Mapping[str, Any], configuration: Configuration
) -> str:
    """Digest of the recordings' content, plant, settings and versions."""
    return digest(
        [(Path(Path(name).name), content_digest(Path(name))) for name in files],
        source_digest(plant, arguments),
        dict(arguments),
        configuration.recording,
        configuration.signals,
        # The number of replicates does not affect any result.
        {key: value for key, value in configuration.fit.items() if key != "replicates"},
        versions(),
    )


def fit_unit(task: FitTask) -> dict[str, Any]:
    """Fit a unit."""
    started = time.perf_counter()
    problem, settings = unit_problem(task)
    fitted = fit_controller(problem)
    with angles_in(task.configuration.report.angles):
        content = _described(problem, fitted, settings)
    return _finished(content, started)


def replicate_unit(task: FitTask, fit: dict[str, Any], index: int) -> dict[str, Any]:
    """Bootstrap replicate `index` of a unit with the stored `fit`."""
    started = time.perf_counter()
    problem, settings = unit_problem(task)
    here = problem.at(*(np.array(fit[name]) for name in ("starts", "logarithms", "errors")))
    found = replicate(here, np.array(fit["K"]), np.array(fit["S"]), index, settings.seed)
    return _finished({"K": found.K, "parameters": found.parameters}, started)


def _finished(content: dict[str, Any], started: float) -> dict[str, Any]:
    memory = psutil.Process().memory_info().rss / 1e6
    used = {"seconds": time.perf_counter() - started, "memory_mb": memory}
    found: dict[str, Any] = plain(content | used)
    return found


@functools.lru_cache(maxsize=4)
def unit_problem(task: FitTask) -> tuple[Problem, FitSettings]:
    """Inverse problem of a unit; cached."""
    settings = fit_settings(task.configuration.fit)
    source = plant_source(task.plant, task.arguments)
    # A worker on another machine, or one that was started earlier, may have other files or code.
    here = unit_digest(task.files, source.name, task.arguments, task.configuration)
    if here != task.digest:
        raise DataError(
            "worker",
            "has other recordings, another plant or other versions than this command",
            "copy the same files and versions to all machines, and restart the workers",
        )
    configuration = task.configuration
    plant, family = asked_plant(source, configuration.recorded, settings, configuration.aimed)
    paths = [Path(name) for name in task.files]
    read, fallen = read_unit(paths, configuration, plant)
    if not read:
        raise fallen[0]
    first, *others = read
    left = (f"{fall.subject}: {fall.problem}; the trial is left out" for fall in fallen)
    recordings = (replace(first, findings=(*first.findings, *left)), *others)
    return fit_problem(plant, recordings, settings, family), settings


def study_effort(tasks: Mapping[str, FitTask]) -> tuple[Effort, float]:
    """Effort of the first readable unit, and the number of such units that all `tasks` equal.

    Units are compared by the size of their files. Without a readable unit the effort is zero.
    """
    sizes = {
        name: sum(Path(file).stat().st_size for file in task.files) for name, task in tasks.items()
    }
    for name, task in tasks.items():
        try:
            problem, settings = unit_problem(task)
        except ImpcError:  # reported when the unit is fitted
            continue
        alone = replace(settings, profiles=[], horizons=[], unknown_limit=False)
        return fit_effort(problem, alone), sum(sizes.values()) / max(sizes[name], 1)
    return Effort(0.0, 0.0), 0.0


def _described(problem: Problem, fitted: Estimate, settings: FitSettings) -> dict[str, Any]:
    plant, K, weights = fitted.problem.plant, np.array(fitted.gain), fitted.stage_weights
    fit = evaluate_method(fitted, problem.bounds)
    estimate = gain_estimate(fitted)
    fit = replace(fit, held_out=_held_out(fitted, estimate, settings))
    sizes = state_sizes(fit.runs)
    readings = intent(plant, K, np.array(fitted.metrics), sizes, weights)
    family = estimate.problem.family
    known = () if family is None else family.names
    try:
        lack = lack_of_fit(estimate)
    except (ImpcError, np.linalg.LinAlgError):
        lack = None
    test = weights_test(fitted, estimate, contradicted=lack is not None and lack.alarm)
    found = covariance_intervals(estimate, estimate.covariance, "sandwich")[: K.size]
    determined = any(one.determined for one in found)
    halves = np.array([(one.high - one.low) / 2 for one in found])
    limits = np.array(problem.bounds.u_min), np.array(problem.bounds.u_max)
    saturated = saturated_share(fit.commands, *limits)
    return {
        **_named(plant),
        "verdict": unit_verdict(fit, lack, test, saturated, determined).data(),
        "trials": len(problem.recordings),
        "samples": sum(trial.samples for trial in problem.recordings),
        "K": estimate.K,
        "S": estimate.S,
        "K_deviation": (halves / TWO_SIDED).reshape(K.shape),
        "K_identified": estimate.covariance.individually_identified,
        "K_of_weights": K,
        "Q": weights.Q,
        "R": weights.R,
        "misfit": fitted.misfit,
        "exact": fitted.explained,
        "converged": fitted.converged,
        **assessed(fit),
        "saturated": saturated,
        "fell": fit.fell,
        "limit": np.max(np.abs(limits), axis=0),
        "state_sizes": sizes,
        "readings": {
            item.rule: {"Q": item.weights.Q, "dominant": item.dominant, "angle": item.angle}
            for item in readings.readings
        },
        "parameters": dict(zip(known, estimate.parameters, strict=True)),
        "starts": [trial.x0 for trial in estimate.problem.recordings],
        "logarithms": estimate.problem.logarithms,
        "errors": estimate.problem.errors,
        "findings": [trial.findings for trial in problem.recordings],
        "trajectory": _trajectory(fit),
        "structure": _structure(problem, fitted, settings),
    }


def _named(plant: Plant) -> dict[str, Any]:
    """Names and units for the pages of a cohort."""
    names = (*plant.outputs, *plant.states, *plant.controls)
    units = {
        f"K.{control}.{state}": gain_unit(plant, control, state)
        for control in plant.controls
        for state in plant.states
    } | {f"centre_weight.{name}": weight_unit(plant, name, name) for name in plant.states}
    return {
        "states": plant.states,
        "controls": plant.controls,
        "outputs": plant.outputs,
        "shown_units": [shown_unit(plant, name) for name in plant.outputs],
        "words": {name: signal_name(plant, name) for name in names},
        # Units of the compared measures, by their columns in units.csv.
        "units": {name: "-" if unit == "1" else unit for name, unit in units.items()},
    }


def _trajectory(fit: MethodFit) -> dict[str, Any]:
    """Thinned recorded and modelled outputs of the first trial."""
    plant, first = fit.estimate.problem.plant, fit.estimate.problem.recordings[0]
    step = max(1, first.samples // 600)
    return {
        "dt": plant.dt * step,
        "recorded": first.corrected[::step],
        "simulated": (fit.runs[0].x @ plant.C.T)[::step],
    }


def _held_out(fitted: Estimate, estimate: GainEstimate, settings: FitSettings) -> Array:
    """VAF (trials, p) of each left-out trial, %; no rows if not requested or for one trial."""
    count = len(fitted.problem.recordings)
    found = [
        left_out(fitted, estimate, index, settings.settle).vaf
        for index in range(count if settings.held_out and count > 1 else 0)
    ]
    return frozen(np.reshape(found, (-1, len(fitted.problem.plant.outputs))))


def _structure(problem: Problem, fitted: Estimate, settings: FitSettings) -> dict[str, Any] | None:
    """Logarithms of cost weights with 95 % intervals; None if no structure is requested."""
    if settings.structure is None:
        return None
    structure = fit_structures(problem.plant, settings)[0]
    record: dict[str, Any] = {"name": structure.name, "unknowns": structure.unknowns}
    try:
        found = fit_structured(problem, structure, fitted)
        fit = assess_structure(problem, structure, found, fitted, settings.settle, held_out=False)
    except (SolverError, WeightsError) as error:
        nothing = [np.nan] * structure.count
        ends = dict.fromkeys(("log_cost_weight", "low", "high"), nothing)
        return record | ends | {"refused": True, "p": np.nan, "reason": str(error)}
    return record | {
        "log_cost_weight": [item.value for item in fit.intervals],
        "low": [item.low for item in fit.intervals],
        "high": [item.high for item in fit.intervals],
        "refused": fit.refused,
        "p": np.nan if fit.test is None else fit.test.probability,
        "reason": "",
    }
