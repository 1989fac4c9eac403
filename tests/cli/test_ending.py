"""Endings of commands: one line on stderr, exit status, no incomplete files."""

from __future__ import annotations

import errno
import logging
import os
import re
import signal
import subprocess
import sys
import tempfile
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result

from impc.cli.ending import ExitStatus, ended
from impc.cli.main import main
from impc.errors import ImpcError, brief, one_line

ROOT = Path(__file__).parents[2]
RECORDING = "t,x\n" + "".join(f"{k},{k % 7}\n" for k in range(50))


class OddError(Exception):
    """An exception whose text cannot be formatted."""

    def __str__(self) -> str:
        raise RuntimeError


def failing(monkeypatch: pytest.MonkeyPatch, error: BaseException | type) -> Result:
    def fail(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr("impc.cli.example.run_case", fail)
    return CliRunner().invoke(main, ["example", "--out", "out"])


@pytest.mark.parametrize(
    ("error", "says"),
    [
        (ZeroDivisionError("division by zero"), "ZeroDivisionError: division by zero"),
        (ValueError("three\nlines\nand a " + 9999 * "long array"), r"ValueError: three\nlines\n"),
        (MemoryError(), "out of memory"),
        (RecursionError("too deep"), "RecursionError: too deep"),
        (SystemExit(0), "sys.exit(0) was called"),
        (OddError(), "OddError: a OddError"),
        (BrokenPipeError(errno.EPIPE, "of a worker"), "a pipe broke"),
        (RuntimeWarning("invalid value"), "RuntimeWarning"),
        (OSError(errno.EMFILE, "Too many open files"), "Too many open files"),
    ],
    ids=lambda value: type(value).__name__,
)
def test_what_nobody_foresaw_is_one_line_with_its_place_and_a_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException, says: str
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    done = failing(monkeypatch, error)
    assert done.exit_code == 70
    assert done.stdout == ""
    assert done.stderr.startswith("impc: defect: ")
    assert done.stderr.count("\n") == 1
    assert says in done.stderr
    assert len(done.stderr) < 700
    place = re.search(r"\(impc\.cli\.(?:example|ending), line \d+\)", done.stderr)
    assert place, done.stderr
    (log,) = tmp_path.iterdir()
    assert str(log) in done.stderr
    assert log.stat().st_mode & 0o077 == 0
    assert "Traceback (most recent call last)" in log.read_text()


@pytest.mark.parametrize("where", ["/proc/nowhere", "full"])
def test_a_log_that_cannot_be_written_is_no_second_fault(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, where: str
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path) if where == "full" else where)

    def no_space(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    if where == "full":
        monkeypatch.setattr("traceback.format_exception", no_space)
    done = failing(monkeypatch, KeyError("x"))
    assert done.exit_code == 70
    assert done.stderr.count("\n") == 1
    assert "no log could be written" in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_is_no_defect(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    done = failing(monkeypatch, OSError(errno.ENOSPC, "No space left on device", "out/x.json"))
    assert done.exit_code == 2
    assert done.stderr == "impc: error: out/x.json: No space left on device; free disk space\n"


def test_warnings_of_libraries_go_to_the_log_only(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))

    def work() -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("always")
            np.float64(1) / np.float64(0)
        logging.getLogger("a.library").warning("is building its caches")
        raise LookupError("now")

    before = warnings.showwarning
    assert ended(work) == ExitStatus.DEFECT
    assert warnings.showwarning is before
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.count("\n") == 1
    (log,) = tmp_path.iterdir()
    assert "divide by zero" in log.read_text()
    assert "is building its caches" in log.read_text()


def test_messages_are_one_line_whatever_is_in_them() -> None:
    error = ImpcError("a\nb\x1b[31m\u202e\udcff", "got\r\n" + "x" * 9999, "give another")
    said = str(error)
    assert said.isprintable()
    assert said.startswith(r"a\nb\x1b[31m\u202e\xff: got\r\nxxx")
    assert said.endswith("; give another")
    assert len(said) <= 600
    said.encode("utf-8")
    assert one_line("Grüße, 中文") == "Grüße, 中文"
    assert brief(2**63) == "9223372036854775808"
    assert brief(1 << 20000) == "an integer of about 6021 digits"
    assert len(brief("y" * 1000)) <= 60


def command(
    *words: str, folder: Path, stdout: Any = subprocess.PIPE
) -> subprocess.CompletedProcess[str]:
    """Run `python -m impc` in a folder as a separate process."""
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    return subprocess.run(
        [sys.executable, "-m", "impc", *words],
        cwd=folder, env=environment, stdout=stdout, stderr=subprocess.PIPE, text=True, check=False,
    )  # fmt: skip


INTERRUPTED = """
import atexit, os, signal
def interrupt():
    os.kill(os.getpid(), signal.SIGINT)
def twice():
    try:
        interrupt()
    except KeyboardInterrupt:
        interrupt()
def late():
    atexit.register(interrupt)  # while Python waits for running threads
    interrupt()
class Last:
    def __del__(self, kill=os.kill, me=os.getpid(), number=signal.SIGINT):
        kill(me, number)  # while Python deletes its modules
def last():
    global kept
    kept = Last()
    interrupt()
"""


@pytest.mark.parametrize("function", ["twice", "late", "last"])
def test_interruptions_from_the_keyboard(tmp_path: Path, function: str) -> None:
    (tmp_path / "mine.py").write_text(INTERRUPTED)
    (tmp_path / "a.csv").write_text(RECORDING)
    done = command("inspect", "a.csv", "--plant", f"mine:{function}", folder=tmp_path)
    assert done.returncode == 128 + signal.SIGINT
    assert done.stdout == ""
    assert done.stderr.startswith("impc: interrupted")
    assert done.stderr.count("\n") == 1


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="a device of Linux")
def test_output_that_nobody_takes(tmp_path: Path) -> None:
    with open("/dev/full", "w") as full:
        done = command("--help", folder=tmp_path, stdout=full)
    assert done.returncode == 2
    assert done.stderr == "impc: error: output: No space left on device; free disk space\n"
    reading, writing = os.pipe()
    os.close(reading)
    try:
        done = command("--help", folder=tmp_path, stdout=writing)
    finally:
        os.close(writing)
    assert done.returncode == 128 + signal.SIGPIPE
    assert done.stderr == ""


def test_statuses_are_distinct_and_documented() -> None:
    page = (ROOT / "docs" / "ref" / "cli.md").read_text(encoding="utf-8")
    stated = {int(value) for value in re.findall(r"^\| (\d+) \|", page, re.MULTILINE)}
    assert stated == {status.value for status in ExitStatus}
    assert len(ExitStatus) == 6
