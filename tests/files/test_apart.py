"""The reader process: limits, failures, and what its parent reports."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np
import pytest

import impc
from impc.errors import DataError
from impc.files import apart
from impc.files.formats import read_table
from impc.files.table import Table
from tests.files.samples import hdf5_mat, pushed_seat

SEAT = pushed_seat(60)
# One line is read, and then the process ends in some way.
BEGIN = "import os, signal, sys, time; sys.stdin.buffer.readline(); "


@pytest.fixture
def sound(tmp_path: Path) -> Path:
    path = tmp_path / "trial.mat"
    hdf5_mat(path, SEAT)
    return path


@pytest.fixture
def fresh() -> Iterator[None]:
    """No reader process before the test, and none of the test's after it."""
    apart._ended()
    yield
    apart._ended()


def refusal(path: Path) -> str:
    with pytest.raises(DataError) as caught:
        read_table(path)
    assert "\n" not in str(caught.value)
    return caught.value.problem


def require_sound(table: Table) -> None:
    for name, values in SEAT.items():
        np.testing.assert_array_equal(table.columns[name], values)
        assert not table.columns[name].flags.writeable


def test_one_process_serves_many_files(sound: Path, fresh: None) -> None:
    require_sound(read_table(sound))
    first = apart._children[os.getpid()].pid
    for _ in range(3):
        require_sound(read_table(sound))
    assert apart._children[os.getpid()].pid == first


