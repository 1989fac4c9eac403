"""A small shell: command lines of the pages, in a folder, without a new process for each.

`impc` runs here, as its tests run it; `python FILE` too; anything else is a line for /bin/sh.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib
import io
import os
import runpy
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from click.testing import CliRunner

from impc.cli.main import main
from impc.files.configuration import read_configuration

__all__ = ["run_line", "working_in"]

# `impc simulate` gives the same files for the same options, and `impc fit` for the same options
# and files: once is enough.
_MADE: dict[tuple[str, ...], tuple[Path, str]] = {}


@contextlib.contextmanager
def working_in(folder: Path) -> Iterator[None]:
    """Work in a folder; modules that were imported from it are forgotten afterwards."""
    before, path = set(sys.modules), list(sys.path)
    with contextlib.chdir(folder):
        try:
            yield
        finally:
            sys.path[:] = path
            for name in set(sys.modules) - before:
                file = getattr(sys.modules[name], "__file__", None)
                if file and Path(file).resolve().is_relative_to(folder.resolve()):
                    del sys.modules[name]
            importlib.invalidate_caches()


def run_line(line: str, kept: Path) -> str:
    """Run one line in the current folder and return what it prints."""
    program, *arguments = shlex.split(line)
    importlib.invalidate_caches()
    if program in ("impc", ".venv/bin/impc"):
        given = [name for word in arguments for name in _expanded(word)]
        once = given[:1] == ["simulate"] or (given[:1] == ["fit"] and "--out" in given)
        return _once(given, kept) if once else _impc(given)
    if program == "python" and not arguments[0].startswith("-"):
        printed = io.StringIO()
        sys.path.insert(0, "")
        with contextlib.redirect_stdout(printed):
            runpy.run_path(arguments[0], run_name="__main__")
        return printed.getvalue()
    done = subprocess.run(line, shell=True, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{line}\n{done.stderr}"
    return done.stdout


def _expanded(word: str) -> list[str]:
    return sorted(str(path) for path in Path().glob(word)) if "*" in word else [word]


def _impc(arguments: list[str]) -> str:
    done = CliRunner().invoke(main, arguments)
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        raise done.exception
    assert done.exit_code == 0, f"impc {shlex.join(arguments)}\n{done.stderr}"
    return done.stdout


def _once(arguments: list[str], kept: Path) -> str:
    where = arguments.index("--out")
    out = Path(arguments[where + 1])
    rest = arguments[:where] + arguments[where + 2 :]
    files = [Path(word) for word in rest if Path(word).is_file()]
    for path in [one for one in files if one.suffix == ".toml"]:
        files += [path.parent / name for name in read_configuration(path).subject.files]
    key = *rest, *map(_digest, files)
    if key not in _MADE:
        made = kept / f"made-{len(_MADE)}"
        _MADE[key] = made, _impc([*rest, "--out", str(made)])
    made, printed = _MADE[key]
    shutil.copytree(made, out, dirs_exist_ok=True)
    return printed.replace(str(made), os.fspath(out))


def _digest(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()
