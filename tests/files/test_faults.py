"""Fault injection in everything that writes: no space at each write, a kill at each rename.

Afterwards a folder holds the files of one run, or reports that it does not; stored stages are read
as they were written or computed again; and the next run succeeds.
"""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from impc.errors import OutputError
from impc.reporting.writer import owned, write_files
from impc.studies.cache import Cache

OLD = {"report.html": b"old", "figure_9.png": b"old", "sub/old.csv": b"old"}
NEW = {"report.html": b"new", "result.json": b"new", "sub/new.csv": b"new"}
STAGES = {"fit": {"K": [[1.5]]}, "without trial 1": {"K": [[2.5]]}}


def work(folder: Path, files: dict[str, bytes]) -> None:
    """Like a command: store stages one by one, write files, remove the stages."""
    with owned(folder, "fit"):
        kept = Cache(folder / "fit-in-progress")
        for name, content in STAGES.items():
            if kept.find(name, "digest") is None:
                kept.keep(name, "digest", content)
        assert found_in(folder) == STAGES
        write_files(folder, files)
        kept.forget()


def found_in(folder: Path) -> dict[str, Any]:
    """Stages that a folder stores."""
    kept = Cache(folder / "fit-in-progress")
    found = {name: kept.find(name, "digest") for name in STAGES}
    return {name: content for name, content in found.items() if content is not None}


def shown(folder: Path) -> dict[str, bytes]:
    """Files that are visible to the user."""
    found = {path.relative_to(folder): path for path in folder.rglob("*") if path.is_file()}
    return {
        name.as_posix(): path.read_bytes()
        for name, path in found.items()
        if not any(part.startswith(".") or part.endswith("-in-progress") for part in name.parts)
    }


def test_no_space_at_each_write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The disk fills at each flush or rename; the old run's files stay complete."""
    work(tmp_path, OLD)
    failures = 0
    while True:
        with monkeypatch.context() as patch:
            _fail_at(patch, failures)
            said = ""
            try:
                work(tmp_path, NEW)
            except OutputError as error:
                said = str(error)
        if not said:
            break
        assert "No space left on device" in said
        assert "\n" not in said
        failures += 1
        found = shown(tmp_path)
        assert found in (OLD, NEW) or "INCOMPLETE.txt" in found
        assert not list(tmp_path.rglob("*.part"))
    # Each stage, file, notice and list has a flush and a rename; stored stages are not repeated.
    assert failures >= 10
    assert shown(tmp_path) == NEW


def _fail_at(patch: pytest.MonkeyPatch, place: int) -> None:
    left = place

    def full(call: Any) -> Any:
        def wrapped(*given: Any, **named: Any) -> Any:
            nonlocal left
            left -= 1
            if left == -1:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            return call(*given, **named)

        return wrapped

    for name in ("fsync", "replace"):
        patch.setattr(os, name, full(getattr(os, name)))


KILLED = """
import os, sys
from pathlib import Path
from tests.files.test_faults import NEW, work
left, replace = int(sys.argv[2]), os.replace
def killed(*given):
    global left
    left -= 1
    if left == -1:
        os._exit(9)
    replace(*given)
os.replace = killed
work(Path(sys.argv[1]), NEW)
"""


def test_a_kill_at_each_rename(tmp_path: Path) -> None:
    kills, stated = 0, 0
    while True:
        folder = tmp_path / str(kills)
        work(folder, OLD)
        done = subprocess.run(
            [sys.executable, "-c", KILLED, str(folder), str(kills)], check=False,
            cwd=Path(__file__).parents[2], timeout=120,
        )  # fmt: skip
        found = shown(folder)
        stated += "INCOMPLETE.txt" in found
        assert found in (OLD, NEW) or "INCOMPLETE.txt" in found
        assert found_in(folder).items() <= STAGES.items()
        work(folder, NEW)
        assert shown(folder) == NEW
        assert {path.name for path in folder.iterdir()} == {*NEW, "sub", ".impc"} - {"sub/new.csv"}
        if done.returncode == 0:
            break
        assert done.returncode == 9
        kills += 1
    assert kills >= 6
    assert stated >= 3


MINE = {"notes.txt": b"mine", "sub/ole.csv": b"mine"}  # one bit from a name of the old run


@pytest.mark.parametrize("name", [".impc", "fit-in-progress/fit.json"])
def test_a_flipped_byte_in_what_a_folder_keeps(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The run is rejected in one line, or its files are those of an undisturbed one."""
    monkeypatch.setattr(os, "fsync", lambda _: None)  # thousands of them take minutes
    refused = right = 0
    folder = _interrupted(tmp_path / "0")
    whole = (folder / name).read_bytes()
    for place in range(0, len(whole), 4):
        folder = _interrupted(tmp_path / f"{place + 1}")
        changed = bytearray(whole)
        changed[place] ^= 1 << (place % 3)
        (folder / name).write_bytes(changed)
        said = ""
        try:
            work(folder, NEW)
        except OutputError as error:
            said, refused = str(error), refused + 1
        else:
            right += 1
            assert shown(folder).items() >= (NEW | MINE).items()
        assert "\n" not in said
        assert shown(folder).items() >= MINE.items()
    assert right >= 20
    assert refused >= 3 or name != ".impc"


def _interrupted(folder: Path) -> Path:
    """A folder with the files of a run, stages of another one, and files of the user."""
    work(folder, OLD)
    with owned(folder, "fit"):
        Cache(folder / "fit-in-progress").keep("fit", "digest", STAGES["fit"])
    for name, content in MINE.items():
        (folder / name).write_bytes(content)
    return folder


@pytest.mark.skipif(os.name != "posix", reason="pipes with a name")
@pytest.mark.parametrize("name", [".impc", ".impc-lock", "fit-in-progress/fit.json"])
def test_a_pipe_in_the_place_of_a_file_is_not_waited_for(name: str, tmp_path: Path) -> None:
    """In a separate process: opening the pipe would block."""
    folder = _interrupted(tmp_path)
    (folder / name).unlink(missing_ok=True)
    os.mkfifo(folder / name)
    done = subprocess.run(
        [sys.executable, "-c", PIPED, str(folder)], check=False, capture_output=True, text=True,
        cwd=Path(__file__).parents[2], timeout=120,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "\n" not in done.stdout
    assert shown(folder).items() >= MINE.items()
    if not done.stdout:
        assert shown(folder).items() >= NEW.items()


PIPED = """
import sys
from pathlib import Path
from impc.errors import OutputError
from tests.files.test_faults import NEW, work
try:
    work(Path(sys.argv[1]), NEW)
except OutputError as error:
    print(error, end="")
"""
