"""Run a study: the fit of each unit, then its replicates; results are stored at once.

    OUT/units/NAME/fit.json               a fit (`impc.studies.cache`)
    OUT/units/NAME/replicate-0007.json
    OUT/cohort.log                        times, memory, and what failed

Stored results are not computed again. A unit that cannot be fitted does not stop the others.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from impc.errors import InputError
from impc.files.disk import IN_ITS_PLACE, require_ordinary, unwritable
from impc.studies.cache import Cache
from impc.studies.cohort.tasks import fit_unit, replicate_unit
from impc.studies.pool import Task, run

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from impc.studies.cohort.study import Study
    from impc.studies.cohort.tasks import FitTask
    from impc.studies.pool import Pool

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
    for unit, digest in store.digests.items():
        if store.cache.digest(_name(unit)) not in (None, digest):
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
