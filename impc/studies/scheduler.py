"""Connection to workers: processes on this machine, or a running Dask scheduler."""

from __future__ import annotations

import functools
import logging
import time
from concurrent.futures import CancelledError
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from impc.errors import InputError, OutputError
from impc.extras import optional
from impc.studies.pool import answered, processes

if TYPE_CHECKING:
    from collections.abc import Iterator
    from concurrent.futures import Future
    from pathlib import Path

    from distributed import Client

    from impc.studies.pool import Answer, Pool, Task

_PATIENCE = "10s"
# Seconds for which the number of threads is cached; a query takes a millisecond.
_HOLDS = 5.0


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
    address = cluster.scheduler
    if address is None:
        if any((cluster.tls_ca, cluster.tls_cert, cluster.tls_key)):
            raise InputError("--tls-ca", "is given without --scheduler", "remove the --tls options")
        with processes(cluster.workers) as pool:
            yield pool
        return
    distributed = optional("distributed", f"scheduler {address}")
    import dask  # noqa: PLC0415  # a dependency of distributed

    security = _security(cluster, address)
    patience = {"distributed.comm.timeouts.connect": _PATIENCE}
    logging.disable(logging.CRITICAL)  # Dask logs 112 lines for a lost scheduler
    try:
        with dask.config.set(patience), _client(address, security) as client:
            yield _Scheduler(client)
    except (CancelledError, distributed.client.ClosedClientError):
        raise OutputError(
            f"scheduler {address}", "connection was lost while tasks were running",
            "start it again; the same command continues from the stored results",
        ) from None  # fmt: skip
    finally:
        logging.disable(logging.NOTSET)


def _client(address: str, security: Any) -> Client:
    distributed = optional("distributed", f"scheduler {address}")
    try:
        client: Client = distributed.Client(address, timeout=_PATIENCE, security=security)
    except (OSError, ValueError, TypeError, TimeoutError) as error:
        raise InputError(
            f"scheduler {address}",
            f"does not answer ({type(error).__name__})",
            "start one with `dask scheduler`, and pass its address and certificates",
        ) from None
    return client


def _security(cluster: Cluster, address: str) -> Any:
    """Certificates of the connection, from the options of the command; None without."""
    options = ("--tls-ca", "--tls-cert", "--tls-key")
    files = dict(zip(options, (cluster.tls_ca, cluster.tls_cert, cluster.tls_key), strict=True))
    where, given = f"scheduler {address}", {name: path for name, path in files.items() if path}
    if not address.startswith("tls://"):
        if given:
            raise InputError(where, "takes no certificates", "use an address tls://...")
        return None
    for name, path in given.items():
        if not path.is_file():
            raise InputError(f"{name} {path}", "is not a file", "check the path")
    if len(given) < len(files):
        missing = ", ".join(name for name in files if name not in given)
        raise InputError(where, f"needs {missing}", "pass all three files")
    ca, cert, key = map(str, given.values())
    return optional("distributed", where).Security(
        tls_ca_file=ca, tls_client_cert=cert, tls_client_key=key, require_encryption=True
    )


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
