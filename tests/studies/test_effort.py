"""Estimates of run time and memory, and confirmation of large requests."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import numpy as np
import psutil
import pytest
from click.testing import CliRunner

import impc
import impc.cli.console
import impc.studies.cohort.tasks
from impc.arrays import Array, IntArray
from impc.cli.console import require_consent
from impc.cli.main import main
from impc.control.closed_loop import prepare_loop
from impc.control.named_solver import SOLVERS
from impc.studies.effort import (
    Effort,
    fit_effort,
    key_evaluations,
    select_evaluations,
    selection_effort,
)
from impc.studies.selection.analysis import key_parameters, select_study
from impc.studies.selection.model import ParametricModel, Trial, sensitivity
from impc.studies.selection.model_source import model_source
from impc.studies.selection.settings import SelectSettings
from tests.files.test_inputs import here
from tests.studies.cohort.carts import write_study
from tests.studies.selection.dosing import in_turn
from tests.studies.selection.heads import head_model, head_trials
from tests.support import random_plant


@pytest.mark.parametrize(("n", "m", "horizon"), [(2, 1, 300), (4, 2, 100), (8, 1, 150)])
def test_memory_is_told_to_its_order_of_magnitude(n: int, m: int, horizon: int) -> None:
    """Compare with the memory allocated by NumPy for rows and derivatives."""
    plant = random_plant(np.random.default_rng(5), n, m, 0.95)
    bounds = impc.Bounds(plant, u_min=-1, u_max=1)
    trial = impc.Recording(plant, np.ones((50, n)))
    problem = impc.Problem(plant, bounds, horizon, (trial,), terminal_set=False)
    stated = fit_effort(problem, impc.FitSettings(horizon=horizon)).gigabytes * 1e9
    K = impc.solve_lqr(plant, impc.Weights(np.eye(n), np.eye(m))).K
    controller = impc.Controller.from_gain(plant, K, bounds, horizon, terminal_set=False)
    tracemalloc.start()
    try:
        prepare_loop(controller, impc.directions(controller, n * m + m * m + n))
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert 0.5 < stated / peak < 2


def test_time_grows_with_what_is_asked() -> None:
    plant = random_plant(np.random.default_rng(5), 4, 1, 0.95)
    bounds = impc.Bounds(plant, u_min=-1, u_max=1)
    trials = (impc.Recording(plant, np.ones((3000, 4))),) * 3
    problem = impc.Problem(plant, bounds, 20, trials, terminal_set=False)
    usual = fit_effort(
        problem, impc.FitSettings(replicates=1000, profiles=["a"], horizons=[10])
    ).seconds
    assert 60 < usual < 7200
    assert fit_effort(problem, impc.FitSettings(replicates=10**6)).seconds > 7200
    plain = fit_effort(problem, impc.FitSettings()).seconds
    slower = [
        fit_effort(impc.replace(problem, solver=name), impc.FitSettings()).seconds / plain
        for name in SOLVERS
    ]
    assert min(slower) > 5
    assert max(slower) > 50  # IPOPT's


def test_consent(monkeypatch: pytest.MonkeyPatch) -> None:
    require_consent(Effort(60, 0.1), given=False)
    require_consent(Effort(1e9, 0.1), given=True)
    with pytest.raises(impc.InputError, match=r"would take about 2\.78e\+05 hours.*or pass --yes"):
        require_consent(Effort(1e9, 0.1), given=False)
    machine = psutil.virtual_memory().total / 1e9
    with pytest.raises(impc.InputError, match="more than this machine has"):
        require_consent(Effort(60, machine + 1), given=True)


@pytest.mark.parametrize(
    "setting", ["horizon = 10\nreplicates = 1000000", 'horizon = 5000\nsolver = "daqp"']
)
def test_a_request_for_hours_or_memory_ends_at_once(
    setting: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A large request is refused before any fit, without output files."""

    def unwanted(*_: object, **__: object) -> None:
        raise AssertionError("the request is refused before the work")

    monkeypatch.setattr("impc.cli.fit.fit_recordings", unwanted)
    _, table, settings = write_study(tmp_path, 1).read_text().partition("[recording]")
    config = tmp_path / "a.toml"
    config.write_text(table + settings.replace("horizon = 10\n", "").replace(
        "replicates = 0\n", f"{setting}\n"))  # fmt: skip
    words = ["fit", str(tmp_path / "sub-01/cart_1.csv"), "--config", str(config),
             "--plant", "tests.studies.cohort.carts:cart_plant"]  # fmt: skip
    done = CliRunner().invoke(main, [*words, "--out", str(tmp_path / "out")])
    assert done.exit_code == 2, done.stderr
    assert done.stderr.startswith("impc: error: this request: would ")
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("which", ["drug", pytest.param("head", marks=pytest.mark.slow)])
def test_evaluations_of_a_selection_are_told_to_their_order_of_magnitude(which: str) -> None:
    """Counted: calls of the Jacobian. A fit of the drug takes 7, one of the head 200."""
    if which == "drug":
        model, trials = drug()
    else:
        model = head_model()
        trials = tuple(head_trials(model, np.array(model.typical), 0.8, 3, count=1))
    calls = 0
    plain = impc.replace(model, jacobian=None)

    def counted(theta: Array, given: Array, free: IntArray) -> tuple[Array, Array]:
        nonlocal calls
        calls += 1
        if model.jacobian is not None:
            return model.jacobian(theta, given, free)
        outputs, derivative = sensitivity(plain, theta, given, free)
        return outputs, derivative / model.gain[free]

    watched = impc.replace(model, jacobian=counted)
    settings = SelectSettings(replicates=20, starts=2, least=1)
    select_study({"1": trials}, settings, in_turn(watched))
    assert 1 / 10 < select_evaluations(settings) / calls < 10
    calls = 0
    cells = {(subject, visit): trials for subject in "12" for visit in "12"}
    found = key_parameters(watched, cells, settings, in_turn(watched), bound=0.5)
    stated = key_evaluations(settings, len(found.candidates))
    assert 1 / 10 < stated / (calls / 4) < 10


def drug() -> tuple[ParametricModel, tuple[Trial, ...]]:
    model = model_source("tests.studies.selection.dosing:blood_model", {}).model
    dose = np.zeros((192, 1))
    dose[::32] = 400.0
    level = model.simulate(np.array([1.2, 0.08, 25.0]), dose)
    noise = 0.03 * np.std(level) * np.random.default_rng(0).standard_normal(level.shape)
    return model, (Trial(dose, level + noise),)


def test_compiling_a_model_is_no_part_of_what_a_selection_takes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Simulated clock, 6 s for the first call, then 0.02 s: estimate 15 minutes, not 79 h."""
    model, trials = drug()
    clock = iter([0.0, 6.0, 6.0, 6.02, 6.02, 6.05])
    monkeypatch.setattr("impc.studies.effort.time.perf_counter", lambda: next(clock))
    assert selection_effort(model, [trials], 10).seconds == pytest.approx(0.2)


def test_a_cohort_for_days_ends_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Refused without output files, and started with --yes."""
    here(monkeypatch)
    study = write_study(tmp_path, 1, replicates=1_000_000)
    words = ["cohort", str(study), "--allow-plant", "--out", str(tmp_path / "out")]
    done = CliRunner().invoke(main, words)
    assert done.exit_code == 2, done.output
    assert "this request: would take about" in done.stderr
    assert not (tmp_path / "out").exists()

    def begun(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(impc.studies.cohort.tasks, "run_study", begun)
    done = CliRunner().invoke(main, [*words, "--yes"])
    assert done.exit_code == 130, done.output
