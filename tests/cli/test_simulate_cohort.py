"""`impc simulate cohort`: recordings agree with the simulated plant and with the fit."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from impc.cli.main import main
from impc.cli.seat import PLANT
from impc.errors import FallError
from impc.files.plant_sources import make_plant, plant_source
from impc.files.reading import read_recordings, read_unit
from impc.studies.cohort.study import read_study


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
        plant, body = make_plant(source, ("perturbation",)), source.make(**source.arguments).body()
        (trial,) = read_recordings(unit.files, study.configuration, plant)
        K = np.array(truth[unit.subject]["gain"]["1"])
        x, states = np.zeros(plant.n), np.empty((trial.samples, plant.n))
        for k in range(trial.samples):
            states[k] = x
            x = np.array(body(x, np.append(-K @ x, trial.disturbance[k])))[:, 0]
        left = np.degrees(trial.outputs - states @ plant.C.T)
        assert least < np.sqrt(np.mean(left**2)) / 0.03 < most


def test_falls_are_said_and_their_trials_left_out(tmp_path: Path) -> None:
    """A limit of 1.8 N m makes a subject fall in one trial; the other trial is kept."""
    given = ("--subjects", "2", "--trials", "2", "--duration", "8", "--replicates", "0")
    more = ("--torque-limit", "1.8", "--seed", "1", "--out", str(tmp_path))
    done = CliRunner().invoke(main, ["simulate", "cohort", *given, *more])
    assert done.exit_code == 0, done.stderr
    said = [line for line in done.stdout.splitlines() if "the subject fell at" in line]
    truth = json.loads((tmp_path / "truth.json").read_text())["subjects"]
    fell = {file: time for person in truth.values() for file, time in person["fell"].items()}
    assert said == [f"{file}: the subject fell at {time:.2f} s" for file, time in fell.items()]
    assert fell
    study = read_study(tmp_path / "study.toml")
    lost = 0
    for unit in study.units:
        plant = make_plant(plant_source(PLANT, dict(unit.person)), ("perturbation",))
        try:
            trials, falls = read_unit(unit.files, study.configuration, plant)
        except FallError:
            lost += len(unit.files)
            continue
        lost += len(falls)
        assert len(trials) + len(falls) == len(unit.files)
    assert lost == len(fell)


@pytest.mark.parametrize("count", ["1", "5", "19"])
def test_a_study_that_cohort_would_refuse_is_not_written(tmp_path: Path, count: str) -> None:
    given = ("--replicates", count, "--out", str(tmp_path / "out"))
    done = CliRunner().invoke(main, ["simulate", "cohort", *given])
    assert done.exit_code == 2
    assert f"[fit] replicates: got {count}; give 0 or at least 20" in done.stderr
    assert not (tmp_path / "out").exists()