def test_messages_name_the_file_as_it_was_given(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hdf5_mat(tmp_path / "t.mat", {"x": np.arange(9.0)}, {"x": "char"})
    monkeypatch.chdir(tmp_path)
    with pytest.raises(DataError) as caught:
        read_table(Path("t.mat"))
    assert caught.value.subject == "t.mat"
    hdf5_mat(tmp_path / "t.mat", SEAT)
    assert read_table(Path("t.mat")).source == "t.mat"


def test_a_name_in_a_reason_is_of_one_line(tmp_path: Path) -> None:
    hdf5_mat(tmp_path / "t.mat", SEAT)
    with h5py.File(tmp_path / "t.mat", "r+") as file:
        file["a\n\x1b[2J"] = h5py.SoftLink("seat")
    assert refusal(tmp_path / "t.mat") == r"a\n\x1b[2J is a link"


@pytest.mark.parametrize(
    ("end", "says"),
    [
        (
            "os.kill(os.getpid(), signal.SIGSEGV)",
            "is damaged and ends the process that reads it (S",
        ),
        ("os.kill(os.getpid(), signal.SIGABRT)", "(SIGABRT)"),
        ("os.kill(os.getpid(), signal.SIGXCPU)", "takes longer than 10 s to read"),
        ("os.kill(os.getpid(), signal.SIGKILL)", "takes more than 0.8 GB to read"),
        ("os._exit(7)", "(status 7)"),
    ],
)
def test_a_reader_that_ends(
    sound: Path, fresh: None, monkeypatch: pytest.MonkeyPatch, end: str, says: str
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(apart, "_START", BEGIN + end)
        assert says in refusal(sound)
    require_sound(read_table(sound))


def test_a_reader_that_ended_between_two_files_is_no_verdict(sound: Path, fresh: None) -> None:
    read_table(sound)
    first = apart._children[os.getpid()]
    first.kill()
    first.wait()
    require_sound(read_table(sound))
    assert apart._children[os.getpid()].pid != first.pid


def test_too_much_memory(
    sound: Path, tmp_path: Path, fresh: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "large.mat"
    hdf5_mat(path, {})
    with h5py.File(path, "r+") as file:  # 160 MB in 160 kB, and all as the header says
        file.create_dataset("x", data=np.zeros((1, 20_000_000)), compression="gzip")
    monkeypatch.setattr(apart, "_ROOM", 100_000_000)
    assert "takes more than 0.1 GB to read" in refusal(path)
    require_sound(read_table(sound))
    assert "takes more than 0.1 GB to read" in refusal(path)  # and so of a process that served


@pytest.mark.skipif(sys.platform == "win32", reason="its limit is the watch alone")
def test_a_reader_that_is_watched(
    sound: Path, fresh: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    # As on systems that cannot limit the address space.
    monkeypatch.setattr(apart, "_BOUNDED", False)
    require_sound(read_table(sound))
    apart._ended()
    grows = BEGIN + "x = []\nwhile True: x.append(bytes([1]) * 10_000_000); time.sleep(0.01)"
    monkeypatch.setattr(apart, "_START", grows)
    monkeypatch.setattr(apart, "_ROOM", 200_000_000)
    assert "takes more than 0.2 GB to read" in refusal(sound)


def test_a_reader_that_cannot_start(
    sound: Path, fresh: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "executable", "/nowhere/python")
    assert "cannot be started (No such file or directory)" in refusal(sound)


def test_threads_take_turns(sound: Path, fresh: None) -> None:
    tables: list[Table] = []
    threads = [threading.Thread(target=lambda: tables.append(read_table(sound))) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(tables) == 8
    for table in tables:
        require_sound(table)


def _pid_of_a_fork(path: str, pipe: int) -> None:
    read_table(Path(path))
    os.write(pipe, str(apart._children[os.getpid()].pid).encode())


@pytest.mark.skipif(not hasattr(os, "fork"), reason="the system has no forks")
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")  # threads of other tests
def test_a_fork_has_a_reader_of_its_own(sound: Path, fresh: None) -> None:
    read_table(sound)
    here, there = os.pipe()
    fork = multiprocessing.get_context("fork").Process(
        target=_pid_of_a_fork, args=(str(sound), there)
    )
    fork.start()
    fork.join()
    found = int(os.read(here, 20))
    os.close(here)
    os.close(there)
    assert found != apart._children[os.getpid()].pid
    require_sound(read_table(sound))


def in_a_script(folder: Path, text: str) -> subprocess.CompletedProcess[str]:
    """Run a script without a guard, from a folder in which strange modules stand."""
    for name in ("h5py", "json", "impc", "numpy"):
        (folder / f"{name}.py").write_text("raise SystemExit('code of a stranger')\n")
    root = str(Path(impc.__path__[0]).parent)
    begin = f"import sys; sys.path[:] = [p for p in sys.path if p]; sys.path.insert(0, {root!r})\n"
    return subprocess.run(
        [sys.executable, "-P", "-c", begin + text],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONPATH": root},
    )


def test_from_a_script_in_a_folder_of_strangers(sound: Path) -> None:
    text = (
        "from pathlib import Path\nfrom impc.files.formats import read_table\n"
        f"print(read_table(Path({sound.name!r})).samples)\n"
    )
    done = in_a_script(sound.parent, text)
    assert (done.stdout, done.stderr) == ("60\n", "")


@pytest.mark.parametrize("typed", [False, True])
def test_a_script_without_a_guard_runs_once(sound: Path, typed: bool) -> None:
    script = sound.with_name("script.py")
    script.write_text(
        "print('begins')\nfrom pathlib import Path\nfrom impc.files.formats import read_table\n"
        f"print(read_table(Path({str(sound)!r})).samples)\n"
    )
    done = subprocess.run(
        [sys.executable, "-" if typed else str(script)],
        input=script.read_text() if typed else "",
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONPATH": str(Path(impc.__path__[0]).parent)},
    )
    assert (done.stdout, done.stderr) == ("begins\n60\n", "")


@pytest.mark.skipif(sys.platform == "win32", reason="its interrupts are others")
def test_an_interrupt_leaves_no_reader_behind(sound: Path) -> None:
    text = (
        "import os, signal, sys, threading\nfrom pathlib import Path\n"
        "from impc.files import apart\nfrom impc.files.formats import read_table\n"
        # Background processes of a shell ignore interrupts.
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        f"read_table(Path({sound.name!r}))\n"
        "pid = apart._children[os.getpid()].pid\n"
        "os.kill(pid, signal.SIGSTOP)\n"  # it will not answer
        "threading.Timer(0.5, lambda: os.kill(os.getpid(), signal.SIGINT)).start()\n"
        "try:\n"
        f"    read_table(Path({sound.name!r}))\n"
        "except KeyboardInterrupt:\n"
        "    try:\n"
        "        os.kill(pid, 0)\n"
        "    except ProcessLookupError:\n"
        "        print('interrupted')\n"
    )
    done = in_a_script(sound.parent, text)
    assert (done.stdout, done.stderr) == ("interrupted\n", "")


@pytest.mark.skipif(sys.platform == "win32", reason="its signals are others")
def test_a_reader_ends_with_whoever_started_it(sound: Path) -> None:
    text = (
        "import os, signal\nfrom pathlib import Path\n"
        "from impc.files import apart\nfrom impc.files.formats import read_table\n"
        f"read_table(Path({sound.name!r}))\n"
        "print(apart._children[os.getpid()].pid, flush=True)\n"
        "os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    done = in_a_script(sound.parent, text)
    assert done.returncode == -signal.SIGKILL
    pid = int(done.stdout)
    # communicate() above returned because no process holds the pipes: the reader has ended or will.
    for _ in range(1000):
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return
        threading.Event().wait(0.01)
    pytest.fail("the reader is still there")
