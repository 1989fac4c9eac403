"""A folder of recordings runs nothing and changes nothing: every file and module in it is a trap.

The commands run in two folders with the same recordings; one has settings files of all libraries,
poisoned caches and a module of every name that is imported. Each process, workers and readers
among them, records by an audit hook what it opens, and strace does so where it is installed.
"""

from __future__ import annotations

import ast
import hashlib
import json
import os
import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import impc
from experiments.reference_mpc import solve_mpc
from impc.control.casadi_controller import build_mpc
from tests.nonlinear.test_problem import TRUTH, made
from tests.studies.cohort.carts import cart_plant, subject_trial

ROOT = Path(__file__).parents[1]
# Python runs it in each process, before anything else.
HOOK = """
import os, sys
def record(event, args):
    if event == "open" and isinstance(args[0], (str, bytes)):
        line = os.path.abspath(os.fsdecode(args[0]))
    elif event == "import" and args[0]:
        line = "import " + args[0].partition(".")[0]
    else:
        return
    handle = os.open(os.environ["AUDIT"], os.O_WRONLY | os.O_APPEND)
    os.write(handle, (line + "\\n").encode(errors="replace"))
    os.close(handle)
def hook(event, args):
    if event in ("open", "import") and not busy:
        busy.append(event)
        try:
            record(event, args)
        finally:
            busy.pop()
busy = []
sys.addaudithook(hook)
"""
TRAPS = """
pip.conf pip.ini .pip/pip.conf dask.yaml .dask/dask.yaml .config/dask/dask.yaml setup.cfg
distributed.yaml openblas.conf .openblas .env pyvenv.cfg python._pth python311._pth evil.pth
pyproject.toml .netrc mpl.mplstyle .matplotlib/matplotlibrc .pdbrc conftest.py evil.py
sitecustomize.py usercustomize.py fatrop.opt highs.opt impc.toml evil.so
libcasadi_nlpsol_ipopt.so libopenblas.so libhsl.so
"""
SETTINGS = dict.fromkeys(TRAPS.split(), "raise SystemExit('sprung')\n") | {
    ".numba_config.yaml": "cache_dir: .cache\ndisable_jit: 1\n",
    "matplotlibrc": "text.usetex: True\nlines.linewidth: 0\nbackend: module://evil\nnonsense\n",
    "ipopt.opt": 'output_file "sprung"\nprint_level 5\nfile_print_level 5\nhsllib ./evil.so\n',
}
STUDY = """
[study]
plant = "plant.json"
recordings = "sub-{subject}.mat"
[recording]
time = "time"
[signals.position]
column = "position"
unit = "m"
[signals.push]
column = "push"
unit = "N"
[fit]
horizon = 10
u_max = 1.0
held_out = false
"""
OWN = ("plant.json", "study.toml", "sub-1.mat", "out", "again")
COMMAND = ("cohort", "study.toml", "--workers", "1", "--out")


def filled(folder: Path) -> Path:
    """A study of one trial, which a reader opens and a worker fits; its plant is a file."""
    folder.mkdir()
    system, trial, samples = cart_plant(), subject_trial(1), 200
    parts = {name: getattr(system, name).tolist() for name in "ABCD"}
    parts |= {"inputs": ["force", "push"], "outputs": ["position"], "dt": system.dt}
    (folder / "plant.json").write_text(json.dumps(parts))
    columns = {
        "time": np.arange(samples) * system.dt,
        "position": trial.outputs[:samples, 0],
        "push": trial.disturbance[:samples, 0],
    }
    impc.write_table(folder / "sub-1.mat", impc.make_table("simulated", columns))
    (folder / "study.toml").write_text(STUDY)
    return folder


class Poison:
    """What leaves a file behind when it is unpickled."""

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return os.system, ("touch sprung",)


