"""Workers: results, crashes, isolation; the cache computes once and ignores foreign files."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

import impc
from impc.arrays import Array, Frozen, frozen
from impc.studies.cache import Cache, Steps, from_json
from impc.studies.pool import Pool, Result, Task, processes, run
from tests.support import ThisProcess

ROOT = Path(__file__).parents[2]


def square(value: int) -> int:
    return value * value


def die(value: int, marks: str) -> int:
    """Kill the worker at the first call, and always for 13."""
    mark = Path(marks) / str(value)
    if value == 13 or not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return value


def refuse() -> None:
    raise impc.DataError("subject 3", "fell", "leave it out")


def fail(text: str) -> None:
    if text == "exit":
        raise SystemExit(0)
    raise ValueError(f"two\nlines of {text}")


def task(name: str, work: Callable[..., Any], *given: Any) -> Task:
    return Task(name, "digest", work, given)


def results(pool: Pool, folder: Path, *tasks: Task) -> dict[str, Result]:
    return {item.task.name: item for item in run(pool, deque(tasks), Cache(folder))}


def test_tasks_deaths_and_faults(tmp_path: Path) -> None:
    with processes(2) as pool:
        found = results(
            pool, tmp_path / "kept", *(task(f"{value}", square, value) for value in range(9)),
            task("once", die, 1, str(tmp_path)), task("always", die, 13, str(tmp_path)),
            task("exit", fail, "exit"), task("error", fail, "text"),
            task("refused", refuse), task("unsent", abs, lambda: None),
        )  # fmt: skip
        assert found["once"].content == 1
        assert [found[f"{value}"].content for value in range(9)] == [k * k for k in range(9)]
        faults = {name: str(item.fault) for name, item in found.items()}
        assert "worker: died 4 times;" in faults["always"]
        assert "task exit: SystemExit: 0;" in faults["exit"]
        assert "task error: ValueError: two\\nlines of text;" in faults["error"]
        assert faults["refused"] == "subject 3: fell; leave it out"
        assert "pickle" in faults["unsent"]
        family = [psutil.Process(), *psutil.Process().children(recursive=True)]
        listening = [
            one for process in family for one in process.net_connections() if one.status == "LISTEN"
        ]
        assert listening == []
    assert not [one for one in psutil.Process().children() if _works(one)]


def test_what_is_kept_is_not_done_again_and_more_may_follow(tmp_path: Path) -> None:
    """Each result adds a task; after an interruption only a damaged one is repeated."""
    made: list[int] = []

    def count(value: int) -> int:
        made.append(value)
        return value

    def results() -> Iterator[tuple[int, bool]]:
        queue = deque([task("0", count, 0)])
        for item in run(ThisProcess(), queue, Cache(tmp_path)):
            yield item.content, item.found
            if item.content < 5:
                queue.append(task(f"{item.content + 1}", count, item.content + 1))

    first = results()
    assert [next(first) for _ in range(4)] == [(k, False) for k in range(4)]
    Cache(tmp_path).path("1").write_text("{}")
    made.clear()
    assert [*results()] == [(k, k in (0, 2, 3)) for k in range(6)]
    assert made == [1, 4, 5]


def _works(child: psutil.Process) -> bool:
    """Whether a child process is a live worker; zombies have no command line."""
    if child.status() == psutil.STATUS_ZOMBIE:
        return False
    return "spawn_main" in " ".join(child.cmdline())


def test_a_module_of_the_current_folder_does_not_stand_in_for_pythons(tmp_path: Path) -> None:
    """Workers do not import modules from the current folder: multiprocessing, pickle, numpy."""
    for name in ("multiprocessing", "pickle", "numpy", "impc"):
        (tmp_path / f"{name}.py").write_text("open('taken', 'w').close()\nraise SystemExit(3)\n")
    code = (
        "import sys; sys.path[:0] = sys.argv[1:]\n"
        "from impc.studies.pool import Task, processes\n"
        "if __name__ == '__main__':\n"
        "    with processes(1) as pool:\n"
        "        print(pool.submit(Task('', '', abs, (-2,))).result()[0])\n"
    )
    done = subprocess.run(
        [sys.executable, "-P", "-c", code, str(ROOT)], cwd=tmp_path, capture_output=True, text=True,
        timeout=120, check=False, env={k: v for k, v in os.environ.items() if k != "PYTHONPATH"},
    )  # fmt: skip
    assert done.stdout == "2\n", done.stderr
    assert not (tmp_path / "taken").exists()


@dataclass(frozen=True)
class Found(Frozen):
    """Result of a step."""

    gain: Array
    parts: tuple[Array, ...]
    names: tuple[str, ...]
    value: float | None


def decode(kept: Any) -> Found:
    return from_json(kept, Found)


def found(seed: int) -> Found:
    rng = np.random.default_rng(seed)
    parts = tuple(frozen(rng.standard_normal(2)) for _ in range(2))
    return Found(frozen(rng.standard_normal((2, 3))), parts, ("a", "b"), None)


def same(one: Found, other: Found) -> None:
    np.testing.assert_array_equal(one.gain, other.gain)
    for mine, theirs in zip(one.parts, other.parts, strict=True):
        np.testing.assert_array_equal(mine, theirs)
    assert (one.names, one.value) == (other.names, other.value)
    assert not other.gain.flags.writeable


def counted(seed: int, made: list[int]) -> Callable[[], Found]:
    def compute() -> Found:
        made.append(seed)
        return found(seed)

    return compute


@pytest.mark.parametrize(
    ("damage", "again"),
    [("nothing", []), ("other digest", [1, 2]), ("cut", [1]), ("flipped", [1]), ("copied", [1])],
)
def test_what_is_kept_is_not_done_again(tmp_path: Path, damage: str, again: list[int]) -> None:
    kept, stated, made = Cache(tmp_path / "kept"), list[tuple[str, bool]](), list[int]()

    def state(name: str, *, found: bool) -> None:
        stated.append((name, found))

    first = Steps(kept, "digest", state)
    assert first.kept() == "no step was finished"
    for seed in (1, 2):
        same(found(seed), first.get(f"step {seed}", counted(seed, made), decode))
    assert made == [1, 2]
    path = kept.path("step 1")
    content = path.read_bytes()
    if damage == "cut":
        path.write_bytes(content[:-9])
    elif damage == "flipped":
        place = content.index(b".") + 1
        path.write_bytes(content[:place] + bytes([content[place] ^ 1]) + content[place + 1 :])
    elif damage == "copied":
        path.write_bytes(kept.path("step 2").read_bytes())
    other = Steps(kept, "another" if damage == "other digest" else "digest", state)
    made.clear()
    for seed in (1, 2):
        same(found(seed), other.get(f"step {seed}", counted(seed, made), decode))
    assert made == again
    assert stated[:2] == [("step 1", False), ("step 2", False)]
    assert stated[2:] == [(f"step {seed}", seed not in again) for seed in (1, 2)]
    assert "step 1" in other.kept()
    kept.forget()
    assert not kept.folder.exists()


def test_a_step_that_fails_is_not_kept(tmp_path: Path) -> None:
    steps = Steps(Cache(tmp_path), "digest")
    with pytest.raises(ZeroDivisionError):
        steps.get("step", lambda: 1 / 0, decode)
    assert steps.names == {}
    assert list(tmp_path.iterdir()) == []


def test_names_that_fall_together_are_told_apart(tmp_path: Path) -> None:
    kept = Cache(tmp_path)
    kept.keep("trial 1", "d", 1)
    assert kept.find("trial-1", "d") is None
    assert kept.find("trial 1", "d") == 1
    assert (kept.digest("trial 1"), kept.digest("trial 2")) == ("d", None)


def test_a_link_in_the_place_of_the_draft_is_not_followed(tmp_path: Path) -> None:
    target = tmp_path / "mine"
    target.write_text("mine")
    (tmp_path / ".a.json.part").symlink_to(target)
    Cache(tmp_path).keep("a", "d", 1)
    assert target.read_text() == "mine"


def test_only_what_was_kept_is_forgotten(tmp_path: Path) -> None:
    kept = Cache(tmp_path / "fit-in-progress")
    for name in ("one", "two/three"):
        kept.keep(name, "digest", [1.0])
    (tmp_path / "fit-in-progress" / "notes.txt").write_text("mine")
    (tmp_path / "fit-in-progress" / "table.json").write_text("[1]")
    kept.forget()
    left = [path.name for path in tmp_path.rglob("*") if path.is_file()]
    assert sorted(left) == ["notes.txt", "table.json"]
    (tmp_path / "fit-in-progress" / "notes.txt").unlink()
    (tmp_path / "fit-in-progress" / "table.json").unlink()
    kept.keep("one", "digest", [1.0])
    kept.forget()
    assert list(tmp_path.iterdir()) == []
    kept.forget()
