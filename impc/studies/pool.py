"""Run many tasks on workers, on this machine or a scheduler.

    run(pool, queue, cache) -> results in the order of completion

Cached results are not computed again; new results are stored before they are returned. A task whose
worker dies is sent to another worker; a task that fails returns its exception and does not stop the
others.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import (
    FIRST_COMPLETED,
    CancelledError,
    Future,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
    wait,
)
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any, Protocol

from impc.errors import ImpcError, SolverError
from impc.settings_files import ignore_settings_files
from impc.studies.cache import Cache, to_json

if TYPE_CHECKING:
    from multiprocessing.connection import Connection

# Submitted tasks per thread: one that runs and two that wait.
_AHEAD = 3
# Number of workers that may die before a task is given up.
_DEATHS = 4
# One thread per worker in all libraries of linear algebra; PYTHONSAFEPATH: modules in the current
# folder are imported only if the user names them.
_ENVIRONMENT = {
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "PYTHONSAFEPATH": "1",
}


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


#: Content and exception of a task that ran on a worker.
Answer = tuple[Any, ImpcError | None]


class Pool(Protocol):
    """Workers: processes on this machine, or a scheduler."""

    @property
    def threads(self) -> int:
        """Number of tasks that run in parallel."""
        ...

    def submit(self, task: Task) -> Future[Answer]:
        """Send a task to a worker, which calls `answered`."""
        ...


def run(pool: Pool, queue: deque[Task], cache: Cache) -> Iterator[Result]:
    """Run all tasks of a queue, to which the caller may add tasks after each result."""
    out: dict[Future[Answer], Task] = {}
    while queue or out:
        while queue and len(out) < _AHEAD * pool.threads:
            task = queue.popleft()
            content = cache.find(task.name, task.digest)
            if content is None:
                out[pool.submit(task)] = task
            else:
                yield Result(task, content, None, found=True)
        if out:
            wait(out, return_when=FIRST_COMPLETED)
            future = next(one for one in out if one.done())
            task, (content, fault) = out.pop(future), _outcome(future)
            if fault is None:
                cache.keep(task.name, task.digest, content)
            yield Result(task, content, fault)


def answered(task: Task) -> Answer:
    """Run a task on a worker."""
    try:
        return to_json(task.work(*task.given)), None
    except ImpcError as error:
        return None, error
    except (Exception, SystemExit) as error:
        return None, _fault(f"task {task.name}", f"{type(error).__name__}: {error}")


def _outcome(future: Future[Answer]) -> Answer:
    try:
        return future.result()
    except CancelledError:  # its scheduler is lost
        raise
    except Exception as error:  # it cannot be sent, or its workers die
        return None, _fault("worker", f"{type(error).__name__}: {error}")


def _fault(subject: str, problem: str) -> SolverError:
    return SolverError(subject, problem, "check the task's recordings")


class Processes:
    """Worker processes on this machine, each with an executor and a thread of its own.

    If a process dies, the others go on, and the task that it had is known. No port is opened: other
    users of the machine cannot send tasks to the workers.
    """

    def __init__(self, count: int) -> None:
        self.threads = count
        self._threads = ThreadPoolExecutor(count)
        self._idle: SimpleQueue[ProcessPoolExecutor] = SimpleQueue()
        # The workers end when this end of the pipe is closed, by `close` or by the client's death.
        self._alive, self._watched = multiprocessing.get_context("spawn").Pipe()
        for _ in range(count):
            self._idle.put(self._started())

    def submit(self, task: Task) -> Future[Answer]:
        """As `Pool.submit`."""
        return self._threads.submit(self._answer, task)

    def close(self) -> None:
        """End all processes."""
        self._alive.close()
        self._threads.shutdown(cancel_futures=True)
        while not self._idle.empty():
            self._idle.get().shutdown()
        self._watched.close()

    def _answer(self, task: Task) -> Answer:
        worker = self._idle.get()
        try:
            for _ in range(_DEATHS):
                try:
                    return worker.submit(answered, task).result()
                except BrokenProcessPool:
                    worker.shutdown()
                    worker = self._started()
                    if self._alive.closed:
                        raise
        finally:
            self._idle.put(worker)
        return None, _fault("worker", f"died {_DEATHS} times")

    def _started(self) -> ProcessPoolExecutor:
        context = multiprocessing.get_context("spawn")
        return ProcessPoolExecutor(1, context, initializer=_prepare, initargs=(self._watched,))


@contextmanager
def processes(count: int | None) -> Iterator[Processes]:
    """Worker processes during the block; by default one per processor."""
    before = dict(os.environ)
    os.environ.update(_ENVIRONMENT)  # processes inherit it when they start
    found = Processes(count or os.cpu_count() or 1)
    try:
        yield found
    finally:
        found.close()
        os.environ.clear()
        os.environ.update(before)


@contextmanager
def threads(count: int) -> Iterator[ThreadPoolExecutor]:
    """Threads, as compiled code releases the GIL; an exception cancels pending work."""
    pool = ThreadPoolExecutor(count)
    try:
        yield pool
    finally:
        pool.shutdown(cancel_futures=True)


def _prepare(watched: Connection) -> None:
    """Prepare a worker process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is handled by the client
    ignore_settings_files("matplotlib", "numba")
    threading.Thread(target=_end_with_client, args=(watched,), daemon=True).start()


def _end_with_client(watched: Connection) -> None:
    with contextlib.suppress(EOFError, OSError):
        watched.recv()
    os._exit(1)
