"""What a plain installation imports, and what is said where an extra is missing."""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

from impc.extras import EXTRAS
from tests.documents.blocks import ROOT

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
OWN = {"impc", "plants"}

# As sitecustomize.py, which every Python process loads first, the one that reads a file too:
# nothing of an extra can be imported, as in a plain installation.
PLAIN = f"""
import sys
from importlib.machinery import PathFinder

class Plain(PathFinder):
    @classmethod
    def find_spec(cls, name, path=None, target=None):
        absent = name.partition(".")[0] in {sorted({*EXTRAS, "cvxpy", "cdd", "dask"})!r}
        return None if absent else super().find_spec(name, path, target)

sys.meta_path[sys.meta_path.index(PathFinder)] = Plain
"""


def names(requirements: list[str]) -> set[str]:
    """Of packages, as they are imported."""
    return {re.split(r"[\[<>=]", line)[0].replace("-", "_") for line in requirements}


def imports(tree: ast.AST) -> Iterator[str]:
    """Whatever is imported when the code runs: not what only a type checker reads."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            continue
        if isinstance(node, ast.Import):
            yield from (alias.name.partition(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module.partition(".")[0]
        yield from imports(node)


def plain(program: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run a program without the libraries of the extras."""
    (folder / "sitecustomize.py").write_text(PLAIN)
    return subprocess.run(
        [sys.executable, "-c", program],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(folder), str(ROOT)])},
        capture_output=True,
        text=True,
        check=False,
    )


def imported(app: bool) -> set[str]:
    """Libraries that the modules of `impc app` import, or all others."""
    return {
        name
        for package in OWN
        for path in (ROOT / package).rglob("*.py")
        if path.is_relative_to(ROOT / "impc/app") == app
        for name in imports(ast.parse(path.read_text(encoding="utf-8")))
    } - sys.stdlib_module_names - OWN  # fmt: skip


def test_dependencies_are_what_is_imported() -> None:
    # dask comes with distributed, and is imported after it.
    needed = names(PROJECT["dependencies"])
    assert imported(app=False) - {"dask"} == needed
    # uvicorn is imported by name.
    extra = names(PROJECT["optional-dependencies"]["app"])
    assert imported(app=True) - needed == extra - {"uvicorn"}


def test_every_optional_library_is_in_the_extra_that_is_named() -> None:
    extras = PROJECT["optional-dependencies"]
    assert {library: library in names(extras[extra]) for library, extra in EXTRAS.items()} == (
        dict.fromkeys(EXTRAS, True)
    )
    assert not set(EXTRAS) & names(PROJECT["dependencies"])


def test_every_module_loads_without_the_extras(tmp_path: Path) -> None:
    done = plain(
        "import importlib, pkgutil, re, impc, plants\n"
        "for package in (impc, plants):\n"
        "    for found in pkgutil.walk_packages(package.__path__, package.__name__ + '.'):\n"
        "        if not re.match(r'(.*__main__|impc.app.(?!command).*)$', found.name):\n"
        "            importlib.import_module(found.name)\n"
        "print('all')\n",
        tmp_path,
    )
    assert done.stdout == "all\n", done.stderr


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            "from impc.app.command import command; command.callback(Path('.'), (), True)",
            "impc app: needs the package uvicorn; install it: pip install 'impc[app]'",
        ),
        (
            "from impc.files.formats import read_table; read_table(Path('t.tdms'))",
            "t.tdms: needs the package nptdms; install it: pip install 'impc[tdms]'",
        ),
        (
            "from impc.files.formats import read_table; read_table(Path('t.xlsx'))",
            "t.xlsx: needs the package python_calamine; install it: pip install 'impc[excel]'",
        ),
        (
            "from impc.files.formats import encode_table as encode\n"
            "from impc.files.table import make_table\n"
            "encode('.c3d', make_table('t', {'x': [1.0, 2.0]}, rate=10.0))",
            "C3D: needs the package c3d; install it: pip install 'impc[c3d]'",
        ),
        (
            "from impc.studies.scheduler import Cluster, connected\n"
            "connected(Cluster('tcp://127.0.0.1:9')).__enter__()",
            "scheduler tcp://127.0.0.1:9: needs the package distributed; "
            "install it: pip install 'impc[cohort]'",
        ),
    ],
)
def test_one_line_says_how_to_get_it(call: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "t.xlsx").write_bytes(b"PK\x03\x04")
    (tmp_path / "t.tdms").write_bytes(b"TDSm" + bytes(24))
    done = plain(
        "from pathlib import Path\nfrom impc.errors import ImpcError\n"
        "try:\n" + "".join(f"    {line}\n" for line in call.splitlines()) +
        "except ImpcError as error:\n    print(error)\n",
        tmp_path,
    )  # fmt: skip
    assert done.stdout == message + "\n", done.stderr
