"""Run a study: fits and replicates as tasks, results to disk as they come.

A few tasks per worker are given out at a time, so that nobody holds more than that of the study. A
unit's replicates follow as soon as its fit is written down. A task whose worker dies is given to
another one; what cannot be fitted is reported and stops nothing else.
"""

from __future__ import annotations

import json
import os
from collections import deque
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import psutil

from impc.files.digests import versions
from impc.reporting.writer import write_files
from impc.studies.cohort.unit_task import FitTask, fit_unit, replicate_unit

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from impc.studies.cohort.store import Store
    from impc.studies.cohort.study import Study, Unit
    from impc.studies.cohort.workers import Done, Workers

# Tasks given out for each thread of the cluster: one that runs, and two that wait for it.
_AHEAD = 3
_FIT = -1
# What a replicate needs of its fit.
_NEEDED = ("starts", "logarithms", "K", "S", "Q", "R")


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


@dataclass(frozen=True)
class _Work:
    """One task: a fit (index -1) or a replicate of a unit."""

    unit: str
    index: int

    @property
    def name(self) -> str:
        return "fit" if self.index == _FIT else f"replicate {self.index + 1}"


def work_left(study: Study, store: Store) -> tuple[int, int]:
    """Number of tasks done and of all tasks; a unit that failed counts as not begun."""
    count = int(study.configuration.fit.get("replicates", 0))
    done = 0
    for unit in study.units:
        if store.fit(unit.name) is not None:
            found = (store.replicate(unit.name, index) for index in range(count))
            done += 1 + sum(item is not None for item in found)
    return done, len(study.units) * (1 + count)


def run_study(
    study: Study,
    tasks: Mapping[str, FitTask],
    store: Store,
    workers: Workers,
    done: Callable[[str], None] = lambda _: None,
    log: Callable[[str], None] = lambda _: None,
) -> Failures:
    """Do what is left of a study."""
    run = _Run(study, tasks, store, workers, done, log)
    for unit in study.units:
        if unit.name in tasks:
            run.begin(unit)
    manifest = json.dumps(_manifest(study, tasks), indent=1, sort_keys=True) + "\n"
    write_files(store.folder, {"manifest.json": manifest.encode()})
    log(f"run of {len(study.units)} units on {workers.threads} threads")
    run.drain()
    return run.failures


class _Run:
    """The queue of one run, and how many tasks are out."""

    def __init__(
        self,
        study: Study,
        tasks: Mapping[str, FitTask],
        store: Store,
        workers: Workers,
        done: Callable[[str], None],
        log: Callable[[str], None],
    ) -> None:
        self.store, self.workers, self.tasks = store, workers, tasks
        self.done, self.log = done, log
        self.count = int(study.configuration.fit.get("replicates", 0))
        self.queue: deque[_Work] = deque()
        self.out = 0
        self.failures = Failures()

    def begin(self, unit: Unit) -> None:
        """Queue what a unit lacks."""
        if self.store.fit(unit.name) is None:
            self.queue.append(_Work(unit.name, _FIT))
        else:
            self.queue.extend(self._replicates(unit.name))

    def drain(self) -> None:
        """Give out tasks and take in results until none is left."""
        self._fill()
        for done in self.workers.results():
            self.out -= 1
            self._take(done)
            self._fill()

    def _take(self, done: Done) -> None:
        work = done.key
        assert isinstance(work, _Work)
        # A fault of the program itself is a reason like any other.
        content: dict[str, Any] = {"reason": done.fault} if done.fault else done.value
        reason = content.get("reason")
        if reason is not None:
            self._fail(work, reason)
        elif work.index == _FIT:
            self.store.keep_fit(work.unit, content)
            # Before other fits: a unit is finished before the next is begun.
            self.queue.extendleft(reversed(list(self._replicates(work.unit))))
        else:
            self.store.keep_replicate(work.unit, work.index, content)
        self._tell(work, content)

    def _fail(self, work: _Work, reason: str) -> None:
        if work.index == _FIT:
            self.failures.units[work.unit] = reason
            self.store.keep_failure(work.unit, None, reason)
        else:
            self.failures.replicates.setdefault(work.unit, {})[work.index + 1] = reason
            self.store.keep_failure(work.unit, work.index, reason)
        self.log(f"{work.unit}: {work.name}: {reason}")

    def _fill(self) -> None:
        most = _AHEAD * self.workers.threads
        while self.queue and self.out < most:
            work = self.queue.popleft()
            self._submit(work)
            self.out += 1

    def _submit(self, work: _Work) -> None:
        task = self.tasks[work.unit]
        if work.index == _FIT:
            self.workers.submit(work, fit_unit, task)
            return
        fit = self.store.fit(work.unit)
        assert fit is not None
        needed = {key: fit[key] for key in _NEEDED}
        self.workers.submit(work, replicate_unit, task, needed, work.index)

    def _replicates(self, unit: str) -> Iterator[_Work]:
        for index in range(self.count):
            if self.store.replicate(unit, index) is None:
                yield _Work(unit, index)

    def _tell(self, work: _Work, content: dict[str, Any]) -> None:
        seconds = float(content.get("seconds", 0.0))
        self.done(f"{work.unit} {work.name}")
        here = psutil.Process(os.getpid()).memory_info().rss / 1e6
        self.log(
            f"{work.unit}: {work.name} in {seconds:.2f} s; memory of worker "
            f"{content.get('memory_mb', float('nan')):.0f} MB, of client {here:.0f} MB"
        )


def _manifest(study: Study, tasks: Mapping[str, FitTask]) -> dict[str, Any]:
    return {
        "plant": study.plant,
        "replicates": int(study.configuration.fit.get("replicates", 0)),
        "made": datetime.now(UTC).isoformat(timespec="seconds"),
        "versions": versions(),
        "units": {
            unit.name: {
                "subject": unit.subject,
                "visit": unit.visit,
                "condition": unit.condition,
                "group": unit.group,
                "files": [file.name for file in unit.files],
                "digest": tasks[unit.name].digest if unit.name in tasks else None,
            }
            for unit in study.units
        },
    }
