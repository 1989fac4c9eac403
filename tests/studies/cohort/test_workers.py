"""Workers on this machine: they work, they may die, and nobody else reaches them."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import psutil

from impc.studies.cohort.workers import local_workers

ROOT = Path(__file__).parents[3]


def square(value: int) -> int:
    return value * value


def die(value: int, marks: str) -> int:
    """Ends its process the first time, and always for 13."""
    mark = Path(marks) / str(value)
    if value == 13 or not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return value


def fail(text: str) -> None:
    if text == "exit":
        raise SystemExit(0)
    raise ValueError(f"two\nlines of {text}")


def test_tasks_deaths_and_faults(tmp_path: Path) -> None:
    with local_workers(2) as workers:
        for value in range(5):
            workers.submit(value, square, value)
        assert {done.key: done.value for done in workers.results()} == {k: k * k for k in range(5)}
        workers.submit("once", die, 1, str(tmp_path))
        workers.submit("always", die, 13, str(tmp_path))
        workers.submit("exit", fail, "exit")
        workers.submit("error", fail, "text")
        found = {done.key: done for done in workers.results()}
        assert found["once"].value == 1
        assert found["always"].fault == "its worker ended 4 times, at last with signal 9"
        assert found["exit"].fault == "SystemExit: 0"
        assert found["error"].fault == "ValueError: two lines of text"
        family = [psutil.Process(), *psutil.Process().children(recursive=True)]
        listening = [
            one for process in family for one in process.net_connections() if one.status == "LISTEN"
        ]
        assert listening == []
    assert not [one for one in psutil.Process().children() if _works(one)]


def _works(child: psutil.Process) -> bool:
    """Whether a child is a worker that lives; what another test left behind has no command line."""
    if child.status() == psutil.STATUS_ZOMBIE:
        return False
    return "spawn_main" in " ".join(child.cmdline())


def test_a_module_of_the_current_folder_does_not_stand_in_for_pythons(tmp_path: Path) -> None:
    """A worker starts with the folder's modules out of reach: multiprocessing, pickle, numpy."""
    for name in ("multiprocessing", "pickle", "numpy", "impc"):
        (tmp_path / f"{name}.py").write_text("open('taken', 'w').close()\nraise SystemExit(3)\n")
    code = (
        "import sys; sys.path[:0] = sys.argv[1:]\n"
        "from impc.studies.cohort.workers import local_workers\n"
        "if __name__ == '__main__':\n"
        "    with local_workers(1) as workers:\n"
        "        workers.submit(1, abs, -2)\n"
        "        print([done.value for done in workers.results()])\n"
    )
    done = subprocess.run(
        [sys.executable, "-P", "-c", code, str(ROOT)], cwd=tmp_path, capture_output=True, text=True,
        timeout=120, check=False, env={k: v for k, v in os.environ.items() if k != "PYTHONPATH"},
    )  # fmt: skip
    assert done.stdout == "[2]\n", done.stderr
    assert not (tmp_path / "taken").exists()
