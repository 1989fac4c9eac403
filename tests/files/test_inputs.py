"""Results record digests of their inputs, and an interrupted study reuses only matching results.

Work is done in this process and interrupted at its third task; then something is changed.
"""

from __future__ import annotations

import hashlib
import importlib
import json
import sys
from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner, Result

import impc.studies.pool
import impc.studies.selection.model_source
from impc.cli.main import main
from impc.studies.pool import Answer, Task
from tests.studies.selection.test_methods import blood_study
from tests.support import ThisProcess

COMMANDS = ("select", "key-parameters")
MODEL = "my_model:blood_model"
# Removed from results before they are compared: run times.
_TIMES = ("made", "seconds")


@pytest.fixture
def study(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Two subjects and visits, and a model in its own file."""
    source = (Path(__file__).parents[2] / "tests/studies/selection/dosing.py").read_text()
    (tmp_path / "my_model.py").write_text(source)
    monkeypatch.syspath_prepend(str(tmp_path))
    path = blood_study(tmp_path, 2, 2)
    text = path.read_text().replace("replicates = 40", "replicates = 4\nstarts = 1")
    path.write_text(text.replace("bound = 0.05", "bound = 0.05\nleast = 1"))
    here(monkeypatch)
    yield path
    sys.modules.pop("my_model", None)


def here(monkeypatch: pytest.MonkeyPatch, stop: int = -1) -> list[str]:
    """Work in this process, interrupted before task `stop`; names of finished tasks."""
    done: list[str] = []

    class Interrupted(ThisProcess):
        def submit(self, task: Task) -> Future[Answer]:
            if len(done) == stop:
                raise KeyboardInterrupt
            done.append(task.name)
            return super().submit(task)

    @contextmanager
    def connected(_: object) -> Iterator[Interrupted]:
        yield Interrupted()

    monkeypatch.setattr("impc.cli.select.connected", connected)
    monkeypatch.setattr(impc.studies.pool, "_AHEAD", 1)
    return done


def run(command: str, study: Path, out: str = "out") -> Result:
    """Run a command as in a new process."""
    sys.modules.pop("my_model", None)
    importlib.invalidate_caches()
    words = [command, str(study), "--model", MODEL, "--out", str(study.parent / out)]
    return CliRunner().invoke(main, words)


def stated(study: Path, out: str = "out") -> dict[str, Any]:
    found: dict[str, Any] = json.loads((study.parent / out / "result.json").read_text())
    found["findings"].get("methods", {}).get("table", {}).pop("seconds_a_subject", None)
    return {key: value for key, value in found.items() if key not in _TIMES}


def sha(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


@pytest.mark.usefixtures("blank_figures")
@pytest.mark.parametrize("command", COMMANDS)
def test_a_result_names_what_it_was_made_of(command: str, study: Path) -> None:
    done = run(command, study)
    assert done.exit_code == 0, done.output
    first = stated(study)
    digests = first["sha256"]
    assert digests["configuration"] == sha(study)
    assert digests["recordings"] == {
        f"sub-{s}_ses-{v}": [sha(study.parent / f"p{s}_v{v}.csv")] for s in (1, 2) for v in (1, 2)
    }
    assert set(digests) == {"recordings", "configuration", "model", "versions", "all"}
    assert MODEL in first["command"]
    assert run(command, study).exit_code == 0
    assert stated(study) == first


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


def recording(study: Path) -> None:
    """Change one digit in the middle: neither size nor ends change."""
    path = study.parent / "p1_v1.csv"
    lines = path.read_text().splitlines()
    number = lines[100].split(",")[-1]
    digit = number.index(".") + 1
    other = number[:digit] + str((int(number[digit]) + 5) % 10) + number[digit + 1 :]
    lines[100] = lines[100].replace(number, other)
    path.write_text("\n".join(lines) + "\n")


def code(study: Path) -> None:
    edit(study.parent / "my_model.py", "(ke * volume)", "(1.1 * ke * volume)")


def settings(study: Path) -> None:
    edit(study, "replicates = 4\nstarts = 1", "replicates = 5\nstarts = 2")


CHANGES = {"recording": recording, "code": code, "settings": settings}


@pytest.mark.usefixtures("blank_figures")
@pytest.mark.parametrize("command", ["key-parameters"])
@pytest.mark.parametrize("changed", [*CHANGES, "versions", "nothing"])
def test_an_interrupted_study_goes_on_with_what_is_the_same(
    command: str, changed: str, study: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here(monkeypatch, stop=3)
    assert run(command, study).exit_code == 130
    kept = list((study.parent / "out" / "in-progress").iterdir())
    assert len(kept) == 3
    if changed in CHANGES:
        CHANGES[changed](study)
    elif changed == "versions":
        monkeypatch.setattr(impc.studies.selection.model_source, "versions", lambda: {"numpy": "0"})
    again = here(monkeypatch)
    assert run(command, study).exit_code == 0
    fresh = here(monkeypatch)
    assert run(command, study, "fresh").exit_code == 0
    assert stated(study) == stated(study, "fresh")
    # A changed recording leaves those of the others as they are.
    spared = {"recording": 2, "nothing": 3}.get(changed, 0)
    assert len(again) == len(fresh) - spared
