"""Connection to workers: processes on this machine, or a running Dask scheduler."""

from __future__ import annotations

import functools
import logging
import time
from collections.abc import Iterator
from concurrent.futures import CancelledError, Future
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from impc.errors import InputError, OutputError
from impc.extras import optional
from impc.studies.pool import Answer, Pool, Task, answered, processes

if TYPE_CHECKING:
    from distributed import Client

_PATIENCE = "10s"
# Seconds for which the number of threads is cached; a query takes a millisecond.
_HOLDS = 5.0


@dataclass(frozen=True)
class Cluster:
    """Workers to use."""

    scheduler: str | None = None  # Address of a running Dask scheduler; None: this machine
    workers: int | None = None  # Number of workers on this machine; None: one per processor


@contextmanager
def connected(cluster: Cluster) -> Iterator[Pool]:
    """Connect to the workers of a `cluster` during the block."""
    address = cluster.scheduler
    if address is None:
        with processes(cluster.workers) as pool:
            yield pool
        return
    distributed = optional("distributed", f"scheduler {address}")
    import dask  # noqa: PLC0415  # a dependency of distributed

    patience = {"distributed.comm.timeouts.connect": _PATIENCE}
    logging.disable(logging.CRITICAL)  # Dask logs 112 lines for a lost scheduler
    try:
        with dask.config.set(patience), _client(address) as client:
            yield _Scheduler(client)
    except (CancelledError, distributed.client.ClosedClientError):
        raise OutputError(
            f"scheduler {address}", "connection was lost while tasks were running",
            "start it again; the same command continues from the stored results",
        ) from None  # fmt: skip
    finally:
        logging.disable(logging.NOTSET)


def _client(address: str) -> Client:
    """A client of the scheduler; certificates for tls:// are those of Dask's configuration."""
    distributed = optional("distributed", f"scheduler {address}")
    try:
        client: Client = distributed.Client(address, timeout=_PATIENCE)
    except (OSError, ValueError, TypeError, TimeoutError) as error:
        raise InputError(
            f"scheduler {address}",
            f"does not answer ({type(error).__name__})",
            "start one with `dask scheduler`; for tls://, name the certificates in Dask's "
            "configuration",
        ) from None
    return client


class _Scheduler:
    """Workers of a scheduler (see `Pool`)."""

    def __init__(self, client: Any) -> None:
        self._client, self._executor = client, client.get_executor(pure=False, retries=0)
        self._threads, self._asked = 1, -_HOLDS

    @property
    def threads(self) -> int:
        """Number of tasks that run in parallel."""
        if time.monotonic() - self._asked > _HOLDS:
            try:
                self._threads = max(int(sum(self._client.nthreads().values())), 1)
            except (OSError, AttributeError):  # of a lost scheduler
                raise CancelledError from None
            self._asked = time.monotonic()
        return self._threads

    def submit(self, task: Task) -> Future[Answer]:
        """As `Pool.submit`."""
        # partial: Dask searches plain arguments for keys
        future: Future[Answer] = self._executor.submit(functools.partial(answered, task))
        return future
