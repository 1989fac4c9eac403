"""Without the subpackage everything else works; its use gives one line."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from docs.layers import imports, subpackage
from tests.documents.blocks import ROOT

# Neither the interpreter's finders nor those of an editable installation find the folder.
HIDDEN = """
import sys
class Without:
    def __init__(self, finder):
        self.finder = finder
    def find_spec(self, name, *where):
        return None if name == "impc.nonlinear" else self.finder.find_spec(name, *where)
sys.meta_path = [Without(one) for one in sys.meta_path]
"""
EXAMPLE = """
import importlib, pkgutil, control, impc
for one in pkgutil.walk_packages(impc.__path__, "impc."):
    if one.name not in ("impc.__main__", "impc.nonlinear"):
        importlib.import_module(one.name)
for name in set(impc.__all__) - {"OptimalControlProblem", "fit_optimal_control"}:
    getattr(impc, name)
plant = impc.Plant(control.ss([[0.9]], [[1]], [[1]], 0, 1))
bounds = impc.Bounds(plant, u_min=-0.3, u_max=0.3)
truth = impc.Controller(plant, impc.Weights(1, 1), bounds, horizon=3).simulate([1.0], steps=20)
found = impc.fit(impc.Problem(plant, bounds, 3, [impc.Recording(plant, truth.x)]))
impc.report(found, "page")
print(found.status.value)
try:
    impc.OptimalControlProblem
except impc.ImpcError as error:
    print(error)
"""


def test_of_the_core_only_the_door_the_commands_and_the_studies_name_it() -> None:
    named = {
        name
        for name, others in imports().items()
        if subpackage(name) != "nonlinear" and "nonlinear" in map(subpackage, others)
    }
    assert named <= {"__init__", "cli.fit"}


@pytest.mark.full
def test_the_rest_works_without_the_folder(tmp_path: Path) -> None:
    for name, text in {
        "own.py": "import impc\ndef own():\n    return impc.OptimalControlProblem\n",
        "own.toml": '[recording]\ntime = "t"\n[signals.x]\ncolumn = "x"\nunit = "m"\n',
        "own.csv": "t,x\n0,1\n1,2\n",
    }.items():
        (tmp_path / name).write_text(text)
    environment = os.environ | {"PYTHONPATH": f"{ROOT}{os.pathsep}{tmp_path}"}

    def run(code: str, *arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-c", HIDDEN + code, *arguments], cwd=tmp_path, env=environment,
            capture_output=True, text=True, check=False,
        )  # fmt: skip

    done = run(EXAMPLE)
    assert done.returncode == 0, done.stderr
    line = "impc.OptimalControlProblem: needs impc.nonlinear, which is not installed; install"
    status, identified = done.stdout.strip().splitlines()
    assert status == "explained"
    assert line in identified
    given = ("fit", "own.csv", "--plant", "own:own", "--config", "own.toml")
    typed = run("import runpy; runpy.run_module('impc', run_name='__main__')", *given)
    assert typed.returncode == 2
    (said,) = typed.stderr.strip().splitlines()
    assert line in said
