"""`impc simulate reliability-study` and `impc reliability`, from files to files."""

from __future__ import annotations

import hashlib
import json
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner, Result

from impc.cli.main import main
from impc.files.plant_sources import make_plant, plant_source
from impc.files.reading import read_recordings
from impc.studies.cohort.study import read_study
from impc.studies.reliability.icc import icc

pytestmark = pytest.mark.full


def run(*arguments: str) -> Result:
    return CliRunner().invoke(main, list(arguments))


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five subjects, two visits, two trials; the conditions are three."""
    folder = tmp_path_factory.mktemp("reliability")
    done = run(
        "simulate", "reliability-study", "--out", str(folder), "--subjects", "5", "--visits", "2",
        "--trials", "2",
    )  # fmt: skip
    assert done.exit_code == 0, done.stderr
    return folder


@pytest.fixture(scope="module")
def analysed(study: Path) -> tuple[Result, Path]:
    out = study / "out"
    done = run("reliability", str(study / "study.toml"), "--out", str(out))
    assert done.exit_code == 0, done.stderr
    return done, out


def test_icc_is_that_of_the_recordings(study: Path, analysed: tuple[Result, Path]) -> None:
    """RMS of every trial computed directly from the files."""
    found = json.loads((analysed[1] / "result.json").read_text())
    read = read_study(study / "study.toml")
    plant = make_plant(plant_source("plants:seated_balance_for", {}), ("perturbation",))
    table = np.full((5, 2), np.nan)
    for unit in read.units:
        if unit.condition == "EC":
            trials = read_recordings(unit.files, read.configuration, plant)
            scores = [np.sqrt(np.mean(item.outputs[:, 0] ** 2)) for item in trials]
            table[int(unit.subject) - 1, int(unit.visit) - 1] = np.mean(scores)
    expected = icc(table, "A,k", method="generalised")
    shown = pd.DataFrame(found["findings"]["icc-rms"]["table"])
    stated = shown.query("output == 'theta1' and condition == 'EC'").iloc[0]
    for key, name in (("icc", "value"), ("low", "low"), ("high", "high")):
        assert stated[key] == pytest.approx(getattr(expected, name))
    other = icc(table, "A,k")
    assert (stated["low_f"], stated["high_f"]) == pytest.approx((other.low, other.high))
    assert max(map(len, analysed[0].stdout.splitlines())) <= 100
    # The error of a single visit, not of the mean over visits as in ICC(A,k).
    complete = table[np.all(np.isfinite(table), axis=1)]
    within = np.rad2deg(1) * np.sqrt(np.mean(np.var(complete, axis=1, ddof=1)))
    assert stated["sem"] == pytest.approx(within)
    assert stated["mdc"] > 1.96 * np.sqrt(2) * within
    assert {"within_visits", "between_visits"} <= set(found["findings"]["cmc"]["table"])
    assert all(0 <= p <= 1 for p in found["findings"]["visits-rms"]["table"]["p"])


@pytest.mark.usefixtures("blank_figures")
def test_a_result_names_the_recordings_that_count(study: Path, tmp_path: Path) -> None:
    """--last 1 uses the second of two trials; a changed byte in it changes the result."""
    folder = copy(study, tmp_path / "s")
    for number in range(3, 6):
        remove(folder, f"sub-{number:02d}_*")
    found = {}
    for name in ("before", "after"):
        out = tmp_path / name
        done = run("reliability", str(folder / "study.toml"), "--last", "1", "--out", str(out))
        assert done.exit_code == 0, done.stderr
        found[name] = json.loads((out / "result.json").read_text())["sha256"]
        (path,) = folder.rglob("sub-01_ses-1_task-EC_run-2_*.csv")
        whole = hashlib.sha256(path.read_bytes()).hexdigest()
        if name == "before":
            assert found[name]["recordings"]["sub-01_ses-1_task-EC"] == [whole]
            content = path.read_bytes()
            row = content.index(
                b"\n", len(content) // 2
            )  # the last number of the row, not the clock
            place = content.rindex(b".", row + 1, content.index(b"\n", row + 1)) + 1
            digit = b"3" if content[place : place + 1] != b"3" else b"4"
            path.write_bytes(content[:place] + digit + content[place + 1 :])
    same = ("configuration", "plant", "versions")
    assert all(found["before"][key] == found["after"][key] for key in same)
    assert found["before"]["all"] != found["after"]["all"]


def copy(study: Path, folder: Path) -> Path:
    shutil.copytree(study, folder, ignore=shutil.ignore_patterns("out"))
    return folder


def remove(folder: Path, pattern: str) -> None:
    for path in folder.rglob(pattern):
        path.unlink()


@pytest.mark.usefixtures("blank_figures")
@pytest.mark.parametrize(
    ("removed", "says"),
    [
        (["*_ses-2_*"], ["got 1 occasion"]),
        ([f"sub-{number:02d}_*" for number in range(2, 6)], ["complete for 1 subject"]),
        # One subject lacks a visit (left out), another a trial (cut to equal numbers).
        (["sub-02_ses-2_task-EO_*", "sub-03_ses-1_task-EC_run-2_*"],
         ["1 subjects lack a visit"]),
        (["*_ses-2_task-VIB_*"], []),
    ],
    ids=["one visit", "one subject", "unequal cells", "no trials of a condition"],
)  # fmt: skip
def test_what_is_missing_is_said(
    study: Path, tmp_path: Path, removed: list[str], says: list[str]
) -> None:
    folder = copy(study, tmp_path / "s")
    for pattern in removed:
        remove(folder, pattern)
    done = run("reliability", str(folder / "study.toml"), "--out", str(tmp_path / "o"))
    assert done.exit_code == 0, done.stderr
    table = (tmp_path / "o" / "icc-rms.csv").read_text()
    assert all(words in table for words in says)
    if not says:  # no numbers if a visit lacks the condition in all subjects
        found = json.loads((tmp_path / "o" / "result.json").read_text())
        shown = pd.DataFrame(found["findings"]["icc-rms"]["table"])
        assert set(shown.dropna(subset=["icc"])["condition"]) == {"EO", "EC"}


def test_an_empty_passband_is_one_line(study: Path, tmp_path: Path) -> None:
    folder = copy(study, tmp_path / "s")
    for path in folder.rglob("*.csv"):
        lines = path.read_text().splitlines()
        rows = [line.rsplit(",", 1)[0] + ",0.0" for line in lines[1:]]
        path.write_text("\n".join([lines[0], *rows]) + "\n")
    done = run("reliability", str(folder / "study.toml"), "--out", str(tmp_path / "o"))
    assert done.exit_code == 2
    assert len(done.stderr.strip().splitlines()) == 1
    assert not (tmp_path / "o").exists()
