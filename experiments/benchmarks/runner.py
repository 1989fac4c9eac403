"""Processor time that the runner takes of the client for each empty task."""

from __future__ import annotations

import importlib.util
import tempfile
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import numpy as np

from experiments.benchmarks.table import Row
from experiments.benchmarks.timing import Timing, side_by_side
from impc.files.configuration import Configuration, RecordingTable
from impc.reporting.writer import owned
from impc.studies.cache import Cache
from impc.studies.cohort.study import Study, Unit
from impc.studies.cohort.tasks import FitTask, Store, fit_unit, run_study
from impc.studies.pool import Answer, Pool, Task, processes, run
from impc.studies.scheduler import Cluster, connected

__all__ = ["empty", "runner_rows"]

_TASKS, _SUBJECTS = 300, 3
_LIMIT = 0.5  # ms
_DASK = "two workers of Dask, through the runner"


def empty(index: int) -> int:
    """A task without work."""
    return index


class _Ready:
    """A pool that answers at once, so that only the time of the client remains."""

    threads = 32

    def __init__(self) -> None:
        rng = np.random.default_rng(0)
        numbers = {"seconds": 1e-4, "memory_mb": 400.0, "K": rng.standard_normal((1, 10)).tolist()}
        # A fit of 70 kB, the size for three trials of the seat.
        fit = dict.fromkeys(("starts", "logarithms", "errors", "added", "S"), numbers["K"])
        self._fit = numbers | fit | {"trajectory": rng.standard_normal((600, 6)).tolist()}
        self._replicate = numbers | {"parameters": [1.0]}

    def submit(self, task: Task) -> Future[Answer]:
        future: Future[Answer] = Future()
        future.set_result((self._fit if task.work is fit_unit else self._replicate, None))
        return future


def _cohort(folder: str) -> None:
    settings = Configuration(RecordingTable(), {}, fit={"replicates": _TASKS // _SUBJECTS - 1})
    units = tuple(Unit(str(number), "1", "", ()) for number in range(_SUBJECTS))
    study = Study("plants:cursor_plant", settings, units)
    tasks = {unit.name: FitTask((), study.plant, {}, settings, unit.name) for unit in units}
    store = Store(Path(tempfile.mkdtemp(dir=folder)), {unit: unit for unit in tasks})
    with owned(store.folder, "cohort"):
        run_study(study, tasks, store, _Ready())


def _through(pool: Pool, folder: str) -> None:
    queue = deque(Task(f"{index}", "", empty, (index,)) for index in range(_TASKS))
    cache = Cache(Path(tempfile.mkdtemp(dir=folder)))
    found = [result.content for result in run(pool, queue, cache)]
    assert sorted(found) == list(range(_TASKS))


def runner_rows(runs: int) -> list[Row]:
    """Rows of the cohort client, local workers, and Dask workers."""
    runs = max(3, runs // 2)
    with tempfile.TemporaryDirectory() as folder, processes(2) as pool:
        cases: dict[str, Callable[[], object]] = {
            "client": lambda: _cohort(folder),
            "processes": lambda: _through(pool, folder),
        }
        found = side_by_side(cases, runs, time.process_time)
        return [
            _row("client of a cohort, workers that answer at once", found["client"], _LIMIT),
            _row("two processes on this machine", found["processes"], None),
            *_dask_rows(runs, folder),
        ]


def _dask_rows(runs: int, folder: str) -> list[Row]:
    if importlib.util.find_spec("distributed") is None:
        missing = "not installed: pip install 'impc[cohort]'"
        return [Row(f"a task, {_DASK}", "", None, note=missing)]
    import distributed  # noqa: PLC0415

    make: Any = distributed.LocalCluster
    with (
        make(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster,
        connected(Cluster(cluster.scheduler_address)) as pool,
    ):
        cases: dict[str, Callable[[], object]] = {"runner": lambda: _through(pool, folder)}
        found = side_by_side(cases, runs, time.process_time)
    return [_row(_DASK, found["runner"], None)]


def _row(name: str, timing: Timing, limit: float | None) -> Row:
    note = f"{_TASKS} empty tasks; processor time of the client"
    return Row(f"a task, {name}", "", 1e3 * timing.median / _TASKS, limit, "ms", note)


if __name__ == "__main__":
    for row in runner_rows(7):
        print(row)
