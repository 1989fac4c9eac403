"""The noise study: one cell against what is known of it, and going on after an interruption."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from experiments import noise_study
from experiments.benchmarks.workloads import seat
from experiments.noise_study import COMPARED, Cell, Outcome, study_cell

pytestmark = pytest.mark.full


def test_a_cell_with_saturation(monkeypatch: pytest.MonkeyPatch) -> None:
    """At 4.5 Nm and 1 % noise inverse MPC wins by more than a point over all without bounds.

    Trials of 10 s, for the 30 s of the study.
    """
    monkeypatch.setattr(
        noise_study, "seat", lambda trials, seconds, limit: seat(trials, seconds / 3, limit)
    )
    found = study_cell(Cell(4.5, 99.0, 0))
    assert list(found) == list(COMPARED)
    ours = found["inverse_mpc"].vaf
    assert ours is not None
    assert ours > 99.9
    for name in ("feedback_gain", "inverse_lqr_output", "inverse_kkt"):
        other = found[name].vaf
        assert other is not None
        assert other < ours - 1
    assert found["inverse_lqr_lmi"].gain_error is None


def test_cells_that_are_done_are_not_done_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All cells kept: nothing is computed, and the table is made of what was kept."""
    outcome = {"vaf": 50.0, "gain_error": 0.5, "has_weights": True, "seconds": 1.0, "reason": ""}
    cells = [Cell(6.0, 90.0, seed) for seed in range(2)]
    (tmp_path / "cells").mkdir()
    for cell in cells:
        content = json.dumps(dict.fromkeys(COMPARED, outcome))
        (tmp_path / "cells" / f"{cell.name}.json").write_text(content)
    monkeypatch.setattr(noise_study, "study_cell", None)
    found = noise_study._run(cells, tmp_path)
    assert found[cells[1].name]["inverse_kkt"] == Outcome(50.0, 0.5, True, 1.0, "")
