"""`impc cohort`: same tables for all kinds of workers, after crashes, and with failures."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pandas as pd
import psutil
import pytest
from click.testing import CliRunner, Result

from impc.cli.main import main
from tests.studies.cohort.carts import write_study
from tests.studies.test_scheduler import certificates
from tests.support import leave_blank

ROOT = Path(__file__).parents[2]
SEED = 8
UNITS, REPLICATES = 2, 20
TABLES = ("units.csv", "replicates.csv", "intervals.csv")


def command(study: Path, out: Path, *more: str) -> list[str]:
    return [
        sys.executable, "-m", "impc", "cohort", str(study), "--out", str(out),
        "--plant", "tests.studies.cohort.carts:cart_plant", *more,
    ]  # fmt: skip


def run(study: Path, out: Path, *more: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        command(study, out, *more), cwd=ROOT, capture_output=True, text=True, check=False
    )


def run_here(study: Path, out: Path, *more: str) -> Result:
    """Run the command in this process; its workers are separate processes."""
    return CliRunner().invoke(main, command(study, out, *more)[3:])


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_study(tmp_path_factory.mktemp("study"), UNITS, replicates=REPLICATES)


@pytest.fixture(scope="module")
def undisturbed(study: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Reference result with one worker."""
    out = tmp_path_factory.mktemp("undisturbed")
    with pytest.MonkeyPatch.context() as patch:
        leave_blank(patch)
        done = run_here(study, out, "--workers", "1")
    assert done.exit_code == 0, done.stderr
    return out


def same_tables(one: Path, other: Path) -> None:
    for name in TABLES:
        assert (one / name).read_bytes() == (other / name).read_bytes(), name


def test_the_tables_are_whole(undisturbed: Path) -> None:
    units = pd.read_csv(undisturbed / "units.csv", dtype={"subject": str})
    assert len(units) == UNITS
    assert set(units["group"]) == {"a", "b"}
    replicates = pd.read_csv(undisturbed / "replicates.csv")
    assert len(replicates) == UNITS * REPLICATES
    assert not replicates.duplicated(["unit", "replicate"]).any()
    intervals = pd.read_csv(undisturbed / "intervals.csv")
    inside = (intervals["low"] < intervals["value"]) & (intervals["value"] < intervals["high"])
    assert inside.mean() > 0.9
    assert (undisturbed / "subjects" / "sub-01.html").exists()
    found = json.loads((undisturbed / "result.json").read_text())
    assert found["fitted"] == UNITS


def workers_of(process: psutil.Process) -> list[psutil.Process]:
    """Worker processes: those without children."""
    children = process.children(recursive=True)
    names = [" ".join(item.cmdline()) for item in children if item.is_running()]
    return [
        item
        for item, name in zip(children, names, strict=False)
        if "spawn_main" in name and not item.children()
    ]


@pytest.mark.parametrize(
    "kills",
    [pytest.param((1, 1), marks=pytest.mark.full), pytest.param((3, 2), marks=pytest.mark.full)],
)
def test_workers_and_client_may_die(
    study: Path, undisturbed: Path, tmp_path: Path, kills: tuple[int, int]
) -> None:
    """Workers killed at random before and after the client is killed once; seed 8.

    A machine so fast that a run ends before all of its workers were killed has killed fewer.
    """
    rng = random.Random(SEED)
    out = tmp_path / "out"
    killed = 0
    for count, kill_client in zip(kills, (True, False), strict=True):
        before = len(list((out / "units").rglob("replicate-*.json")))
        client = subprocess.Popen(
            command(study, out, "--workers", "2"), cwd=ROOT, stderr=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
        )  # fmt: skip
        process = psutil.Process(client.pid)
        for _ in range(count):
            workers: list[psutil.Process] = []
            while client.poll() is None and not workers:
                time.sleep(0.005)
                if len(list((out / "units").rglob("replicate-*.json"))) > before + 4:
                    workers = workers_of(process)
            if not workers:
                break
            os.kill(rng.choice(workers).pid, signal.SIGKILL)
            killed += 1
            before = len(list((out / "units").rglob("replicate-*.json")))
        if kill_client and client.poll() is None:
            family = [process, *process.children(recursive=True)]
            os.kill(client.pid, signal.SIGKILL)
            client.wait()
            for item in family[1:]:
                if item.is_running():
                    item.kill()
            assert not (out / "units.csv").exists()
        else:
            assert client.wait() == 0
    assert 1 <= killed <= sum(kills)
    same_tables(out, undisturbed)
    log = (out / "cohort.log").read_text()
    finished = [
        line.split(" in ")[0].split(" ", 1)[1] for line in log.splitlines() if ": replicate" in line
    ]
    assert len(finished) == len(set(finished)), "a replicate was written twice"


