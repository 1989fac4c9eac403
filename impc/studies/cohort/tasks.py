"""The tasks of a study: for each unit its recordings, the plant of its subject, and the digest."""

from __future__ import annotations

import inspect
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

from impc.errors import DataError
from impc.studies.cohort.unit_digest import unit_digest
from impc.studies.cohort.unit_task import FitTask

if TYPE_CHECKING:
    from collections.abc import Mapping

    from impc.files.plant_sources import PlantSource
    from impc.studies.cohort.study import Study, Unit

# Threads that read recordings for their digests: hashing lets others run.
_THREADS = 4


def unused_columns(study: Study, source: PlantSource) -> tuple[str, ...]:
    """Columns of the participants that are no arguments of the plant of this `study`.

    They stay out of the fit: age and sex of a subject are no fault of the table.
    """
    names = {name: None for unit in study.units for name in unit.person}
    return tuple(name for name in names if not _takes(source, name))


def _takes(source: PlantSource, name: str) -> bool:
    if ":" not in source.name:  # matrices in a file have no arguments of a person
        return False
    parameters = inspect.signature(source.make).parameters
    return name in parameters or any(
        one.kind is inspect.Parameter.VAR_KEYWORD for one in parameters.values()
    )


def study_tasks(study: Study, source: PlantSource) -> tuple[dict[str, FitTask], dict[str, str]]:
    """Tasks of all units by name, and the reason for each unit that has none.

    All recordings are read from their first byte to their last, for the digests.
    """
    unused = set(unused_columns(study, source))
    tasks: dict[str, FitTask] = {}
    failed: dict[str, str] = {}
    with ThreadPoolExecutor(_THREADS) as pool:
        pending = [(unit, pool.submit(_task, study, unit, unused, source)) for unit in study.units]
        for unit, future in pending:
            try:
                tasks[unit.name] = future.result()
            except DataError as error:
                failed[unit.name] = str(error)
    return tasks, failed


def _task(study: Study, unit: Unit, unused: set[str], source: PlantSource) -> FitTask:
    person = {name: value for name, value in unit.person.items() if name not in unused}
    arguments: Mapping[str, Any] = dict(study.configuration.plant) | person
    files = tuple(str(file.resolve()) for file in unit.files)
    digest = unit_digest(files, source.name, arguments, study.configuration)
    return FitTask(files, source.name, dict(arguments), study.configuration, digest)