def set_traps(folder: Path, modules: set[str]) -> None:
    """Settings of all libraries, a module of each name, and numba's caches of this package."""
    for name, text in SETTINGS.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    for name in modules:
        (folder / f"{name}.py").write_text("open('sprung', 'w')\n")
    poison = pickle.dumps(Poison())
    for file in (ROOT / "impc").rglob("*.py"):
        text = file.read_text(encoding="utf-8")
        if "njit" not in text:
            continue
        place = str(file.parent)
        cache = folder / ".cache" / f"{file.parent.name}_{hashlib.sha1(place.encode()).hexdigest()}"
        cache.mkdir(parents=True, exist_ok=True)
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.FunctionDef) and node.decorator_list:
                for line in {node.lineno, node.decorator_list[0].lineno}:
                    version = f"py{sys.version_info[0]}{sys.version_info[1]}"
                    (cache / f"{file.stem}.{node.name}-{line}.{version}.nbi").write_bytes(poison)


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, list[str]]:
    """The folder without traps, the one with them, and the lines of the audit of the second."""
    base = tmp_path_factory.mktemp("traps")
    (base / "hook").mkdir()
    (base / "hook" / "sitecustomize.py").write_text(HOOK)
    audit = base / "audit"
    lines: list[str] = []
    plain, trapped = filled(base / "plain"), filled(base / "trapped")
    for folder in (plain, trapped):
        if folder == trapped:
            imported = {line[7:] for line in lines if line.startswith("import ")}
            set_traps(folder, imported | {"cupy", *sys.stdlib_module_names})
        audit.write_text("")
        run(folder, "out", PYTHONPATH=str(base / "hook"), AUDIT=str(audit))
        lines = audit.read_text().splitlines()
    return plain, trapped, lines


def run(folder: Path, out: str, *before: str, **environment: str) -> None:
    """The study as its user types it."""
    program = str(Path(sys.executable).with_name("impc"))
    done = subprocess.run(
        [*before, program, *COMMAND, out],
        cwd=folder,
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "1 of 1 fits done" in done.stdout


def sprung(folder: Path, opened: set[str]) -> set[str]:
    """The traps among what was opened, and what they leave behind."""
    inside = {Path(name).relative_to(folder) for name in opened if name.startswith(f"{folder}/")}
    traps = {str(name) for name in inside if name.parts[0] not in OWN and (folder / name).is_file()}
    return traps | {name.name for name in folder.glob("sprung")}


@pytest.mark.full
def test_nothing_of_the_folder_is_opened(runs: tuple[Path, Path, list[str]]) -> None:
    _, trapped, lines = runs
    assert f"{trapped}/sub-1.mat" in lines
    assert {"numpy.py", "json.py", "numba.py", "cupy.py"} <= set(os.listdir(trapped))
    assert sprung(trapped, set(lines)) == set()


@pytest.mark.full
def test_results_are_those_of_the_folder_without(runs: tuple[Path, Path, list[str]]) -> None:
    plain, trapped, _ = runs
    pictures = [file.relative_to(plain) for file in plain.rglob("*.svg")]
    assert pictures
    for name in (*pictures, Path("out", "units.csv")):
        assert (plain / name).read_bytes() == (trapped / name).read_bytes(), name


def test_ipopt_obeys_no_file(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    example_plant: impc.Plant,
    example_bounds: impc.Bounds,
) -> None:
    """Of the optimal control problem, of the row that cannot be kept, and of the controller."""
    monkeypatch.chdir(tmp_path)
    Path("ipopt.opt").write_text(SETTINGS["ipopt.opt"])
    point = made()
    point.plan(TRUTH, [1, 0])
    with pytest.raises(impc.InfeasibleError):
        made(signed=["limit"]).plan(TRUTH | {"limit": -1.0}, [1, 0])
    weights = impc.Weights(np.eye(2), 1)
    controller = impc.Controller(example_plant, weights, example_bounds, 3)
    solve_mpc(build_mpc(controller, "ipopt"), [0.1, 0.1])
    assert os.listdir() == ["ipopt.opt"]
