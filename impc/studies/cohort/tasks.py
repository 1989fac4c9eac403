"""Tasks of a study: the fit of each unit, and its bootstrap replicates.

A task contains file names and settings; workers read the recordings and cache the last few. Results
do not depend on the order of tasks or the number of workers.
"""

from __future__ import annotations

import functools
import inspect
import itertools
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import psutil

from impc.assess.assessments import assessed
from impc.assess.covariance import TWO_SIDED
from impc.assess.printed_gain import follows_command
from impc.assess.resampling import replicate
from impc.checking import replace
from impc.errors import DataError, ImpcError
from impc.files.configuration import FILL_IN
from impc.files.digests import content_digest, digest, source_digest, versions
from impc.files.plant_sources import made_by, plant_source
from impc.files.reading import read_unit
from impc.model.plant import UNKNOWN, gain_unit, weight_unit
from impc.reporting.rendering import plain
from impc.reporting.shown_units import angles_in, shown_unit, signal_name
from impc.studies.cohort.participants import require_faultless
from impc.studies.effort import Effort, fit_effort
from impc.studies.fit.asked import asked_plant, fit_problem
from impc.studies.fit.facts import one_of
from impc.studies.fit.settings import fit_settings
from impc.studies.fit.subject import fit_alone
from impc.studies.fit.verdict import fit_verdict

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from impc.assess.assessments import MethodFit
    from impc.files.configuration import Configuration
    from impc.files.plant_sources import PlantSource
    from impc.inverse.problem import Problem
    from impc.model.plant import Plant
    from impc.studies.cohort.study import Study
    from impc.studies.fit.result import FitResult
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
    """Tasks by unit, and reasons for units without a task; reads all files for the digests.

    InputError if the plant refuses the values of a participant.
    """
    unused = set(unused_columns(study, source))
    tasks: dict[str, FitTask] = {}
    failed: dict[str, str] = {}
    refused: dict[str, list[str]] = {}  # Reason -> rows of participants
    made: set[int] = set()
    for unit in study.units:
        person = {name: value for name, value in unit.person.items() if name not in unused}
        arguments = dict(study.configuration.plant) | person
        if person and unit.row not in made:
            made.add(unit.row)
            try:
                made_by(replace(source, arguments=arguments))
            except ImpcError as error:
                refused.setdefault(error.problem, []).append(f"row {unit.row} ({unit.subject})")
        files = tuple(str(file.resolve()) for file in unit.files)
        try:
            made_of = unit_digest(files, source.name, arguments, study.configuration)
        except DataError as error:
            failed[unit.name] = str(error)
        else:
            tasks[unit.name] = FitTask(files, source.name, arguments, study.configuration, made_of)
    faults = [f"{', '.join(rows)}: plant {source.name} {why}" for why, rows in refused.items()]
    require_faultless("participants", faults)
    return tasks, failed


def unused_columns(study: Study, source: PlantSource) -> tuple[str, ...]:
    """Columns of the participants that are not arguments of the plant."""
    names = {name: None for unit in study.units for name in unit.person}
    if not names or ":" not in source.name:  # a file with matrices has no arguments
        return tuple(names)
    kinds = {one.kind for one in inspect.signature(source.make).parameters.values()}
    taken = source.defaults()
    if inspect.Parameter.VAR_KEYWORD in kinds:  # then the plant lists its parameters
        first = next(unit.person for unit in study.units if unit.person)
        needed = {name: value for name, value in first.items() if taken.get(name) == FILL_IN}
        made = made_by(replace(source, arguments={**source.arguments, **needed}))
        taken |= getattr(made, "parameters", {})
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
    problem, settings, falls = unit_problem(task)
    with angles_in(task.configuration.report.angles):
        content = _described(replace(fit_alone(problem, settings), falls=falls))
    return _finished(content, started)


def replicate_unit(task: FitTask, fit: dict[str, Any], index: int) -> dict[str, Any]:
    """Bootstrap replicate `index` of a unit with the stored `fit`."""
    started = time.perf_counter()
    problem, settings, _ = unit_problem(task)
    if fit["added"]:
        raise DataError(
            "bootstrap", f"the fit has one more unknown ({fit['added']})", "correct the recordings"
        )
    here = problem.at(*(np.array(fit[name]) for name in ("starts", "logarithms", "errors")))
    found = replicate(here, np.array(fit["K"]), np.array(fit["S"]), index, settings.seed)
    return _finished({"K": found.K, "parameters": found.parameters}, started)


def _finished(content: dict[str, Any], started: float) -> dict[str, Any]:
    memory = psutil.Process().memory_info().rss / 1e6
    used = {"seconds": time.perf_counter() - started, "memory_mb": memory}
    found: dict[str, Any] = plain(content | used)
    return found


@functools.lru_cache(maxsize=4)
def unit_problem(task: FitTask) -> tuple[Problem, FitSettings, tuple[str, ...]]:
    """Inverse problem of a unit, its settings, and trials that ended in a fall; cached."""
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
    falls = tuple(f"{fall.subject}: {fall.problem}" for fall in fallen)
    left = (f"{fall}; the trial is left out" for fall in falls)
    recordings = (replace(first, findings=(*first.findings, *left)), *others)
    return fit_problem(plant, recordings, settings, family), settings, falls


