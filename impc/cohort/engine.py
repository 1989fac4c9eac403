"""Run a study: fits and replicates as tasks, results to disk as they come.

Any scheduler of dask.distributed will do. A few tasks per worker are given out at a time, so that
neither scheduler nor client holds more than that of the study. A unit's replicates follow as soon
as its fit is written down. A task whose worker dies is given to another one; what cannot be fitted
is reported and stops nothing else.
"""

from __future__ import annotations

import os
import time
from collections import deque
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import distributed
import psutil

from impc.cohort.digest import fit_task
from impc.cohort.work import fit_unit, replicate_unit
from impc.errors import DataError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from distributed import Client

    from impc.cohort.store import Store
    from impc.cohort.study import Study, Unit
    from impc.cohort.work import FitTask

__all__ = ["Progress", "run_study", "work_left"]

# Tasks given out for each thread of the cluster: one that runs, and two that wait for it.
_AHEAD = 3
# A task may lose this many workers before it is taken for the cause.
_RETRIES = 10
_FIT = -1


@dataclass(frozen=True)
class Progress:
    """What a caller is told.

    Attributes
    ----------
    done : callable
        (unit, what was done, seconds of the task).
    log : callable
        A line for the log.
    """

    done: Callable[[str, str, float], None] = lambda *_: None
    log: Callable[[str], None] = lambda _: None


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
        done += store.fit(unit.name) is not None
        done += sum(store.has_replicate(unit.name, index) for index in range(count))
    return done, len(study.units) * (1 + count)


def run_study(
    study: Study, store: Store, client: Client, progress: Progress | None = None
) -> dict[str, str]:
    """Do what is left of a study.

    Parameters
    ----------
    study : Study
    store : Store
        Held open by this run.
    client : distributed.Client
        Of the scheduler.
    progress : Progress, optional

    Returns
    -------
    dict
        Units that could not be fitted, with the reason of each.

    Raises
    ------
    InputError
        When a unit in the folder was fitted to other recordings or with other settings.
    OutputError
        When a result cannot be written.
    """
    progress = progress or Progress()
    run = _Run(study, store, client, progress)
    failed: dict[str, str] = {}
    for unit in study.units:
        try:
            run.tasks[unit.name] = fit_task(study, unit)
        except DataError as error:
            failed[unit.name] = str(error)
            store.keep_fit(unit.name, {"reason": str(error), "digest": ""})
            continue
        store.require_same(unit.name, run.tasks[unit.name].digest)
    store.keep_manifest(_manifest(study, run.tasks))
    progress.log(f"run of {len(study.units)} units on {_threads(client)} threads")
    for unit in study.units:
        if unit.name in run.tasks:
            run.begin(unit)
    for unit_name, reason in run.drain():
        failed[unit_name] = reason
        progress.log(f"{unit_name}: {reason}")
    progress.log(f"end: {len(failed)} of {len(study.units)} units without a result")
    return failed


class _Run:
    """The queue of one run, and the futures that are out."""

    def __init__(self, study: Study, store: Store, client: Client, progress: Progress) -> None:
        self.store, self.client, self.progress = store, client, progress
        self.count = int(study.configuration.fit.get("replicates", 0))
        self.tasks: dict[str, FitTask] = {}
        self.queue: deque[_Work] = deque()
        self.out: dict[Any, _Work] = {}
        self.begun = time.time()

    def begin(self, unit: Unit) -> None:
        """Queue what a unit lacks."""
        if self.store.fit(unit.name) is None:
            self.queue.append(_Work(unit.name, _FIT))
        else:
            self.queue.extend(self._replicates(unit.name))

    def drain(self) -> Iterator[tuple[str, str]]:
        """Give out tasks and take in results until none is left; yields failures."""
        make: Any = distributed.as_completed  # distributed types few of its functions
        waiting = make()
        self._fill(waiting)
        for future in waiting:
            work = self.out.pop(future)
            content = self._result(future)
            future.release()
            if work.index == _FIT:
                self.store.keep_fit(work.unit, content)
                if "reason" not in content:
                    # Before other fits: a unit is finished before the next is begun.
                    self.queue.extendleft(reversed(list(self._replicates(work.unit))))
            elif "reason" not in content:
                self.store.keep_replicate(work.unit, work.index, content)
            self._tell(work, content)
            if "reason" in content:
                yield work.unit, f"{work.name}: {content['reason']}"
            self._fill(waiting)

    def _fill(self, waiting: Any) -> None:
        most = _AHEAD * max(_threads(self.client), 1)
        while self.queue and len(self.out) < most:
            work = self.queue.popleft()
            future = self._submit(work)
            self.out[future] = work
            waiting.add(future)

    def _submit(self, work: _Work) -> Any:
        task = self.tasks[work.unit]
        if work.index == _FIT:
            return self.client.submit(fit_unit, task, pure=False, retries=0)
        fit = self.store.fit(work.unit)
        keep = ("starts", "logarithms", "K", "S", "Q", "R")
        needed = {key: fit[key] for key in keep} if fit is not None else {}
        return self.client.submit(replicate_unit, task, needed, work.index, pure=False, retries=0)

    def _replicates(self, unit: str) -> Iterator[_Work]:
        for index in range(self.count):
            if not self.store.has_replicate(unit, index):
                yield _Work(unit, index)

    def _result(self, future: Any) -> dict[str, Any]:
        """What a task returned; a fault of the program itself is a reason like any other."""
        error = future.exception()
        if error is not None:
            return {"reason": f"{type(error).__name__}: {error}", "digest": ""}
        found: dict[str, Any] = future.result()
        return found

    def _tell(self, work: _Work, content: dict[str, Any]) -> None:
        seconds = float(content.get("seconds", 0.0))
        self.progress.done(work.unit, work.name, seconds)
        here = psutil.Process(os.getpid()).memory_info().rss / 1e6
        self.progress.log(
            f"{work.unit}: {work.name} in {seconds:.2f} s; memory of worker "
            f"{content.get('memory_mb', float('nan')):.0f} MB, of client {here:.0f} MB"
        )


def _threads(client: Any) -> int:
    return int(sum(client.nthreads().values()))


def _manifest(study: Study, tasks: dict[str, FitTask]) -> dict[str, Any]:
    return {
        "plant": study.plant,
        "replicates": int(study.configuration.fit.get("replicates", 0)),
        "made": datetime.now(UTC).isoformat(timespec="seconds"),
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
