"""Small versions of the studies: one subject or recording each; more in the slow tests."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from experiments import noise_study, plan_study
from experiments.benchmarks.workloads import seat
from experiments.coverage import covered
from experiments.default_subjects import fitted_subject, simulated_files
from experiments.noise_study import COMPARED, Cell, Outcome, study_cell
from experiments.structure_study import cart_person, score
from impc.studies.plan.designs import try_design

pytestmark = pytest.mark.full


def shares(count: int, root: float) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """Share of recordings (seeds 0 to count - 1) whose 95 % interval covers each entry of K."""
    scores = np.array([covered(seed, root) for seed in range(count)])
    return np.asarray(np.mean(np.abs(scores) <= 1.96, axis=0))


@pytest.mark.full
def test_fifty_recordings() -> None:
    """Binomial bounds: 50 of 95 % fall below 42 once in a thousand."""
    white, coloured = shares(50, 0.0), shares(50, 0.9)
    assert np.all(white >= 0.84)
    assert np.all(coloured[1] >= 0.82)
    assert np.all(coloured[0] < 0.6)


@pytest.mark.slow
def test_four_hundred_recordings() -> None:
    white, coloured = shares(400, 0.0), shares(400, 0.9)
    assert np.all((white >= 0.92) & (white <= 0.98))
    assert np.all((coloured[1] >= 0.92) & (coloured[1] <= 0.98))
    assert np.all(coloured[0] < 0.6)


def test_the_truth_of_a_short_default_subject_is_found(tmp_path: Path) -> None:
    """Seed 0, a trial of 10 s: the nonlinear body has the smaller misfit; intervals are wide."""
    files = simulated_files(tmp_path / "one", 0, "--trials", "1", "--duration", "10")
    own, linear = (fitted_subject(files, body) for body in ("nonlinear", "linear"))
    assert own.inside == own.entries == 10
    assert linear.misfit > 1.1 * own.misfit


@pytest.mark.slow
def test_twenty_default_subjects(tmp_path: Path) -> None:
    """The coverage of `python -m experiments.default_subjects`."""
    found = []
    for seed in range(20):
        files = simulated_files(tmp_path / str(seed), seed)
        found.append(fitted_subject(files, "nonlinear"))
    assert sum(one.inside for one in found) >= 0.92 * sum(one.entries for one in found)


def test_a_cell_with_saturation(monkeypatch: pytest.MonkeyPatch) -> None:
    """At 4.5 Nm and 1 % noise inverse MPC has a point more VAF than methods without bounds.

    Trials of 10 s instead of the 30 s of the study.
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
    """With all cells kept nothing is computed, and the table uses the kept results."""
    outcome = {"vaf": 50.0, "gain_error": 0.5, "has_weights": True, "seconds": 1.0, "reason": ""}
    cells = [Cell(6.0, 90.0, seed) for seed in range(2)]
    (tmp_path / "cells").mkdir()
    for cell in cells:
        content = json.dumps(dict.fromkeys(COMPARED, outcome))
        (tmp_path / "cells" / f"{cell.name}.json").write_text(content)
    monkeypatch.setattr(noise_study, "study_cell", None)
    found = noise_study._run(cells, tmp_path)
    assert found[cells[1].name]["inverse_kkt"] == Outcome(50.0, 0.5, True, 1.0, "")


@pytest.mark.slow
def test_deviations_are_those_of_a_hundred_fits_and_the_best_is_the_best() -> None:
    found = plan_study.compare("cart", 100)
    for _, foreseen, seen in found:
        assert np.all(np.abs(np.log(seen / foreseen)) < np.log(1.2))
    planned = min(found, key=lambda row: float(np.mean(row[1] ** 2)))
    assert planned is min(found, key=lambda row: float(np.mean(row[2] ** 2)))


@pytest.mark.parametrize(("make", "directions"), [(plan_study.cart, 2), (plan_study.seat, 6)])
def test_the_grid_of_a_study_can_be_planned(make: object, directions: int) -> None:
    assert callable(make)
    person, perturbation, grid, trials = make()
    identified = try_design(person, grid[0], perturbation, trials=trials, draws=trials)
    assert identified.falls == 0
    assert identified.expected is not None
    assert np.count_nonzero(identified.expected.gain.identified) == directions


def test_a_subject_is_scored_against_its_truth() -> None:
    found = score(cart_person(0, 90.0, 0.0, 0.0), "carts", 0)
    assert found.holds == [True] * 5  # seed 0
    assert found.one_sided == [False] * 5
    assert found.excess < 0.5  # The default start ends where a search from the truth ends
    assert found.freedom >= 3
    assert 0.05 < found.probability <= 1  # seed 0


@pytest.mark.slow
def test_the_level_of_the_test_and_its_power() -> None:
    """Of 40 at 5 % two rejections are expected: 7 or more have a probability of 0.5 %."""
    people = [score(cart_person(k, 90.0, 0.8, 0.0), "", k, intervals=False) for k in range(40)]
    assert sum(item.probability < 0.05 for item in people) <= 6
    crossed = [score(cart_person(k, 90.0, 0.0, 0.5), "", k, intervals=False) for k in range(5)]
    assert np.mean([item.probability < 0.05 for item in crossed]) == 1.0