def study_effort(tasks: Mapping[str, FitTask]) -> tuple[Effort, float]:
    """Effort of the first readable unit, and the number of such units that all `tasks` equal.

    Units are compared by the size of their files. Without a readable unit the effort is zero.
    """
    sizes = {
        name: sum(Path(file).stat().st_size for file in task.files) for name, task in tasks.items()
    }
    for name, task in tasks.items():
        try:
            problem, settings, _ = unit_problem(task)
        except ImpcError:  # reported when the unit is fitted
            continue
        alone = replace(settings, profiles=[], horizons=[], unknown_limit=False)
        return fit_effort(problem, alone), sum(sizes.values()) / max(sizes[name], 1)
    return Effort(0.0, 0.0), 0.0


def _described(result: FitResult) -> dict[str, Any]:
    plant, K, weights = result.fitted.problem.plant, result.fitted.gain, result.fitted.stage_weights
    fit, estimate = result.inverse_mpc, result.estimate
    family = estimate.problem.family
    known = () if family is None else family.names
    ends = np.array([(one.low, one.high) for one in result.gain_intervals]).T
    # An interval over several ends of the search is not symmetric: its longer side counts.
    halves = np.max(np.abs(ends - np.ravel(estimate.K)), axis=0)
    determined = np.array([one.determined for one in result.gain_intervals])
    bounds = result.given.bounds
    return {
        **_named(plant),
        "verdict": fit_verdict(result).data(),
        "added": None if result.added is None else result.added.name,
        "trials": len(result.trials),
        "samples": sum(trial.samples for trial in result.given.recordings),
        "K": estimate.K,
        "S": estimate.S,
        "K_deviation": (halves / TWO_SIDED).reshape(K.shape),
        "K_low": ends[0].reshape(K.shape),
        "K_high": ends[1].reshape(K.shape),
        "K_determined": determined.reshape(K.shape),
        "K_identified": estimate.covariance.individually_identified,
        "K_of_weights": K,
        "Q": weights.Q,
        "R": weights.R,
        "misfit": result.fitted.misfit,
        "exact": result.fitted.explained,
        "converged": result.fitted.converged,
        **assessed(fit),
        "saturated": result.saturated,
        "fell": fit.fell,
        "limit": np.max(np.abs([bounds.u_min, bounds.u_max]), axis=0),
        "state_sizes": result.intent.sizes,
        "readings": {
            item.rule: {"Q": item.weights.Q, "dominant": item.dominant, "angle": item.angle}
            for item in result.intent.readings
        },
        "parameters": dict(zip(known, estimate.parameters, strict=True)),
        "starts": [trial.x0 for trial in estimate.problem.recordings],
        "logarithms": estimate.problem.logarithms,
        "errors": estimate.problem.errors,
        "findings": [trial.findings for trial in result.given.recordings],
        "trajectory": _trajectory(fit),
        "structure": _structure(result),
    }


def _named(plant: Plant) -> dict[str, Any]:
    """Names and units for the pages of a cohort."""
    names = (*plant.outputs, *plant.states, *plant.controls)
    pairs = list(itertools.product(plant.controls, plant.states))
    units = {f"K.{control}.{state}": gain_unit(plant, control, state) for control, state in pairs}
    units |= {f"centre_weight.{name}": weight_unit(plant, name, name) for name in plant.states}
    inner = follows_command(plant)
    return {
        "states": plant.states,
        "controls": plant.controls,
        "outputs": plant.outputs,
        "shown_units": [shown_unit(plant, name) for name in plant.outputs],
        "words": {name: signal_name(plant, name) for name in names},
        # Units of the compared measures, by their columns in units.csv.
        "units": {name: "-" if unit == "1" else unit for name, unit in units.items()},
        # Gains as pages show them: factor, unit, unit of the command, and for what it is given.
        "shown_gains": {f"K.{pair[0]}.{pair[1]}": _shown_gain(plant, *pair) for pair in pairs},
        # States whose single gains have no meaning.
        "inner": [] if inner.all() else list(np.array(plant.states)[inner]),
    }


def _shown_gain(plant: Plant, control: str, state: str) -> tuple[float, str, str, str]:
    (scale, top), (factor, of) = shown_unit(plant, control), shown_unit(plant, state)
    unit = gain_unit(plant, control, state)
    if unit != UNKNOWN and (scale, factor) != (1.0, 1.0):
        unit = unit.replace("rad", "°")
    per = f"{one_of(of)} of {signal_name(plant, state)}"
    return scale / factor, "-" if unit == "1" else unit, top, per


def _trajectory(fit: MethodFit) -> dict[str, Any]:
    """Thinned recorded and modelled outputs of the first trial."""
    plant, first = fit.estimate.problem.plant, fit.estimate.problem.recordings[0]
    step = max(1, first.samples // 600)
    return {
        "dt": plant.dt * step,
        "recorded": first.corrected[::step],
        "simulated": (fit.runs[0].x @ plant.C.T)[::step],
    }


def _structure(result: FitResult) -> dict[str, Any] | None:
    """Logarithms of cost weights with 95 % intervals; None if no structure is requested."""
    if not result.structures:
        return None
    fit = result.structures[0]
    nothing = [np.nan] * fit.structure.count
    return {
        "name": fit.structure.name,
        "unknowns": fit.structure.unknowns,
        "log_cost_weight": [item.value for item in fit.intervals] or nothing,
        "low": [item.low for item in fit.intervals] or nothing,
        "high": [item.high for item in fit.intervals] or nothing,
        "refused": fit.refused,
        "p": np.nan if fit.test is None else fit.test.probability,
        "reason": fit.reason,
    }
