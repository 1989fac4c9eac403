"""Stored results of a cohort: valid or computed again after damage."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

import impc
from impc.files.disk import IN_ITS_PLACE
from impc.reporting.writer import owned
from impc.studies.cohort import tasks
from impc.studies.cohort.report import write_report
from impc.studies.cohort.results import cohort_tables
from impc.studies.cohort.tasks import Failures, Store, open_store, run_study, work_kept
from tests.studies.cohort.made_up import fit_of, made_up_study, replicate_of, tasks_of
from tests.support import ThisProcess

REPLICATES = 3
STUDY = made_up_study(2, REPLICATES)
TASKS = tasks_of(STUDY)
DIGESTS = {name: task.digest for name, task in TASKS.items()}
NAMES = [unit.name for unit in STUDY.units]
REASON = "gain: no regulator can be simulated; see the recording"


def filled(folder: Path) -> Store:
    store = Store(folder, DIGESTS)
    for seed, name in enumerate(NAMES):
        store.cache.keep(f"{name}/fit", DIGESTS[name], fit_of(seed))
        for index in range(REPLICATES):
            content = replicate_of(10 * seed + index)
            store.cache.keep(f"{name}/replicate-000{index}", DIGESTS[name], content)
    return store


def test_tables_hold_what_was_kept(tmp_path: Path) -> None:
    found = cohort_tables(STUDY, filled(tmp_path))
    assert len(found["units"]) == 2
    assert len(found["replicates"]) == 2 * REPLICATES
    assert found["units"]["K.force.position"].tolist() == [
        fit_of(seed)["K"][0][0] for seed in (0, 1)
    ]
    assert work_kept(STUDY, Store(tmp_path, DIGESTS)) == (8, 8)


def test_other_settings_are_refused_before_anything_is_done(tmp_path: Path) -> None:
    filled(tmp_path)
    assert open_store(tmp_path, TASKS).digests == DIGESTS
    later = TASKS | {NAMES[1]: impc.replace(TASKS[NAMES[1]], digest="of another horizon")}
    with pytest.raises(impc.InputError, match="other recordings or with other settings"):
        open_store(tmp_path, later)
    (tmp_path / "units" / NAMES[1] / "fit.json").unlink()
    open_store(tmp_path, later)


def refusing(*_: Any) -> dict[str, Any]:
    raise impc.SolverError("gain", "no regulator can be simulated", "see the recording")


def run_and_report(folder: Path, monkeypatch: pytest.MonkeyPatch, fit: Any, draw: Any) -> Failures:
    monkeypatch.setattr(tasks, "fit_unit", fit)
    monkeypatch.setattr(tasks, "replicate_unit", draw)
    store = Store(folder, DIGESTS)
    with owned(folder, "cohort"):
        failures = run_study(STUDY, TASKS, store, ThisProcess())
        write_report(STUDY, store, failures, "impc cohort study.toml")
    return failures


@pytest.mark.usefixtures("blank_figures")
def test_failed_replicates_are_said_and_no_unit_is_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def draw(task: object, fit: object, index: int) -> dict[str, Any]:
        return refusing() if index == 1 else replicate_of(index)

    failures = run_and_report(tmp_path, monkeypatch, lambda _: fit_of(0), draw)
    assert failures.units == {}
    assert [line.partition(": gain")[0] for line in failures.lines] == [
        f"{name}: replicate 2" for name in NAMES
    ]
    found = json.loads((tmp_path / "result.json").read_text())
    assert (found["units"], found["fitted"], found["failed"]) == (2, 2, {})
    assert found["failed_replicates"] == {name: {"2": REASON} for name in NAMES}
    assert found["digests"] == DIGESTS
    assert found["not_determined"] == {"K.force.position_rate": 2}
    assert found["outliers"] == []
    page = (tmp_path / "report.html").read_text()
    assert "4 of 6 " in page
    assert "2 failed" in page
    # Damaged results and files of the folder are made again; finished fits are not.
    again = run_and_report(tmp_path, monkeypatch, refusing, lambda *_: replicate_of(2))
    assert not again
    right = (tmp_path / "replicates.csv").read_bytes()
    assert right.count(b"\n") == 7
    for damaged in (f"units/{NAMES[0]}/replicate-0002.json", "replicates.csv", "result.json"):
        (tmp_path / damaged).write_text("{}")
    assert not run_and_report(tmp_path, monkeypatch, refusing, lambda *_: replicate_of(2))
    assert (tmp_path / "replicates.csv").read_bytes() == right


@pytest.mark.usefixtures("blank_figures")
def test_pages_leave_out_inner_states(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fit = fit_of(0)
    fit["shown"]["K.force.position_rate"] |= {"inner": True, "compared": False}
    run_and_report(tmp_path, monkeypatch, lambda _: fit, lambda *_: replicate_of(0))
    page = (tmp_path / "subjects" / "sub-1.html").read_text()
    assert "hand position" in page
    assert "N s/m" not in page
    assert "K.force.position_rate" in pd.read_csv(tmp_path / "units.csv")


@pytest.mark.usefixtures("blank_figures")
def test_no_unit_fitted_is_a_report_of_reasons(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    failures = run_and_report(tmp_path, monkeypatch, refusing, refusing)
    assert failures.lines == [f"{name}: {REASON}" for name in NAMES]
    assert "No fit of this study can be used." in (tmp_path / "report.html").read_text()
    assert json.loads((tmp_path / "result.json").read_text())["fitted"] == 0


@pytest.mark.parametrize("what", ["folder", "device"])
def test_what_stands_in_the_place_of_the_log_is_to_be_moved(what: str, tmp_path: Path) -> None:
    """The message does not ask for disk space."""
    path = tmp_path / "cohort.log"
    path.mkdir() if what == "folder" else path.symlink_to("/dev/full")
    with pytest.raises(impc.OutputError, match=r"cohort\.log: cannot be written") as caught:
        Store(tmp_path, DIGESTS).log("run")
    assert "\n" not in str(caught.value)
    assert caught.value.remedy == IN_ITS_PLACE
