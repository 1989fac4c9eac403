"""`impc simulate cohort`: what is recorded is what moved the body, and what a fit assumes."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import numpy as np
import pytest
from click.testing import CliRunner

from impc.cli.main import main
from impc.cli.seat import PLANT
from impc.files.plant_sources import make_plant, plant_source
from impc.files.reading import read_recordings
from impc.studies.cohort.study import read_study

if TYPE_CHECKING:
    from pathlib import Path


@pytest.mark.parametrize(("noise", "least", "most"), [("0", 0.93, 1.07), ("3", 2.0, 6.0)])
def test_the_truth_moved_by_what_is_recorded_leaves_the_noise_of_the_recorder(
    tmp_path: Path, noise: str, least: float, most: float
) -> None:
    """0.03 degrees, three deviations of its estimate: without a limit u = -K x, sample by sample.

    Such a torque, had it been recorded as the mean of the two samples, would leave twice as much.
    """
    given = ("simulate", "cohort", "--subjects", "2", "--trials", "1", "--duration", "10")
    done = CliRunner().invoke(main, [*given, "--torque-limit", "1000", "--motor-noise", noise,
                                     "--out", str(tmp_path)])  # fmt: skip
    assert done.exit_code == 0, done.stderr
    study = read_study(tmp_path / "study.toml")
    truth = json.loads((tmp_path / "truth.json").read_text())["subjects"]
    for unit in study.units:
        source = plant_source(PLANT, dict(unit.person))
        plant, body = make_plant(source, ("perturbation",)), source.make(**source.arguments).body
        (trial,) = read_recordings(unit.files, study.configuration, plant)
        K = np.array(truth[unit.subject]["gain"]["1"])
        x, states = np.zeros(plant.n), np.empty((trial.samples, plant.n))
        for k in range(trial.samples):
            states[k] = x
            x = np.array(body(x, np.append(-K @ x, trial.disturbance[k])))[:, 0]
        left = np.degrees(trial.outputs - states @ plant.C.T)
        assert least < np.sqrt(np.mean(left**2)) / 0.03 < most


def test_the_next_command_is_said(tmp_path: Path) -> None:
    out = tmp_path / "my data"
    given = ("--subjects", "2", "--trials", "1", "--duration", "5", "--out", str(out))
    done = CliRunner().invoke(main, ["simulate", "cohort", *given])
    assert done.stdout.splitlines()[-1] == f"next: impc cohort '{out}'/study.toml"
