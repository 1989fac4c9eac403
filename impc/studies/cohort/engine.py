"""Run a study: the fit of each unit, then its replicates, results to disk as they come.

    OUT/manifest.json                  the units, their digests, the versions
    OUT/units/NAME/fit.json            a fit (`impc.studies.cache`), or
    OUT/units/NAME/failed.json         why there is none
    OUT/units/NAME/replicate-0007.json, or replicate-0007-failed.json
    OUT/cohort.log                     what happened when

What is there is not computed again. What cannot be fitted is reported and stops nothing else.
"""

from __future__ import annotations

import json
from collections import deque
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from impc.errors import InputError
from impc.files.digests import versions
from impc.files.disk import IN_ITS_PLACE, require_ordinary, unwritable
from impc.reporting.writer import write_files
from impc.studies.cache import Cache
from impc.studies.cohort.study import LABELS
from impc.studies.cohort.tasks import fit_unit, replicate_unit
from impc.studies.pool import Task, run

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from impc.studies.cohort.study import Study
    from impc.studies.cohort.tasks import FitTask
    from impc.studies.pool import Pool, Result

# What a replicate needs of its fit.
_NEEDED = ("starts", "logarithms", "offsets", "K", "S", "Q", "R")


@dataclass(frozen=True)
class Store:
    """The results of a study in its folder."""

    folder: Path
    # Of every unit, by its name, as the study is now (`unit_digest`). A unit without one, because a
    # recording cannot be read, has no results.
    digests: Mapping[str, str] = field(default_factory=dict)

    @property
    def cache(self) -> Cache:
        """Where they are kept."""
        return Cache(self.folder / "units")

    def fit(self, unit: str, index: int | None = None) -> dict[str, Any] | None:
        """The fit of a unit, or its replicate `index`; None where there is none."""
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
    """What could not be done, and why."""

    units: dict[str, str] = field(default_factory=dict)  # Unit -> reason why it has no fit
    # Unit -> number of the replicate, from 1 -> reason
    replicates: dict[str, dict[int, str]] = field(default_factory=dict)

    @property
    def lines(self) -> list[str]:
        """A sentence each, for the terminal."""
        lines = [f"{unit}: {reason}" for unit, reason in self.units.items()]
        for unit, found in self.replicates.items():
            first = min(found)
            more = f" (and {len(found) - 1} more)" if len(found) > 1 else ""
            lines.append(f"{unit}: replicate {first}{more}: {found[first]}")
        return lines

    def __bool__(self) -> bool:
        return bool(self.units or self.replicates)


def _name(unit: str, index: int | None = None) -> str:
    """Of the result of a fit, or of its replicate `index`."""
    return f"{unit}/fit" if index is None else f"{unit}/replicate-{index:04d}"


def work_kept(study: Study, store: Store) -> tuple[int, int]:
    """Number of tasks whose result has a file, and of all tasks."""
    count = int(study.configuration.fit.get("replicates", 0))
    names = [
        name
        for unit in study.units
        for name in (_name(unit.name), *(_name(unit.name, index) for index in range(count)))
    ]
    return sum(store.cache.path(name).exists() for name in names), len(names)


def require_same(store: Store) -> None:
    """Refuse a folder that has fits of other recordings, settings, plants or versions."""
    try:
        known = json.loads((store.folder / "manifest.json").read_bytes())["units"]
        before = {unit: known[unit]["digest"] for unit in store.digests if unit in known}
    except (OSError, ValueError, KeyError, TypeError):  # none, or damaged: no result is used then
        return  # that has another digest
    for unit, digest in before.items():
        path = store.cache.path(_name(unit))
        if digest not in (None, store.digests[unit]) and path.exists():
            raise InputError(
                f"file {path}",
                "was fitted to other recordings or with other settings, plant or versions",
                "give another folder, or remove it",
            )


def run_study(
    study: Study,
    tasks: Mapping[str, FitTask],
    store: Store,
    pool: Pool,
    done: Callable[[Result], None] = lambda _: None,
) -> Failures:
    """Do what is left of a study."""
    require_same(store)
    count = int(study.configuration.fit.get("replicates", 0))
    manifest = {
        "plant": study.plant,
        "replicates": count,
        "made": datetime.now(UTC).isoformat(timespec="seconds"),
        "versions": versions(),
        "units": {
            unit.name: {
                **{name: getattr(unit, name) for name in LABELS},
                "files": [file.name for file in unit.files],
                "digest": tasks[unit.name].digest if unit.name in tasks else None,
            }
            for unit in study.units
        },
    }
    text = json.dumps(manifest, indent=1, sort_keys=True) + "\n"
    write_files(store.folder, {"manifest.json": text.encode()})
    store.log(f"run of {len(study.units)} units on {pool.threads} threads")
    failures, cache = Failures(), store.cache
    queue = deque(Task(_name(unit), task.digest, fit_unit, (task,)) for unit, task in tasks.items())
    for result in run(pool, queue, cache):
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
            cache.keep(_failed(task.name), task.digest, {"reason": reason})
        elif not result.found:
            cache.discard(_failed(task.name))
            store.log(
                f"{unit}: {name} in {content['seconds']:.2f} s; memory of worker "
                f"{content['memory_mb']:.0f} MB"
            )
        if index is None and result.fault is None:
            # Before other fits: a unit is finished before the next is begun.
            needed = {key: content[key] for key in _NEEDED}
            queue.extendleft(
                Task(_name(unit, k), task.digest, replicate_unit, (*task.given, needed, k))
                for k in reversed(range(count))
            )
        done(result)
    return failures


def keep_failure(store: Store, unit: str, reason: str) -> None:
    """Write down the `reason` why a `unit` cannot be fitted: none of its recordings can be read."""
    store.cache.keep(_failed(_name(unit)), "", {"reason": reason})


def _failed(name: str) -> str:
    """Where the reason is kept why there is no such result."""
    return f"{name}-failed".replace("/fit-", "/")
