"""Tasks on workers, here or elsewhere: the one loop of all commands that have many.

    run(pool, queue, cache) -> results, in the order in which they are there

What the cache has is not computed again, and what is computed is kept before it is handed on.
Where tasks are short several go together. A task whose worker dies is given to another one; one
that fails is a result with its fault, and stops nothing else.
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

# Batches given out for each thread: one that runs, and two that wait for it.
_AHEAD = 3
# A batch takes about so many seconds, and has at most so many tasks.
_SECONDS, _MOST = 0.2, 100
# A batch that has lost so many workers is taken for the cause.
_DEATHS = 4
# One thread a worker, for every library of linear algebra; and no module from the current folder
# while Python starts (-P): only what the user names is imported from there.
_ENVIRONMENT = {
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "PYTHONSAFEPATH": "1",
}
_STARTING = threading.Lock()


@dataclass(frozen=True)
class Task:
    """``work(*given)``, of importable code; what it returns is written down by `to_json`."""

    name: str  # Of its result
    digest: str  # Of all that the result depends on
    work: Callable[..., Any]
    given: tuple[Any, ...]


@dataclass(frozen=True)
class Result:
    """What became of a task."""

    task: Task
    content: Any  # What it returned, as JSON has it
    fault: ImpcError | None  # Why it returned nothing
    found: bool = False  # Whether an earlier run had kept it


#: What became of a task on its worker: content, fault, and seconds.
Answer = tuple[Any, ImpcError | None, float]


class Pool(Protocol):
    """Where tasks run: in processes on this machine, or on a scheduler."""

    @property
    def threads(self) -> int:
        """How many tasks run at a time."""
        ...

    def submit(self, number: int, batch: list[Task]) -> None:
        """Give out a batch, by its number."""
        ...

    def take(self) -> tuple[int, list[Answer] | str]:
        """Wait for a batch that is out: its number and answers, or why there are none."""
        ...


def run(pool: Pool, queue: deque[Task], cache: Cache) -> Iterator[Result]:
    """Do all tasks of a queue; more may be added to it with each result that comes."""
    out: dict[int, list[Task]] = {}
    seconds: dict[Callable[..., Any], float] = {}  # Of each work, lately
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
        if isinstance(answers, str) and len(batch) > 1:  # one of them is the cause: which?
            for task in batch:
                submit([task])
            continue
        if isinstance(answers, str):
            answers = [(None, SolverError("worker", answers, "see what its recording has"), 0.0)]
        results = []
        for task, (content, fault, spent) in zip(batch, answers, strict=True):
            seconds[task.work] = (seconds.get(task.work, spent) + spent) / 2
            if fault is None:
                cache.keep(task.name, task.digest, content)
            results.append(Result(task, content, fault))
        yield from results


def _together(seconds: float | None, share: int) -> int:
    """How many tasks of so many `seconds` go together; one where that is not known."""
    if seconds is None:
        return 1
    return max(1, min(int(_SECONDS / max(seconds, 1e-9)), share, _MOST))


def answered(batch: list[Task]) -> list[Answer]:
    """What a worker does: all tasks of a batch."""
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
                "see what its recording has",
            )
        answers.append((content, fault, time.perf_counter() - begun))
    return answers


class Processes:
    """Processes on this machine, each held by a thread and reached by a pipe alone.

    No port is opened, so that nobody else on the machine can send them work: what a pool of
    `dask.distributed` would need certificates for.
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
                answers = f"ended {_DEATHS} times, at last with {how}"
        except Exception as error:  # what cannot be sent
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
    """Workers while the block lasts; as many as there are processors by default."""
    found = Processes(count or os.cpu_count() or 1)
    try:
        yield found
    finally:
        found.close()


@contextmanager
def threads(count: int) -> Iterator[ThreadPoolExecutor]:
    """A few threads of this process: the compiled loop and the semidefinite solver let others run.

    When the block is left early, by an error or from the keyboard, what is not begun is not begun.
    """
    pool = ThreadPoolExecutor(count)
    try:
        yield pool
    finally:
        pool.shutdown(cancel_futures=True)


def _serve(pipe: Connection) -> None:
    """What a worker does all its life."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # whoever presses Ctrl-C means the client
    ignore_settings_files("matplotlib", "numba")
    threading.Thread(target=_die_with_client, daemon=True).start()
    while True:
        try:
            batch = pipe.recv()
        except EOFError:
            return
        except Exception as error:  # a module that is not there, or fails when it is imported
            pipe.send(f"{type(error).__name__}: {error}")
            continue
        pipe.send(answered(batch))


def _die_with_client() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
