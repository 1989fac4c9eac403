"""Workers on this machine: processes of one thread each, reached by pipes and by nothing else.

No port is opened, so that nobody else on the machine can send them work: what a pool of
`dask.distributed` would need certificates for. A task whose worker dies is given to another one.
"""

from __future__ import annotations

import multiprocessing
import multiprocessing.connection
import os
import signal
import threading
from collections import deque
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

from impc.settings_files import ignore_settings_files

if TYPE_CHECKING:
    from collections.abc import Callable, Hashable, Iterator
    from multiprocessing.connection import Connection
    from multiprocessing.process import BaseProcess

# A task that has lost so many workers is taken for the cause.
_DEATHS = 4
# One thread a worker, for every library of linear algebra; and no module from the current folder
# while Python starts (-P): only what the user names is imported from there.
_ENVIRONMENT = {
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "PYTHONSAFEPATH": "1",
}


@dataclass(frozen=True)
class Done:
    """What became of a task."""

    key: Hashable  # Its name
    value: Any  # What it returned
    fault: str = ""  # Why it returned nothing; empty when it did


class Workers(Protocol):
    """Where tasks run: here (`LocalWorkers`), or on a scheduler (`impc.studies.cohort.cluster`)."""

    @property
    def threads(self) -> int:
        """How many tasks run at a time."""
        ...

    def submit(self, key: Hashable, work: Callable[..., Any], *given: Any) -> None:
        """Give out a task, ``work(*given)``, of importable code; its `key` comes back with it."""
        ...

    def results(self) -> Iterator[Done]:
        """Take in results until no task is out; more may be given out meanwhile."""
        ...


@dataclass
class _Task:
    key: Hashable
    work: Callable[..., Any]
    given: tuple[Any, ...]
    deaths: int = 0


@dataclass
class _Worker:
    process: BaseProcess
    pipe: Connection
    task: _Task | None = None


class LocalWorkers:
    """Processes on this machine, see `Workers`."""

    def __init__(self, count: int) -> None:
        self._waiting: deque[_Task] = deque()
        self._faults: deque[Done] = deque()
        self._workers = [_started() for _ in range(count)]

    @property
    def threads(self) -> int:
        """How many tasks run at a time."""
        return len(self._workers)

    def submit(self, key: Hashable, work: Callable[..., Any], *given: Any) -> None:
        """As `Workers.submit`: ``work(*given)`` under a `key`."""
        self._waiting.append(_Task(key, work, given))
        self._give_out()

    def results(self) -> Iterator[Done]:
        """As `Workers.results`."""
        while True:
            self._give_out()
            while self._faults:
                yield self._faults.popleft()
            pipes = {worker.pipe: worker for worker in self._workers if worker.task is not None}
            if not pipes and not self._waiting:
                return
            # A worker that dies closes its end of the pipe: that is told in the same way.
            for pipe in multiprocessing.connection.wait(list(pipes)):
                found = self._received(pipes[pipe])  # type: ignore[index]
                if found is not None:
                    self._give_out()  # before the result is looked at: nobody waits for that
                    yield found

    def close(self) -> None:
        """End all processes."""
        for worker in self._workers:
            worker.process.terminate()
        for worker in self._workers:
            worker.process.join()
            worker.pipe.close()

    def _give_out(self) -> None:
        for place, worker in enumerate(self._workers):
            if worker.task is None and self._waiting:
                task = self._waiting.popleft()
                worker.task = task
                try:
                    worker.pipe.send((task.work, task.given))
                except OSError:  # it died while it had nothing to do
                    worker.task = None
                    self._waiting.appendleft(task)
                    self._workers[place] = _replaced(worker)

    def _received(self, worker: _Worker) -> Done | None:
        task = worker.task
        assert task is not None
        worker.task = None
        try:
            value, fault = worker.pipe.recv()
        except (EOFError, OSError):
            return self._bereaved(worker, task)
        return Done(task.key, value, fault)

    def _bereaved(self, worker: _Worker, task: _Task) -> Done | None:
        self._workers[self._workers.index(worker)] = _replaced(worker)
        task.deaths += 1
        if task.deaths < _DEATHS:
            self._waiting.appendleft(task)
            return None
        code = worker.process.exitcode or 0
        how = f"signal {-code}" if code < 0 else f"status {code}"
        return Done(task.key, None, f"its worker ended {task.deaths} times, at last with {how}")


@contextmanager
def local_workers(count: int | None) -> Iterator[LocalWorkers]:
    """Workers while the block lasts; as many as there are processors by default."""
    found = LocalWorkers(count or os.cpu_count() or 1)
    try:
        yield found
    finally:
        found.close()


def _started() -> _Worker:
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe()
    process = context.Process(target=_serve, args=(there,), daemon=True)
    before = {name: os.environ.get(name) for name in _ENVIRONMENT}
    os.environ.update(_ENVIRONMENT)
    try:
        process.start()
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
    there.close()
    return _Worker(process, here)


def _replaced(worker: _Worker) -> _Worker:
    worker.pipe.close()
    worker.process.join()
    return _started()


def _serve(pipe: Connection) -> None:
    """What a worker does all its life."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # whoever presses Ctrl-C means the client
    ignore_settings_files("matplotlib", "numba")
    threading.Thread(target=_die_with_client, daemon=True).start()
    while True:
        try:
            work, given = pipe.recv()
        except EOFError:
            return
        except Exception as error:  # a module that is not there, or fails when it is imported
            pipe.send((None, _line(error)))
            continue
        try:
            answer = work(*given), ""
        except (Exception, SystemExit) as error:
            answer = None, _line(error)
        pipe.send(answer)


def _line(error: BaseException) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())


def _die_with_client() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
