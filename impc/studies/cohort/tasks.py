"""Run a study: the fit of each unit, then its replicates; results are stored at once.

    OUT/units/NAME/fit.json               a fit (`impc.studies.cache`)
    OUT/units/NAME/replicate-0007.json
    OUT/cohort.log                        times, memory, and what failed

A task contains file names and settings; workers read the recordings and cache the last few. Results
do not depend on the order of tasks or the number of workers. Stored results are not computed again.
A unit that cannot be fitted does not stop the others.
"""

from __future__ import annotations

import functools
import inspect
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from impc.assess.resampling import replicate
from impc.checking import replace
from impc.errors import DataError, ImpcError, InputError
from impc.files.configuration import FILL_IN, Configuration
from impc.files.digests import content_digest, digest, source_digest, versions
from impc.files.disk import IN_ITS_PLACE, require_ordinary, unwritable
from impc.files.plant_sources import PlantSource, made_by, plant_source
from impc.files.reading import read_unit
from impc.inverse.problem import Problem
from impc.reporting.rendering import plain
from impc.reporting.shown_units import angles_in
from impc.studies.cache import Cache
from impc.studies.cohort.participants import require_faultless
from impc.studies.cohort.study import Study
from impc.studies.cohort.unit_result import stored_fit
from impc.studies.effort import Effort, fit_effort
from impc.studies.fit.asked import asked_plant, fit_problem
from impc.studies.fit.settings import FitSettings, fit_settings
from impc.studies.fit.subject import fit_alone
from impc.studies.pool import Pool, Task, run


@dataclass(frozen=True)
class FitTask:
    """Inputs of the fit of a unit."""

    files: tuple[str, ...]  # Paths of the recordings
    plant: str  # Import path or file of the plant
    arguments: dict[str, Any] = field(hash=False)  # Arguments of the plant
    configuration: Configuration = field(hash=False)
    digest: str = ""  # Digest of all these and of the content of the files


def study_tasks(study: Study, source: PlantSource) -> tuple[dict[str, FitTask], dict[str, str]]:
    """Tasks by unit, reasons for units without; InputError if the plant refuses a participant."""
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
        configuration.report,
        # The number of replicates does not affect any result.
        {key: value for key, value in configuration.fit.items() if key != "replicates"},
        versions(),
    )


def fit_unit(task: FitTask) -> dict[str, Any]:
    """Fit a unit."""
    started = time.perf_counter()
    problem, settings, falls = unit_problem(task)
    with angles_in(task.configuration.report.angles):
        content = stored_fit(replace(fit_alone(problem, settings), falls=falls))
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


def unit_effort(tasks: Iterable[FitTask]) -> Effort:
    """Effort of the first readable unit, zero without one."""
    for task in tasks:
        try:
            problem, settings, _ = unit_problem(task)
        except ImpcError:  # reported when the unit is fitted
            continue
        return fit_effort(problem, replace(settings, profiles=[], horizons=[], unknown_limit=False))
    return Effort(0.0, 0.0)


# Entries of a fit that its replicates need.
_NEEDED = ("starts", "logarithms", "errors", "added", "K", "S")


@dataclass(frozen=True)
class Store:
    """The results of a study in its folder."""

    folder: Path
    # Digest of each unit by name (`unit_digest`); none for a unit that cannot be read
    digests: Mapping[str, str] = field(default_factory=dict)

    @property
    def cache(self) -> Cache:
        """Cache of fits and replicates."""
        return Cache(self.folder / "units")

    def fit(self, unit: str, index: int | None = None) -> dict[str, Any] | None:
        """Fit of a unit, or its replicate `index`; None if there is none."""
        if unit not in self.digests:
            return None
        found: dict[str, Any] | None = self.cache.find(_name(unit, index), self.digests[unit])
        return found

    def log(self, line: str) -> None:
        """Add a `line` to cohort.log."""
        path = self.folder / "cohort.log"
        try:
            require_ordinary(path)
            with path.open("a", encoding="utf-8") as stream:
                stream.write(f"{datetime.now(UTC).isoformat(timespec='seconds')} {line}\n")
        except OSError as error:
            raise unwritable(f"file {path}", error, IN_ITS_PLACE) from None


@dataclass
class Failures:
    """Failed fits and replicates with their reasons."""

    units: dict[str, str] = field(default_factory=dict)  # Unit -> reason why it has no fit
    # Unit -> number of the replicate (from 1) -> reason
    replicates: dict[str, dict[int, str]] = field(default_factory=dict)

    @property
    def lines(self) -> list[str]:
        """Lines for the terminal."""
        lines = [f"{unit}: {reason}" for unit, reason in self.units.items()]
        for unit, found in self.replicates.items():
            first = min(found)
            more = f" (and {len(found) - 1} more)" if len(found) > 1 else ""
            lines.append(f"{unit}: replicate {first}{more}: {found[first]}")
        return lines

    def __bool__(self) -> bool:
        return bool(self.units or self.replicates)


def _name(unit: str, index: int | None = None) -> str:
    """Name in the cache of a fit, or of its replicate `index`."""
    return f"{unit}/fit" if index is None else f"{unit}/replicate-{index:04d}"


def work_kept(study: Study, store: Store) -> tuple[int, int]:
    """Number of tasks with a stored result, and number of all tasks."""
    kept = 0
    for unit in study.units:
        fit = store.cache.path(_name(unit.name))
        replicates = len([*fit.parent.glob("replicate-*.json")])
        kept += fit.exists() + min(replicates, study.replicates)
    return kept, len(study.units) * (1 + study.replicates)


def open_store(folder: Path, tasks: Mapping[str, FitTask]) -> Store:
    """The results in a folder; InputError if they are of other recordings, settings or versions."""
    store = Store(folder, {name: task.digest for name, task in tasks.items()})
    for unit, made_of in store.digests.items():
        if store.cache.digest(_name(unit)) not in (None, made_of):
            raise InputError(
                f"file {store.cache.path(_name(unit))}",
                "was fitted to other recordings or with other settings, plant or versions",
                "choose another folder, or remove it",
            )
    return store


def run_study(
    study: Study,
    tasks: Mapping[str, FitTask],
    store: Store,
    pool: Pool,
    done: Callable[..., None] = lambda _, *, found: None,
) -> Failures:
    """Run the remaining tasks of a study; `done` hears the title of each, and `found=`."""
    store.log(f"run of {len(study.units)} units on {pool.threads} threads")
    failures = Failures()
    queue = deque(Task(_name(unit), task.digest, fit_unit, (task,)) for unit, task in tasks.items())
    for result in run(pool, queue, store.cache):
        task, content = result.task, result.content
        unit, _, name = task.name.partition("/")
        index = None if task.work is fit_unit else task.given[-1]
        if result.fault is not None:
            reason = str(result.fault)
            if index is None:
                failures.units[unit] = reason
            else:
                failures.replicates.setdefault(unit, {})[index + 1] = reason
            store.log(f"{unit}: {name}: {reason}")
        elif not result.found:
            store.log(
                f"{unit}: {name} in {content['seconds']:.2f} s; memory of worker "
                f"{content['memory_mb']:.0f} MB"
            )
        if index is None and result.fault is None:
            # At the front of the queue: finish a unit before the next one.
            needed = {key: content[key] for key in _NEEDED}
            queue.extendleft(
                Task(_name(unit, k), task.digest, replicate_unit, (*task.given, needed, k))
                for k in reversed(range(study.replicates))
            )
        title = "fit" if index is None else f"bootstrap replicate {index + 1}"
        done(f"{unit}, {title}", found=result.found)
    return failures
