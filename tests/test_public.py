"""`import impc`: its names, what it loads, and the example of each name."""

from __future__ import annotations

import ast
import doctest
import json
import re
import sys
from pathlib import Path
from typing import Any

import pytest

import impc
from tests.support import ROOT, new_python

FLAGS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
# Libraries that are loaded for one purpose, such as a figure, a plant or a workbook.
LATE = {"control", "cvxpy", "h5py", "jinja2", "matplotlib", "openpyxl", "statsmodels", "sympy"}
HEAVY = LATE | {"casadi", "numba", "pandas", "pint", "scipy.linalg", "scipy.optimize",
                "scipy.signal", "scipy.stats"}  # fmt: skip


def test_there_are_at_most_sixty_names_and_each_is_there() -> None:
    assert len(impc.__all__) == len(set(impc.__all__)) <= 60
    for name in impc.__all__:
        assert getattr(impc, name).__name__ == name
    assert {*impc.__all__, "__version__"} == set(dir(impc))
    assert impc.__version__ in (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    with pytest.raises(AttributeError, match="module 'impc' has no attribute 'nothing'"):
        impc.nothing  # type: ignore[attr-defined]  # noqa: B018


def test_a_type_checker_sees_the_same_names_in_the_same_modules() -> None:
    tree = ast.parse(Path(impc.__file__).read_text(encoding="utf-8"))
    typed = {
        (item.name, str(node.module).removeprefix("impc."), item.asname)
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and str(node.module).startswith("impc.")
        for item in node.names
    }
    assert typed == {(name, module, name) for name, module in impc._MODULES.items()}


def loaded(line: str) -> set[str]:
    """Names of the modules that a fresh Python has after a line."""
    said = "import atexit, json, sys; atexit.register(lambda: print(json.dumps([*sys.modules])))"
    done = new_python(f"{said}\n{line}")
    assert "Traceback" not in done.stderr
    return set(json.loads(done.stdout.splitlines()[-1]))


def test_importing_it_loads_no_other_library() -> None:
    bare, found = loaded(""), loaded("import impc")
    assert {name for name in found - bare if name.split(".")[0] != "impc"} <= {
        name for name in found if name.split(".")[0] in sys.stdlib_module_names
    }
    assert {name for name in found if name.startswith("impc.")} == set()


@pytest.mark.parametrize(
    ("line", "absent"),
    [
        ("from impc.cli.main import main; main(['--help'])", HEAVY),
        ("from impc.cli.main import main; main(['fit', '--help'])", HEAVY),
        # It opens the recordings first.
        ("from impc.cli.main import main; main('fit a.csv --plant a --config b'.split())", HEAVY),
        ("import impc.files.reading", HEAVY),
        ("import impc.studies.cohort.report, impc.studies.fit.report, impc.nonlinear.page", LATE),
    ],
)
def test_libraries_are_loaded_where_they_are_used(line: str, absent: set[str]) -> None:
    assert loaded(line).isdisjoint(absent)


@pytest.mark.parametrize(
    "name",
    [
        # Its filter takes two minutes to compile.
        pytest.param(name, marks=pytest.mark.full if name == "fit_output_feedback" else [])
        for name in impc.__all__
    ],
)
def test_the_example_of_the_name_runs(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    thing: Any = getattr(impc, name)
    assert re.search(r"^\s*Examples\n\s*-{8}\n", thing.__doc__, re.MULTILINE), "no Examples"
    found = doctest.DocTestFinder(recurse=False).find(thing, name, globs={})
    runner = doctest.DocTestRunner(optionflags=FLAGS)
    stated: list[str] = []
    for test in found:
        assert any(example.want for example in test.examples), "shows no result"
        runner.run(test, out=stated.append)
    assert runner.summarize(verbose=False).attempted > 0
    assert stated == []


def test_the_page_of_tasks_names_every_public_name() -> None:
    page = (ROOT / "docs/ref/api.md").read_text(encoding="utf-8")
    named = re.findall(r"`(\w+)(?:\.\w+)?`", "".join(re.findall(r"^\|.*$", page, flags=re.M)))
    assert set(named) == set(impc.__all__)
