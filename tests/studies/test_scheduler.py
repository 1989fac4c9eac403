"""Scheduler with certificates: connection with them, one-line errors without."""

from __future__ import annotations

import contextlib
import logging
import shutil
import subprocess
import time
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import dask
import distributed
import pytest
from distributed.security import Security

import impc
from impc.studies import scheduler as module
from impc.studies.cache import Cache
from impc.studies.pool import Task, run
from impc.studies.scheduler import Cluster, connected

# After the loss of the scheduler, the garbage collector closes the socket at any later time.
pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")

OPENSSL = """\
openssl req -x509 -newkey rsa:2048 -nodes -days 365 -subj /CN=impc-ca -keyout ca-key.pem -out ca.pem
openssl req -newkey rsa:2048 -nodes -subj /CN=impc -keyout key.pem -out request.pem
openssl x509 -req -in request.pem -CA ca.pem -CAkey ca-key.pem -CAcreateserial -out cert.pem
"""


def certificates(folder: Path) -> tuple[Path, Path, Path]:
    """Make a CA, a certificate signed by it, and its key."""
    for line in OPENSSL.splitlines():
        subprocess.run(line, shell=True, cwd=folder, check=True, capture_output=True)
    return folder / "ca.pem", folder / "cert.pem", folder / "key.pem"


def configured(files: tuple[Path, Path, Path]) -> Any:
    """Dask's configuration with the certificates of a client."""
    names = ("ca-file", "client.cert", "client.key")
    return dask.config.set({f"distributed.comm.tls.{name}": str(path)
                            for name, path in zip(names, files, strict=True)})  # fmt: skip


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Path]:
    if shutil.which("openssl") is None:
        pytest.skip("openssl makes the certificates")
    return certificates(tmp_path_factory.mktemp("one"))


@pytest.fixture
def scheduler(files: tuple[Path, Path, Path]) -> Iterator[Any]:
    """Scheduler with one worker in this process."""
    ca, cert, key = map(str, files)
    security = Security(
        tls_ca_file=ca, tls_scheduler_cert=cert, tls_scheduler_key=key, tls_worker_cert=cert,
        tls_worker_key=key, tls_client_cert=cert, tls_client_key=key, require_encryption=True,
    )  # fmt: skip
    make: Any = distributed.LocalCluster
    level = logging.getLogger("distributed").level
    with make(
        n_workers=1, threads_per_worker=1, processes=False, protocol="tls://", host="127.0.0.1",
        security=security, dashboard_address=None, silence_logs=60,
    ) as found:  # fmt: skip
        yield found
    logging.getLogger("distributed").setLevel(level)


def test_a_scheduler_with_certificates(
    scheduler: Any, files: tuple[Path, Path, Path], tmp_path: Path
) -> None:
    address = scheduler.scheduler_address
    assert address.startswith("tls://")
    queue = deque([Task("one", "", abs, (-2,)), Task("two", "", int, ("x\ny",))])
    queue.extend(Task(f"many {number}", "", abs, (number,)) for number in range(50))
    with configured(files), connected(Cluster(address)) as pool:
        assert pool.threads == 1
        found = {result.task.name: result for result in run(pool, queue, Cache(tmp_path))}
    assert found["one"].content == 2
    assert "task two: ValueError: " in str(found["two"].fault)
    assert "\n" not in str(found["two"].fault)
    assert [found[f"many {number}"].content for number in range(50)] == list(range(50))


def test_missing_certificates_and_those_of_somebody_else_are_refused(
    scheduler: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_PATIENCE", "1s")
    others, broken = certificates(tmp_path), tmp_path / "broken.pem"
    broken.write_text("no certificate")
    none = contextlib.nullcontext()
    for given in (none, configured(others), configured((broken, *others[1:]))):
        with (
            given,
            pytest.raises(impc.InputError, match="does not answer") as caught,
            connected(Cluster(scheduler.scheduler_address)),
        ):
            pytest.fail("entered")
        assert "\n" not in str(caught.value)


def test_a_scheduler_that_is_lost(
    scheduler: Any, files: tuple[Path, Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_PATIENCE", "1s")

    def lose() -> None:
        with configured(files), connected(Cluster(scheduler.scheduler_address)) as pool:
            future = pool.submit(Task("long", "", time.sleep, (0.5,)))
            scheduler.close()
            future.result()

    with pytest.raises(impc.OutputError, match="was lost") as caught:
        lose()
    assert "\n" not in str(caught.value)
