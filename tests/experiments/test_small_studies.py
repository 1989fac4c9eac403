"""Small versions of the studies: one subject or recording each; more in the slow tests."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import scipy.stats

from experiments import noise_study, plan_study
from experiments.benchmarks.workloads import seat
from experiments.coverage import covered
from experiments.default_subjects import fitted_subject, simulated_files
from experiments.driver import Row, kept_rows
from experiments.noise_study import COMPARED, study_cell
from experiments.structure_study import cart_person, score
from experiments.summary import clustered, counted
from impc.studies.plan.designs import try_design

pytestmark = pytest.mark.full


def test_the_truth_of_a_short_default_subject_is_found(tmp_path: Path) -> None:
    """Seed 0, a trial of 10 s: the nonlinear body has the smaller misfit; intervals are wide."""
    files = simulated_files(tmp_path / "one", 0, "--trials", "1", "--duration", "10")
    own, linear = (fitted_subject(files, body) for body in ("nonlinear", "linear"))
    assert own.inside == [True] * 10
    assert linear.misfit > 1.1 * own.misfit


def drawn(study: str, seed: int) -> Row:
    return {"value": float(np.random.default_rng([len(study), seed]).normal())}


def test_subjects_that_are_done_are_not_done_again(tmp_path: Path) -> None:
    """A run in two parts has the lines of a run in one, and of what is kept none is computed."""
    tasks = [(study, seed) for seed in range(3) for study in ("a", "bb")]
    whole, parts = tmp_path / "deeper" / "whole.jsonl", tmp_path / "parts.jsonl"
    found = kept_rows(whole, drawn, tasks)
    assert [row["seed"] for row in found["bb"]] == [0, 1, 2]
    assert [row["value"] for row in found["a"]] == [drawn("a", seed)["value"] for seed in range(3)]
    kept_rows(parts, drawn, tasks[:3])
    assert kept_rows(parts, drawn, tasks) == found
    assert parts.read_text() == whole.read_text()
    assert kept_rows(parts, None, tasks) == found  # type: ignore[arg-type]


def test_shares_have_the_intervals_of_binomials_and_of_drawn_subjects() -> None:
    """Clopper-Pearson by beta quantiles; clusters of dependent cases against repeated draws."""
    low, high = scipy.stats.beta.ppf(0.025, 112, 9), scipy.stats.beta.ppf(0.975, 113, 8)
    assert counted(112, 120) == f"112 of 120, 93.3 % ({100 * low:.0f} to {100 * high:.0f} %)"
    assert clustered([[True, False], [True, False]]) == (50.0, 0.0)
    rng = np.random.default_rng(1)

    def share() -> tuple[float, float]:
        chance = rng.beta(4, 1, 60)
        return clustered([list(rng.random(rng.integers(1, 6)) < one) for one in chance])

    found = np.array([share() for _ in range(400)])
    assert np.mean(found[:, 1]) == pytest.approx(np.std(found[:, 0]), rel=0.15)


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
    found = score(cart_person(0, 90.0, 0.0, 0.0))  # seed 0
    assert found.holds == [True] * 5
    assert found.one_sided == [False] * 5
    assert found.excess < 0.5  # The default start ends where a search from the truth ends
    assert found.freedom >= 3
    assert 0.05 < found.probability <= 1  # seed 0


def shares(count: int, root: float) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """Share of recordings (seeds 0 to count - 1) whose 95 % interval covers each entry of K."""
    scores = np.array([covered(seed, root) for seed in range(count)])
    return np.asarray(np.mean(np.abs(scores) <= 1.96, axis=0))


def test_fifty_recordings() -> None:
    """Binomial bounds: 50 of 95 % fall below 42 once in a thousand."""
    white, coloured = shares(50, 0.0), shares(50, 0.9)
    assert np.all(white >= 0.84)
    assert np.all(coloured[1] >= 0.82)
    assert np.all(coloured[0] < 0.6)


def test_a_cell_with_saturation(monkeypatch: pytest.MonkeyPatch) -> None:
    """At 4.5 Nm and 1 % noise inverse MPC has a point more VAF than methods without bounds.

    Trials of 10 s instead of the 30 s of the study.
    """
    monkeypatch.setattr(
        noise_study, "seat", lambda trials, seconds, limit: seat(trials, seconds / 3, limit)
    )
    found = study_cell(4.5, 99.0, 0)
    assert list(found) == list(COMPARED)
    ours = found["inverse_mpc"]["missed"]
    assert ours < 0.1
    for name in ("feedback_gain", "inverse_lqr_output", "inverse_kkt"):
        assert found[name]["missed"] > ours + 1
    assert not found["inverse_lqr_lmi"]["gain"]
