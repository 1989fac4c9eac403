"""Run many tasks on workers, on this machine or a scheduler.

    run(pool, queue, cache) -> results in the order of completion

Cached results are not computed again; new results are stored before they are returned. Short tasks
are sent in batches. A task whose worker dies is sent to another worker; a task that fails returns
its exception and does not stop the others.
"""

from __future__ import annotations

import itertools
import multiprocessing
import os
import signal
import threading
import time
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any, Protocol

from impc.errors import ImpcError, SolverError
from impc.settings_files import ignore_settings_files
from impc.studies.cache import to_json

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from multiprocessing.connection import Connection
    from multiprocessing.process import BaseProcess

    from impc.studies.cache import Cache

# Submitted batches per thread: one that runs and two that wait.
_AHEAD = 3
# Target run time (s) and largest number of tasks of a batch.
_SECONDS, _MOST = 0.2, 100
# Number of workers that may die before a batch is given up.
_DEATHS = 4
# One thread per worker in all libraries of linear algebra; PYTHONSAFEPATH: modules in the current
# folder are imported only if the user names them.
_ENVIRONMENT = {
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "PYTHONSAFEPATH": "1",
}
_STARTING = threading.Lock()


@dataclass(frozen=True)
class Task:
    """A call ``work(*given)`` of an importable function; `to_json` stores its result."""

    name: str  # Name of the result
    digest: str  # Digest of everything that the result depends on
    work: Callable[..., Any]
    given: tuple[Any, ...]


@dataclass(frozen=True)
class Result:
    """Outcome of a task."""

    task: Task
    content: Any  # Return value in JSON form
    fault: ImpcError | None  # Exception, if it failed
    found: bool = False  # Whether it comes from the cache


#: Outcome of a task on its worker: content, exception, and run time in s.
Answer = tuple[Any, ImpcError | None, float]


class Pool(Protocol):
    """Workers: processes on this machine, or a scheduler."""

    @property
    def threads(self) -> int:
        """Number of tasks that run in parallel."""
        ...

    def submit(self, number: int, batch: list[Task]) -> None:
        """Submit a batch under its number."""
        ...

    def take(self) -> tuple[int, list[Answer] | str]:
        """Wait for a batch; return its number and its answers, or the reason of a failure."""
        ...


def run(pool: Pool, queue: deque[Task], cache: Cache) -> Iterator[Result]:
    """Run all tasks of a queue, to which the caller may add tasks after each result."""
    out: dict[int, list[Task]] = {}
    seconds: dict[Callable[..., Any], float] = {}  # Recent run time of each function
    numbers = itertools.count()

    def submit(batch: list[Task]) -> None:
        number = next(numbers)
        out[number] = batch
        pool.submit(number, batch)

    while queue or out:
        while queue and len(out) < _AHEAD * pool.threads:
            batch: list[Task] = []
            share = len(queue) // (_AHEAD * pool.threads)
            while queue and len(batch) < _together(seconds.get(queue[0].work), share):
                task = queue.popleft()
                content = cache.find(task.name, task.digest)
                if content is None:
                    batch.append(task)
                else:
                    yield Result(task, content, None, found=True)
            if batch:
                submit(batch)
        if not out:
            continue
        number, answers = pool.take()
        batch = out.pop(number)
        if isinstance(answers, str) and len(batch) > 1:  # find the task that is the cause
            for task in batch:
                submit([task])
            continue
        if isinstance(answers, str):
            answers = [(None, SolverError("worker", answers, "check the task's recordings"), 0.0)]
        results = []
        for task, (content, fault, spent) in zip(batch, answers, strict=True):
            seconds[task.work] = (seconds.get(task.work, spent) + spent) / 2
            if fault is None:
                cache.keep(task.name, task.digest, content)
            results.append(Result(task, content, fault))
        yield from results


def _together(seconds: float | None, share: int) -> int:
    """Number of tasks per batch for a run time of `seconds` each; 1 if unknown."""
    if seconds is None:
        return 1
    return max(1, min(int(_SECONDS / max(seconds, 1e-9)), share, _MOST))


