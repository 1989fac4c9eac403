"""Without the subpackage everything else imports and works; its use gives one line."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from tests.support import ROOT, new_python

# Script that runs in a package without the subpackage; each printed line is compared.
TRIED = """
import importlib, pkgutil, sys
# An editable installation finds the folder where it stands in the checkout.
sys.meta_path[:] = [one for one in sys.meta_path if "ditable" not in repr(one)]
import control, numpy as np
import impc

for module in pkgutil.walk_packages(impc.__path__, "impc."):
    if module.name != "impc.__main__":
        importlib.import_module(module.name)
plant = impc.Plant(control.ss([[1, 0.1], [0, 1]], [[0], [0.1]], np.eye(2), 0, 0.1))
bounds = impc.Bounds(plant, u_min=-1, u_max=1)
law = impc.Controller(plant, impc.Weights(np.eye(2), 1), bounds, horizon=3)
trials = [impc.Recording(plant, law.simulate([0.5, 0.1], steps=40).x)]
def fit(**others):
    given = dict(horizon=3, u_max=1.0, methods=[], intent_draws=False, **others)
    settings = impc.read_settings(given)
    return fit_recordings(impc.fit_problem(plant, trials, settings), settings)
"""


@pytest.mark.full  # another set of sources is compiled anew
def test_the_rest_works_without_it(tmp_path: Path) -> None:
    shutil.copytree(
        ROOT / "impc", tmp_path / "impc", ignore=shutil.ignore_patterns("output_feedback")
    )
    code = TRIED.replace("impc.read_settings", "fit_settings") + (
        "from impc.studies.fit.settings import fit_settings\n"
        "from impc.studies.fit.subject import fit_recordings\n"
        "print(np.abs(fit().fitted.K - law.K).max() < 1e-6)\n"
        "for ask in (lambda: fit(observer={}), lambda: impc.fit_output_feedback):\n"
        "    try:\n"
        "        ask()\n"
        "    except (impc.ImpcError, ImportError) as error:\n"
        "        print(error)\n"
    )
    done = new_python(code, "-P", PYTHONPATH=f"{tmp_path}{os.pathsep}{ROOT}")
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == [
        "True",
        "[fit.observer]: needs impc.output_feedback, which is not installed; install the complete "
        "package, or remove the table",
        "impc.fit_output_feedback: needs impc.output_feedback, which is not installed; install the "
        "complete package",
    ]
