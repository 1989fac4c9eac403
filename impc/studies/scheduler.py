"""Connection to workers: processes on this machine, or a running Dask scheduler."""

from __future__ import annotations

import asyncio
import functools
import logging
import time
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from impc.errors import InputError, OutputError
from impc.extras import optional
from impc.studies.pool import answered, processes

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from distributed import Client

    from impc.studies.pool import Answer, Pool, Task

_PATIENCE = "10s"
# Seconds for which the number of threads is cached; a query takes a millisecond.
_HOLDS = 5.0
_OPTIONS = ("--tls-ca", "--tls-cert", "--tls-key")


@dataclass(frozen=True)
class Cluster:
    """Workers to use."""

    scheduler: str | None = None  # Address of a running Dask scheduler; None: this machine
    workers: int | None = None  # Number of workers on this machine; None: one per processor
    # For an address tls://: CA certificate, client certificate and its private key
    tls_ca: Path | None = None
    tls_cert: Path | None = None
    tls_key: Path | None = None


@contextmanager
def connected(cluster: Cluster) -> Iterator[Pool]:
    """Connect to the workers of a `cluster` during the block."""
    if cluster.scheduler is None:
        if any((cluster.tls_ca, cluster.tls_cert, cluster.tls_key)):
            raise InputError("--tls-ca", "is given without --scheduler", "remove the --tls options")
        with processes(cluster.workers) as pool:
            yield pool
        return
    with _client(cluster, cluster.scheduler) as client:
        yield _Scheduler(client, cluster.scheduler)


@contextmanager
def _client(cluster: Cluster, address: str) -> Iterator[Client]:
    distributed = optional("distributed", f"scheduler {address}")
    import dask  # noqa: PLC0415  # a dependency of distributed

    security = _security(cluster, address)
    patience = {"distributed.comm.timeouts.connect": _PATIENCE}
    with dask.config.set(patience), _silent():
        try:
            client = distributed.Client(address, timeout=_PATIENCE, security=security)
        except (OSError, ValueError, TypeError, TimeoutError) as error:
            raise InputError(
                f"scheduler {address}",
                f"does not answer ({type(error).__name__})",
                "start one with `dask scheduler`, and pass its address and certificates",
            ) from None
        with client:
            yield client


@contextmanager
def _silent() -> Iterator[None]:
    """Silence Dask's log, for example 112 lines for a lost scheduler."""
    logging.disable(logging.CRITICAL)
    try:
        yield
    finally:
        logging.disable(logging.NOTSET)


def _security(cluster: Cluster, address: str) -> Any:
    files = dict(zip(_OPTIONS, (cluster.tls_ca, cluster.tls_cert, cluster.tls_key), strict=True))
    missing = [name for name, path in files.items() if path is None]
    if not address.startswith("tls://"):
        if len(missing) < len(files):
            raise InputError(
                f"scheduler {address}", "takes no certificates", "use an address tls://..."
            )
        return None
    if missing:
        raise InputError(
            f"scheduler {address}", f"needs {', '.join(missing)}", "pass all three files"
        )
    for name, path in files.items():
        if path is None or not path.is_file():
            raise InputError(f"{name} {path}", "is not a file", "check the path")
    distributed = optional("distributed", f"scheduler {address}")
    return distributed.Security(
        tls_ca_file=str(cluster.tls_ca),
        tls_client_cert=str(cluster.tls_cert),
        tls_client_key=str(cluster.tls_key),
        require_encryption=True,
    )


@contextmanager
def _reached(address: str) -> Iterator[None]:
    """Convert Dask's exceptions for a lost scheduler to OutputError."""
    closed = optional("distributed", f"scheduler {address}").client.ClosedClientError
    try:
        yield
    except (OSError, closed, asyncio.CancelledError):
        raise _was_lost(address) from None


def _was_lost(address: str) -> OutputError:
    return OutputError(
        f"scheduler {address}", "connection was lost while tasks were running",
        "start it again; the same command continues from the stored results",
    )  # fmt: skip


class _Scheduler:
    """Workers of a scheduler (see `Pool`); methods raise OutputError if it is lost."""

    def __init__(self, client: Client, address: str) -> None:
        self._client, self._address = client, address
        self._numbers: dict[Any, int] = {}
        make = optional("distributed", f"scheduler {address}").as_completed
        # with_results: fetch results in the background.
        self._out = make(with_results=True, raise_errors=False)
        self._threads, self._asked = 1, -_HOLDS

    @property
    def threads(self) -> int:
        """Number of tasks that run in parallel."""
        if time.monotonic() - self._asked > _HOLDS:
            client: Any = self._client
            with _reached(self._address):
                self._threads = max(int(sum(client.nthreads().values())), 1)
            self._asked = time.monotonic()
        return self._threads

    def submit(self, number: int, batch: list[Task]) -> None:
        """As `Pool.submit`."""
        work = functools.partial(answered, batch)  # partial: Dask searches plain arguments for keys
        with _reached(self._address):
            future = self._client.submit(work, pure=False, retries=0)
        self._numbers[future] = number
        self._out.add(future)

    def take(self) -> tuple[int, list[Answer] | str]:
        """As `Pool.take`."""
        with _reached(self._address):
            future, answers = next(self._out)
            if future.status in ("cancelled", "lost"):
                raise _was_lost(self._address)
            number, error = self._numbers.pop(future), future.status == "error"
            fault = future.exception() if error else None
            future.release()
        return number, answers if fault is None else f"{type(fault).__name__}: {fault}"
