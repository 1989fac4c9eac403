"""Caches of compiled code where neither the installation nor the home folder can be written."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

import impc.jit
from impc.jit import keep_caches
from tests.support import ROOT, new_python

# Nobody can make a folder there, not even root, who runs the tests of a container.
NOWHERE = f"{__file__}/none"  # below a file no folder can be made


@pytest.fixture
def locked_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """No home, an installation that cannot be written, and this folder for temporary files."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(impc.jit, "__file__", f"{NOWHERE}/impc/jit.py")
    monkeypatch.setenv("HOME", NOWHERE)
    for name in ("XDG_CACHE_HOME", "XDG_CONFIG_HOME", "NUMBA_CACHE_DIR", "MPLCONFIGDIR"):
        monkeypatch.setenv(name, "")  # so that it is put back afterwards
        monkeypatch.delenv(name)
    return tmp_path


def test_caches_go_to_a_folder_of_the_users_own(locked_out: Path) -> None:
    note = keep_caches()
    (folder,) = locked_out.iterdir()
    assert str(folder) in note
    assert folder.stat().st_mode & 0o777 == 0o700
    for name in ("NUMBA_CACHE_DIR", "MPLCONFIGDIR"):
        assert Path(os.environ[name]).parent == folder
        assert Path(os.environ[name]).is_dir()
    assert keep_caches() == ""  # both are named now


@pytest.mark.parametrize("kind", ["readable by others", "a link", "a file", "of another"])
def test_a_folder_that_others_could_have_made_is_not_used(
    locked_out: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    folder = locked_out / f"impc-{os.getuid()}"
    if kind == "a link":
        (locked_out / "elsewhere").mkdir(mode=0o700)
        folder.symlink_to(locked_out / "elsewhere")
    elif kind == "a file":
        folder.write_text("")
    else:
        folder.mkdir(mode=0o700)
        if kind == "of another":
            uid = os.getuid() + 1
            folder.rename(locked_out / f"impc-{uid}")
            monkeypatch.setattr(os, "getuid", lambda: uid)
        else:
            folder.chmod(0o777)
    assert keep_caches().startswith("caches are disabled")
    assert "NUMBA_CACHE_DIR" not in os.environ


def test_the_library_compiles_in_memory_without_a_place_for_caches(tmp_path: Path) -> None:
    shutil.copytree(ROOT / "impc", tmp_path / "impc", ignore=shutil.ignore_patterns("__pycache__"))
    (tmp_path / "impc/__pycache__").write_text("a file, where numba would make a folder")
    code = (
        "import impc.control.compiled_loop\n"
        "loop = impc.control.compiled_loop\n"
        "print(type(loop.run._cache).__name__, loop.__file__)\n"
    )
    done = new_python(code, "-P", PYTHONPATH=str(tmp_path), HOME=NOWHERE, XDG_CACHE_HOME=NOWHERE)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["NullCache", str(tmp_path / "impc/control/compiled_loop.py")]


def test_compiling_is_one_line_of_the_log_and_none_after_a_move(tmp_path: Path) -> None:
    home = tmp_path / "home"
    home.mkdir()
    (home / "sums.py").write_text(
        "import logging\n"
        "from impc.jit import njit\n"
        "logging.basicConfig(level='INFO', format='%(name)s: %(message)s')\n"
        "for one in (lambda x: x + 1, lambda x: x + 2):\n"
        "    njit(cache=True)(one)(1)\n"
    )
    environment = os.environ | {"PYTHONPATH": str(ROOT), "NUMBA_CACHE_DIR": str(tmp_path / "cache")}

    def said(place: Path) -> str:
        words = [sys.executable, str(place / "sums.py")]
        done = subprocess.run(words, env=environment, capture_output=True, text=True, check=True)
        return done.stderr

    first = said(home)
    assert first.startswith("impc: compiling once")
    assert first.count("\n") == 1
    moved = home.rename(tmp_path / "moved")
    os.utime(moved / "sums.py", (0, 0))
    assert said(moved) == ""
    (moved / "sums.py").write_text((moved / "sums.py").read_text().replace("x + 2", "x + 3"))
    assert said(moved) == first
