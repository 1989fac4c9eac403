"""Ownership of output folders: no second run, no other command, no mixed files."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from impc.cli.options import out_option
from impc.errors import OutputError
from impc.reporting.writer import owned, write_files, written

ROOT = Path(__file__).parents[2]
PAGE = {"report.html": b"1", "result.json": b"1"}


def names(folder: Path) -> set[str]:
    return {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()}


def test_a_run_replaces_the_one_before_whole(tmp_path: Path) -> None:
    folder = tmp_path / "out"
    with owned(folder, "fit"):
        write_files(folder, PAGE | {"old.png": b"", "deep/er/old.csv": b""})
    (folder / "notes.txt").write_text("mine")
    for left in (".impc-new/0", ".impc-notes/thesis.txt"):  # left by a killed run; by the user
        (folder / left).parent.mkdir(parents=True, exist_ok=True)
        (folder / left).write_text("left")
    with owned(folder, "fit"):
        write_files(folder, {"new.png": b""})
        write_files(folder / "sub", {"x.csv": b""})
    mine = {"notes.txt", ".impc-notes/thesis.txt"}
    assert names(folder) == {*mine, "new.png", "sub/x.csv", ".impc"}
    assert not (folder / "deep").exists()
    assert not (folder / ".impc-new").exists()


def test_what_a_run_wrote_is_listed(tmp_path: Path) -> None:
    assert written(tmp_path) == {}
    (tmp_path / "result.json").write_text("of another program")
    assert written(tmp_path) == {}
    with owned(tmp_path / "out", "fit"):
        write_files(tmp_path / "out", PAGE)
    assert dict(written(tmp_path / "out")) == {
        name: hashlib.sha256(b"1").hexdigest() for name in PAGE
    }
    (tmp_path / "out" / ".impc").write_text("fit\n[")
    with pytest.raises(OutputError, match=r"its list \.impc is damaged"):
        written(tmp_path / "out")


def test_no_list_removes_through_a_link(tmp_path: Path) -> None:
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "thesis.txt").write_text("mine")
    folder = tmp_path / "out"
    folder.mkdir()
    (folder / ".impc-a").symlink_to(tmp_path / "home")
    (folder / ".impc").write_text('fit\n[".impc-a/thesis.txt", ""]\n[".impc-b/../x", ""]\n')
    with owned(folder, "fit"):
        write_files(folder, PAGE)
    assert (tmp_path / "home" / "thesis.txt").read_text() == "mine"


def test_another_command_and_files_of_ones_own_are_refused(tmp_path: Path) -> None:
    with owned(tmp_path / "a", "fit"):
        write_files(tmp_path / "a", PAGE)
    with (
        pytest.raises(OutputError, match="contains results of impc fit"),
        owned(tmp_path / "a", "compare"),
    ):
        pytest.fail("entered")
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "report.html").write_text("mine")
    with (
        pytest.raises(OutputError, match=r"contains report.html, not written by this version"),
        owned(tmp_path / "b", "fit"),
    ):
        pytest.fail("entered")
    (tmp_path / "c").mkdir()
    (tmp_path / "c" / "gain.png").write_text("mine")
    with (
        pytest.raises(OutputError, match="was not written by this command"),
        owned(tmp_path / "c", "fit"),
    ):
        write_files(tmp_path / "c", PAGE | {"gain.png": b""})
    assert names(tmp_path / "c") == {"gain.png"}
    assert names(tmp_path / "b") == {"report.html"}


def test_nothing_is_left_of_a_run_that_wrote_nothing(tmp_path: Path) -> None:
    (tmp_path / "mine.csv").write_text("1")
    for folder in (tmp_path / "deep" / "out", tmp_path):
        with pytest.raises(ZeroDivisionError), owned(folder, "fit"):
            raise ZeroDivisionError
        assert names(tmp_path) == {"mine.csv"}
        assert not (tmp_path / "deep").exists()


@pytest.mark.parametrize(
    "text",
    [
        "",
        "fit\n[",
        'fit\n["../../evil", ""]\n["/tmp/evil", ""]\n[3, ""]\n{}\n',
        "fit\n" + "[" * 9999,
    ],
)
def test_a_damaged_list_removes_nothing_else(text: str, tmp_path: Path) -> None:
    folder = tmp_path / "a" / "b"
    folder.mkdir(parents=True)
    (tmp_path / "evil").write_text("mine")
    (folder / ".impc").write_text(text)
    said = ""
    try:
        with owned(folder, "fit"):
            write_files(folder, PAGE)
    except OutputError as error:
        said = str(error)
    assert "\n" not in said
    assert (tmp_path / "evil").exists()


def test_the_lock_goes_with_its_holder(tmp_path: Path) -> None:
    """Refused while another process holds the folder; free once it is killed."""
    code = (
        "import sys, time; from pathlib import Path; from impc.reporting.writer import owned\n"
        "with owned(Path(sys.argv[1]), 'fit'):\n    print('held', flush=True); time.sleep(60)\n"
    )
    other = subprocess.Popen(
        [sys.executable, "-c", code, str(tmp_path)], cwd=ROOT, stdout=subprocess.PIPE, text=True
    )
    try:
        assert other.stdout is not None
        assert other.stdout.readline() == "held\n"
        with pytest.raises(OutputError, match="another run is writing"), owned(tmp_path, "fit"):
            pytest.fail("entered")
    finally:
        other.kill()
        other.wait()
        if other.stdout is not None:
            other.stdout.close()
    with owned(tmp_path, "fit"):
        write_files(tmp_path, PAGE)
    assert names(tmp_path) == {*PAGE, ".impc"}


def test_every_command_with_out_holds_its_folder(tmp_path: Path) -> None:
    """A second run of any command into the same folder ends with a message."""

    @click.group()
    def main() -> None: ...

    @main.command("make")
    @out_option("x", "things")
    def make(out: Path) -> None:
        write_files(out, PAGE)
        with pytest.raises(OutputError, match="another run is writing"), owned(out, "make"):
            pytest.fail("entered")

    # `impc` and `python -m impc` are the same program.
    for program in ("main", "python -m main"):
        words = ["make", "--out", str(tmp_path / "out")]
        done = CliRunner().invoke(main, words, prog_name=program)
        assert done.exception is None
    first = (tmp_path / "out" / ".impc").read_text().splitlines()
    assert first[0] == "make"
    assert {json.loads(line)[0] for line in first[1:]} == set(PAGE)
    assert not (tmp_path / "out" / ".impc-lock").exists()


@pytest.mark.skipif(os.name != "posix", reason="symbolic links")
def test_a_file_that_is_a_link_is_replaced_and_not_followed(tmp_path: Path) -> None:
    target = tmp_path / "mine"
    target.write_text("mine")
    folder = tmp_path / "out"
    with owned(folder, "fit"):
        write_files(folder, PAGE)
    (folder / "report.html").unlink()
    (folder / "report.html").symlink_to(target)
    with owned(folder, "fit"):
        write_files(folder, PAGE)
    assert target.read_text() == "mine"
    assert not (folder / "report.html").is_symlink()