def answered(batch: list[Task]) -> list[Answer]:
    """Run all tasks of a batch on a worker."""
    answers: list[Answer] = []
    for task in batch:
        begun, content, fault = time.perf_counter(), None, None
        try:
            content = to_json(task.work(*task.given))
        except ImpcError as error:
            fault = error
        except (Exception, SystemExit) as error:
            fault = SolverError(
                f"task {task.name}",
                f"{type(error).__name__}: {error}",
                "check the task's recordings",
            )
        answers.append((content, fault, time.perf_counter() - begun))
    return answers


class Processes:
    """Worker processes on this machine, each controlled by a thread through a pipe.

    No port is opened: other users of the machine cannot send tasks to the workers.
    """

    def __init__(self, count: int) -> None:
        self.threads = count
        self._holders = ThreadPoolExecutor(count)
        self._closed = False
        self._workers: set[_Worker] = set()
        self._idle: SimpleQueue[_Worker] = SimpleQueue()
        self._ended: SimpleQueue[tuple[int, list[Answer] | str]] = SimpleQueue()
        for _ in range(count):
            self._idle.put(self._started())

    def submit(self, number: int, batch: list[Task]) -> None:
        """As `Pool.submit`."""
        self._holders.submit(self._hold, number, batch)

    def take(self) -> tuple[int, list[Answer] | str]:
        """As `Pool.take`."""
        return self._ended.get()

    def close(self) -> None:
        """End all processes."""
        self._closed = True
        for worker in list(self._workers):
            worker.process.terminate()
        self._holders.shutdown(cancel_futures=True)
        for worker in self._workers:
            worker.process.join()
            worker.pipe.close()

    def _hold(self, number: int, batch: list[Task]) -> None:
        worker = self._idle.get()
        try:
            for _ in range(_DEATHS):
                try:
                    worker.pipe.send(batch)
                    answers = worker.pipe.recv()
                except (EOFError, OSError):
                    if self._closed:
                        return
                    self._workers.remove(worker)
                    worker.pipe.close()
                    worker.process.join()
                    code = worker.process.exitcode or 0
                    worker = self._started()
                else:
                    break
            else:
                how = f"signal {-code}" if code < 0 else f"status {code}"
                answers = f"died {_DEATHS} times, last with {how}"
        except Exception as error:  # the batch cannot be sent
            answers = f"{type(error).__name__}: {error}"
        self._idle.put(worker)
        self._ended.put((number, answers))

    def _started(self) -> _Worker:
        context = multiprocessing.get_context("spawn")
        here, there = context.Pipe()
        process = context.Process(target=_serve, args=(there,), daemon=True)
        with _STARTING:
            before = {name: os.environ[name] for name in _ENVIRONMENT if name in os.environ}
            os.environ.update(_ENVIRONMENT)
            try:
                process.start()
            finally:
                for name in _ENVIRONMENT:
                    del os.environ[name]
                os.environ.update(before)
        there.close()
        worker = _Worker(process, here)
        self._workers.add(worker)
        if self._closed:
            process.terminate()
        return worker


@dataclass(frozen=True)
class _Worker:
    process: BaseProcess
    pipe: Connection


@contextmanager
def processes(count: int | None) -> Iterator[Processes]:
    """Worker processes during the block; by default one per processor."""
    found = Processes(count or os.cpu_count() or 1)
    try:
        yield found
    finally:
        found.close()


@contextmanager
def threads(count: int) -> Iterator[ThreadPoolExecutor]:
    """Threads of this process; useful because compiled code and solvers release the GIL.

    If the block ends with an exception, pending work is cancelled.
    """
    pool = ThreadPoolExecutor(count)
    try:
        yield pool
    finally:
        pool.shutdown(cancel_futures=True)


def _serve(pipe: Connection) -> None:
    """Main loop of a worker process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is handled by the client
    ignore_settings_files("matplotlib", "numba")
    threading.Thread(target=_die_with_client, daemon=True).start()
    while True:
        try:
            batch = pipe.recv()
        except EOFError:
            return
        except Exception as error:  # a module is missing or fails on import
            pipe.send(f"{type(error).__name__}: {error}")
            continue
        pipe.send(answered(batch))


def _die_with_client() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
