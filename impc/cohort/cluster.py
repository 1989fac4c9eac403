"""A scheduler to run on: this machine's own workers, or one that somebody else has started."""

from __future__ import annotations

import os
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import dask
import distributed

from impc.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from distributed import Client

__all__ = ["connected"]

_PATIENCE = "10s"
# A worker that dies takes its task with it; so many deaths, and the task is taken for the cause.
_DEATHS = 10
# Bytes of freed memory that a worker may keep.
_KEPT = 256 << 20


@contextmanager
def connected(scheduler: str | None, workers: int | None) -> Iterator[Client]:
    """A client of a running scheduler, or of workers on this machine while the block lasts.

    Local workers are processes of one thread each; they listen on this machine alone.

    Raises
    ------
    InputError
        When no scheduler answers at the address.
    """
    settings = {
        "distributed.scheduler.allowed-failures": _DEATHS,
        # Nothing is shown in a browser: no ports are opened for it.
        "distributed.worker.daemon": True,
        "distributed.admin.tick.limit": "1 minute",
        "distributed.comm.timeouts.connect": _PATIENCE,
        # Dask's profiler keeps a tree of calls for every second of an hour: 0.25 MB a second here.
        "distributed.worker.profile.enabled": False,
        # Dask has freed memory given back to the system at once. A fit takes and frees arrays of
        # some megabytes all the time, and would spend a third of its time on that.
        "distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_": _KEPT,
        "distributed.nanny.pre-spawn-environ.MALLOC_MMAP_THRESHOLD_": _KEPT,
    }
    with dask.config.set(settings):
        if scheduler is not None:
            with _remote(scheduler) as client:
                yield client
            return
        make: Any = distributed.LocalCluster
        with (
            make(
                n_workers=workers or os.cpu_count() or 1,
                threads_per_worker=1,
                host="127.0.0.1",
                # The scheduler has an HTTP server in any case: one that shows nothing, for this
                # machine only, and not on 8787, which may be taken.
                scheduler_kwargs={"dashboard": False, "dashboard_address": "127.0.0.1:0"},
                silence_logs=50,
            ) as cluster,
            distributed.Client(cluster) as client,
        ):
            yield client


@contextmanager
def _remote(address: str) -> Iterator[Client]:
    try:
        client = distributed.Client(address, timeout=_PATIENCE)
    except (OSError, ValueError, TimeoutError) as error:
        raise InputError(
            f"scheduler {address}",
            f"does not answer ({type(error).__name__})",
            "start one with `dask scheduler`, and give its address",
        ) from None
    with client:
        yield client
