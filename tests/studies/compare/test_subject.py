"""`impc compare`: methods on the cart against the truth, and the command."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Callable
from pathlib import Path

import control
import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner

from experiments.coverage import cart, noisy_trial, true_controller
from experiments.uncertain_body import cart_person
from impc.arrays import Array
from impc.assess.assessments import MethodFit, evaluate_method
from impc.checking import replace
from impc.cli.main import main
from impc.control.controller import Controller
from impc.files.saved_estimates import decode_estimate, encode_estimate
from impc.inverse import methods
from impc.inverse.estimates import Estimate, Status
from impc.inverse.problem import Problem
from impc.model.bounds import Bounds
from impc.model.plant import Plant
from impc.model.recordings import Recording
from impc.model.weights import Weights
from impc.studies.compare.subject import (
    compare_recordings,
    compared_methods,
    stages,
)
from impc.studies.fit.asked import fit_problem
from impc.studies.fit.memory import open_memory
from impc.studies.fit.settings import FitSettings
from plants import yalmip_example
from tests.support import easier_seat

pytestmark = pytest.mark.full

SETTINGS = FitSettings(horizon=10, u_max=1.0)


@pytest.fixture(scope="module")
def compared() -> dict[str, MethodFit]:
    problem = fit_problem(cart(), [noisy_trial(seed, 0.0) for seed in (21, 22)], SETTINGS)
    heard: list[str] = []

    def remember(stage: str, compute) -> Estimate:  # type: ignore[no-untyped-def]
        heard.append(stage)
        return compute()  # type: ignore[no-any-return]

    found = compare_recordings(problem, 1.0, remember)
    assert tuple(heard) == stages(2)
    assert [item.name for item in found] == list(compared_methods())
    return {item.name: item for item in found}


def gain_error(item: MethodFit) -> float:
    truth = true_controller().K
    assert item.estimate.K is not None
    return float(np.linalg.norm(item.estimate.K - truth) / np.linalg.norm(truth))


def test_inverse_mpc_finds_the_gain_and_keeps_the_limit(
    compared: dict[str, MethodFit],
) -> None:
    for name in ("inverse_mpc", "inverse_mpc_reduced"):
        assert gain_error(compared[name]) < 0.05
        assert compared[name].keeps_bounds
    feedback = compared["feedback_gain"]
    assert gain_error(feedback) > 2 * gain_error(compared["inverse_mpc"])
    assert not feedback.keeps_bounds


def test_left_out_trials(compared: dict[str, MethodFit]) -> None:
    ours = compared["inverse_mpc"]
    assert ours.held_out.shape == (2, 1)
    # With noise of 20 %, the largest possible VAF is 1 / 1.04.
    assert np.all(np.abs(ours.held_out - 100 / 1.04) < 1.5)
    assert np.mean(compared["feedback_gain"].held_out) < np.mean(ours.held_out)


def test_exceeding_is_counted_sample_by_sample(compared: dict[str, MethodFit]) -> None:
    fit = compared["feedback_gain"]
    u: Array = np.concatenate([run.u for run in fit.runs])
    assert fit.exceeded == pytest.approx(float(np.mean(np.abs(u) > 1 + 1e-6)))
    assert fit.largest_input[0] == pytest.approx(float(np.max(np.abs(u))))


def test_only_samples_that_were_reached_count() -> None:
    """x+ = 1.5 x + u with |u| <= 0.1 diverges from 1, with all commands at the limit."""
    plant = Plant(control.ss([[1.5]], [[1]], [[1]], 0, 1))
    wide = Bounds(plant, u_min=-5, u_max=5)
    run = Controller(plant, Weights(1, 1), wide, 3, terminal_set=False).simulate([1.0], steps=400)
    problem = Problem(plant, wide, 3, [Recording(plant, run.x)], terminal_set=False)
    found = methods.fit(problem)
    tight = Bounds(plant, u_min=-0.1, u_max=0.1)
    fit = evaluate_method(replace(found, problem=replace(found.problem, bounds=tight)), wide)
    assert fit.fell[0] is not None
    assert 5 < len(fit.commands) < 200
    np.testing.assert_allclose(fit.commands, -0.1)
    small = Bounds(plant, u_min=-0.05, u_max=0.05)
    assert evaluate_method(fit.estimate, small).exceeded == 1.0


def test_what_the_gain_leaves_too_is_no_fault_of_the_weights(
    compared: dict[str, MethodFit],
) -> None:
    """With noise: weights with exactly the gain have the misfit of the gain."""
    found = compared["inverse_mpc_reduced"].estimate
    assert found.weights is not None
    assert found.misfit > 0.1
    assert found.reason == ""


def test_estimates_go_through_json(compared: dict[str, MethodFit]) -> None:
    problem = fit_problem(cart(), [noisy_trial(seed, 0.0) for seed in (21, 22)], SETTINGS)
    for estimate in (item.estimate for item in compared.values()):
        seen = problem if estimate.method == "inverse_mpc" else estimate.problem
        again = decode_estimate(seen, json.loads(json.dumps(encode_estimate(estimate))))
        assert again.reason == estimate.reason
        if estimate.K is None:
            assert again.K is None
        else:
            np.testing.assert_array_equal(again.K, estimate.K)
            np.testing.assert_array_equal(again.problem.starts, estimate.problem.starts)
            assert again.status is estimate.status


def test_an_interrupted_comparison_goes_on(compared: dict[str, MethodFit], tmp_path: Path) -> None:
    """Continue after an interruption: finished fits are not repeated, same result."""
    problem = fit_problem(cart(), [noisy_trial(seed, 0.0) for seed in (21, 22)], SETTINGS)
    computed: list[str] = []

    def first_seven(stage: str, compute: Callable[[], Estimate]) -> Estimate:
        if len(computed) == 6:
            raise KeyboardInterrupt
        return counted(stage, compute)

    def counted(stage: str, compute: Callable[[], Estimate]) -> Estimate:
        def noted() -> Estimate:
            computed.append(stage)
            return compute()

        return open_memory(tmp_path, problem, SETTINGS, "compare").estimate(stage, noted)

    with pytest.raises(KeyboardInterrupt):
        compare_recordings(problem, 1.0, first_seven)
    again = compare_recordings(problem, 1.0, counted)
    assert len(set(computed)) == len(computed)
    assert set(computed) == set(stages(2))
    for one, other in zip(compared.values(), again, strict=True):
        np.testing.assert_array_equal(one.vaf, other.vaf)
        np.testing.assert_array_equal(one.held_out, other.held_out)


def test_what_is_kept_has_the_body_that_was_fitted_to_the_same_trials(tmp_path: Path) -> None:
    person = cart_person(1, 99, 0.0)
    assert person is not None
    memory = open_memory(tmp_path, person.problem, SETTINGS, "compare")

    def compared() -> dict[str, Estimate]:
        found: dict[str, Estimate] = {}

        def kept(stage: str, compute: Callable[[], Estimate]) -> Estimate:
            return found.setdefault(stage, memory.estimate(stage, compute))

        compare_recordings(person.problem, 1.0, kept)
        return found

    first, again = compared(), compared()
    assert set(memory.names.values()) == {True}
    for stage, one in first.items():
        assert not np.array_equal(one.problem.plant.A, person.problem.plant.A)
        np.testing.assert_array_equal(again[stage].problem.plant.A, one.problem.plant.A, stage)


def test_the_command(tmp_path: Path) -> None:
    runner = CliRunner()
    made = runner.invoke(
        main,
        ["simulate", "seated-balance", "--out", str(tmp_path), "--duration", "5",
         "--formats", "csv"],
    )  # fmt: skip
    assert made.exit_code == 0, made.stderr
    files = [str(tmp_path / f"trial_{number}.csv") for number in (1, 2)]
    config = tmp_path / "subject.toml"
    config.write_text(easier_seat(config.read_text()))
    out = tmp_path / "out"
    arguments = ["--plant", "seated-balance", "--config", str(config)]
    done = runner.invoke(main, ["compare", *files, *arguments, "--out", str(out)])
    assert done.exit_code == 0, done.stderr
    names = {path.name for path in out.iterdir()}
    tables = {"methods.csv", "trajectories.csv", "tables.xlsx", "long.csv", "results.mat"}
    assert names == {"report.html", "result.json", ".impc", "figures", *tables}
    found = json.loads((out / "result.json").read_text())["methods"]
    assert list(found) == list(compared_methods())
    with (out / "methods.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    for row in rows:
        identified = found[row["name"]]["vaf"]["theta1"]
        assert row["vaf_theta1"] == ("" if identified is None else repr(identified))
    long, sway = (pd.read_csv(out / f"{name}.csv") for name in ("long", "trajectories"))
    first = long[(long["column"] == "theta1") & long["row"].isin(["command", "theta1"])]
    assert set(first.query("quantity == 'K'")["unit"]) == {"N m/rad"}
    for name, method in found.items():
        own = first[first["method"] == name].set_index("quantity")["estimate"]
        for matrix in ("K", "Q"):
            if method[matrix] is not None:
                assert own[matrix] == method[matrix][0][0]
    trial = sway.query("trial == 'trial_2.csv'")
    left = trial.theta1_recorded_deg - trial.theta1_inverse_mpc_deg
    share = 100 * (1 - np.sum(left**2) / np.sum(trial.theta1_recorded_deg**2))
    assert share == pytest.approx(found["inverse_mpc"]["trial_vaf"][1][0])
    page = (out / "report.html").read_text()
    assert not re.search("https?:", page)
    assert "No limit, inverse LQR (exact)" in page
    assert "With limit, inverse MPC" in done.stdout
    assert max(map(len, done.stdout.split("Open ")[0].splitlines())) <= 100


def test_a_printed_estimate_says_what_speaks_against_it(
    compared: dict[str, MethodFit], caplog: pytest.LogCaptureFixture
) -> None:
    assert "leaves" not in str(compared["inverse_mpc"].estimate).split("noise.", 1)[1]
    clipped = str(compared["inverse_lqr_output"].estimate)
    assert "Another gain has a smaller misfit" in clipped
    stopped = replace(compared["inverse_mpc"].estimate, status=Status.STOPPED)
    assert "stopped before it converged: the result may be wrong" in str(stopped)
    plant = Plant(yalmip_example())
    still = np.random.default_rng(1).standard_normal((21, 2))
    bounds = Bounds(plant, u_min=-1, u_max=1)
    with caplog.at_level("INFO", logger="impc"):
        found = methods.fit(Problem(plant, bounds, 3, [Recording(plant, still)]))
    assert [item.args for item in caplog.records] == [(found,)]
    share = found.misfit / np.sqrt(still.size)  # outputs are scaled by their root mean square
    assert f"The residual is {100 * share:.0f} % of the recordings" in str(found)