@pytest.mark.usefixtures("blank_figures")
def test_going_on_repeats_nothing(study: Path, undisturbed: Path) -> None:
    stamps = {path: path.stat().st_mtime_ns for path in undisturbed.rglob("units/**/*.json")}
    done = run_here(study, undisturbed, "--workers", "1")
    assert done.exit_code == 0, done.stderr
    assert {path: path.stat().st_mtime_ns for path in stamps} == stamps
    assert "columns that the plant has no argument for: age (not used)" in done.stdout


@contextmanager
def scheduler_and_workers(folder: Path, workers: int, *tls: str) -> Iterator[tuple[Any, str]]:
    """Start a scheduler process with Dask's options `tls`; yield it and its address."""
    place = folder / "scheduler.json"
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1"}
    quiet: Any = {
        "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "env": environment, "cwd": ROOT,
    }  # fmt: skip
    common = ["--no-dashboard", "--scheduler-file", str(place), *tls]
    host = "tls://127.0.0.1" if tls else "127.0.0.1"
    server = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--host", host, "--port", "0"]
    worker = [sys.executable, "-m", "distributed.cli.dask_worker", "--nthreads", "1"]
    started = [subprocess.Popen([*server, *common], **quiet)]
    for _ in range(workers):
        started.append(
            subprocess.Popen([*worker, *common, "--local-directory", str(folder)], **quiet)
        )
    try:
        while not place.exists():
            time.sleep(0.05)
        yield started[0], json.loads(place.read_text())["address"]
    finally:
        for process in reversed(started):
            process.terminate()
        for process in started:
            process.wait()


@pytest.mark.full
@pytest.mark.parametrize("secure", [False, True])
def test_a_killed_scheduler_is_one_line_and_the_run_goes_on(
    secure: bool, study: Path, undisturbed: Path, tmp_path: Path
) -> None:
    """Kill the scheduler during the run; then continue on this machine from stored results."""
    out, given, tls = tmp_path / "out", dict[str, str](), list[str]()
    if secure:
        ca, cert, key = map(str, certificates(tmp_path))
        tls = ["--tls-ca-file", ca, "--tls-cert", cert, "--tls-key", key]
        names = ("CA_FILE", "CLIENT__CERT", "CLIENT__KEY")
        given = {f"DASK_DISTRIBUTED__COMM__TLS__{name}": path
                 for name, path in zip(names, (ca, cert, key), strict=True)}  # fmt: skip
    with scheduler_and_workers(tmp_path, 1, *tls) as (server, address):
        if secure:
            refused = run(study, out, "--scheduler", address)
            assert refused.returncode == 2
            assert "does not answer" in refused.stderr
            assert len(refused.stderr.splitlines()) == 1
        client = subprocess.Popen(
            command(study, out, "--scheduler", address), cwd=ROOT, text=True,
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=os.environ | given,
        )  # fmt: skip
        while client.poll() is None and len(list((out / "units").rglob("replicate-*.json"))) < 3:
            time.sleep(0.005)
        server.kill()
        said = client.communicate()
    assert client.returncode == 2, said
    assert said[0] == "columns that the plant has no argument for: age (not used)\n"
    assert len(said[1].splitlines()) == 1
    assert "connection was lost while tasks were running" in said[1]
    assert len(list((out / "units").rglob("replicate-*.json"))) >= 3
    done = run(study, out, "--workers", "1")
    assert done.returncode == 0, done.stderr
    same_tables(out, undisturbed)


@pytest.mark.usefixtures("blank_figures")
@pytest.mark.parametrize(
    ("subjects", "damaged"),
    [
        pytest.param(5, (1, 3, 4), marks=pytest.mark.full),
        pytest.param(30, (4, 11, 29), marks=pytest.mark.slow),
    ],
)
def test_damaged_recordings_stop_nobody_else(
    tmp_path: Path, subjects: int, damaged: tuple[int, ...]
) -> None:
    """Three failing units: results of the others, three reasons, status 1; then repaired."""
    study = write_study(tmp_path, subjects)
    names = [tmp_path / f"sub-{number:02d}" / "cart_1.csv" for number in damaged]
    whole = {path: path.read_bytes() for path in names}
    names[0].write_bytes(b"")
    names[1].write_bytes(whole[names[1]][:2000] + b"abc,def,ghi\n")
    names[2].write_bytes(whole[names[2]].replace(b"position", b"elsewhere"))
    out = tmp_path / "out"
    done = run_here(study, out, "--workers", "1")
    assert done.exit_code == 1, done.stderr
    found = json.loads((out / "result.json").read_text())
    assert found["fitted"] == subjects - 3
    assert set(found["failed"]) == {f"sub-{number:02d}_ses-1" for number in damaged}
    assert len(pd.read_csv(out / "units.csv")) == subjects - 3
    reasons = [line for line in done.stderr.splitlines() if line.startswith("sub-")]
    assert len(reasons) == 3
    assert f"{subjects - 3} of {subjects} fits done" in done.stdout
    for path, content in whole.items():
        path.write_bytes(content)
    again = run_here(study, out, "--workers", "1")
    assert again.exit_code == 0, again.stderr
    assert len(pd.read_csv(out / "units.csv")) == subjects
