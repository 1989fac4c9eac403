"""`impc plan` from configuration to report."""

from __future__ import annotations

import html
import json
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner, Result

from impc.cli.main import main
from impc.cli.seat import seat_controller
from impc.files.formats import write_table
from impc.files.results import SCHEMA, read_result
from impc.files.table import make_table

PLAN = """
[plant]
mass = 79.7
height = 1.66

[fit]
u_max = 6.0
body = "linear"

[plan]
gain = [GAIN]
noise = { theta1 = "0.02 deg", theta2 = "0.02 deg" }
correlation = 0.02
stops = { theta1 = "12 deg" }
perturbed = ["perturbation"]
amplitude = [3, 6]
dwell = [0.25]
duration = 15.0
trials = 1
draws = 2
"""
# The subject of `impc simulate seated-balance`.
GAIN = seat_controller({"mass": 79.7, "height": 1.66}, 6.0).K.tolist()
PLAN = PLAN.replace("[GAIN]", json.dumps(GAIN))


def run(*arguments: str) -> Result:
    return CliRunner().invoke(main, list(arguments))


def planned(folder: Path, text: str, name: str = "out") -> Result:
    (folder / "plan.toml").write_text(text, encoding="utf-8")
    out = str(folder / name)
    return run("plan", str(folder / "plan.toml"), "--plant", "seated-balance", "--out", out)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("plan")
    done = planned(folder, PLAN)
    assert done.exit_code == 0, done.output
    assert "One 15-s trial at 6 N m determine" in done.output
    assert "best of 2 experiments: 6 N m, held for 0.25 s" in done.output
    assert max(map(len, done.output.partition("Open ")[0].splitlines())) <= 100
    return folder


def test_the_page_the_table_and_the_numbers_say_the_same(folder: Path) -> None:
    found = json.loads((folder / "out" / "result.json").read_text(encoding="utf-8"))
    table = pd.read_csv(folder / "out" / "experiments.csv")
    page = (folder / "out" / "report.html").read_text(encoding="utf-8")
    assert table["amplitude"].tolist() == [3, 6]
    assert found["best"] == {"amplitude": 6, "dwell": 0.25}
    errors = table["theta1_percent"].tolist()
    kept = found["findings"]["experiments"]["table"]["theta1_percent"]
    # Infinite in CSV, null in JSON.
    assert [value if value is not None else np.inf for value in kept] == pytest.approx(errors)
    assert errors[0] == np.inf
    assert 5 < errors[1] < 15
    gains = pd.read_csv(folder / "out" / "gains.csv")
    assert np.all(gains["with_an_exact_body_percent"] < gains["standard_error_percent"])
    assert found["K"] == GAIN
    per_degree = np.radians(GAIN[0][0])
    assert gains["assumed"][0] == pytest.approx(per_degree)
    assert gains["gain"].tolist() == ["seat tilt", "trunk tilt", "seat velocity", "trunk velocity"]
    body = pd.read_csv(folder / "out" / "body.csv").set_index("parameter")
    assert body.loc["tau_m", "stated_percent"] == pytest.approx(25)
    assert found["findings"]["body"]["table"]["theta1_narrower_percent"] == pytest.approx(
        list(body["theta1_narrower_percent"])
    )
    assert list(body.index) == found["findings"]["body"]["table"]["parameter"]
    text = html.unescape(re.sub("<[^>]*>", "", page)).replace("\u00a0", " ")
    assert found["verdict"]["headline"] in text
    assert "simulated with one 15-s trial at 6 N m." in text  # units keep their case
    assert found["verdict"]["level"] == "green"
    assert read_result(folder / "out").content["best"] == found["best"]
    assert (folder / "out" / "figures" / "trials.svg").stat().st_size > 5_000
    each = table[["theta1_percent", "theta2_percent", "theta1_rate_percent", "theta2_rate_percent"]]
    np.testing.assert_allclose(table["widest_interval_percent"], each.max(axis=1))


EXACT = PLAN.replace("[fit]", "[plant.uncertainty]\nall = 0\n\n[fit]", 1)
EXACT = EXACT.replace("[3, 6]", "[1, 2]").replace("0.02 deg", "1e-5 deg")


def test_a_body_that_is_exact_is_said_to_be(tmp_path: Path) -> None:
    done = planned(tmp_path, EXACT)
    assert done.exit_code == 0, done.output
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "Taken as exact" in page
    # Twice the torque without any bound: half the standard error.
    errors = pd.read_csv(tmp_path / "out" / "experiments.csv")["theta1_percent"]
    assert errors[1] == pytest.approx(errors[0] / 2, rel=1e-6)
    assert not (tmp_path / "out" / "body.csv").exists()


def test_an_interval_without_an_end_is_infinite_not_a_large_number(tmp_path: Path) -> None:
    done = planned(tmp_path, PLAN.replace("0.02 deg", "100000 deg").replace("[3, 6]", "[2]"))
    assert done.exit_code == 0, done.output
    assert "seat tilt: not determined" in " ".join(done.output.split())
    found = json.loads((tmp_path / "out" / "result.json").read_text("utf-8"))["findings"]
    (row,) = pd.read_csv(tmp_path / "out" / "experiments.csv").to_dict("records")
    assert found["experiments"]["table"]["theta1_percent"] == [None]
    assert row["theta1_percent"] == np.inf


def test_a_perturbation_from_a_file_is_scaled(folder: Path) -> None:
    time = np.arange(1500) / 100
    push = np.where(np.floor(time * 4) % 3 == 0, 2.0, -1.0)
    write_table(folder / "push.csv", make_table("push", {"time": time, "motor": push}))
    signals = (
        '\n[recording]\ntime = "time"\n[signals.perturbation]\ncolumn = "motor"\nunit = "N*m"\n'
    )
    text = PLAN.replace("dwell = [0.25]", 'files = ["push.csv"]').replace(
        "amplitude = [3, 6]", "amplitude = [1, 2]"
    )
    done = planned(folder, text + signals, "file")
    assert done.exit_code == 0, done.output
    assert "One trial with 2 times the recorded perturbation" in " ".join(done.output.split())
    found = json.loads((folder / "file" / "result.json").read_text(encoding="utf-8"))
    table = found["findings"]["experiments"]["table"]
    assert table["amplitude"] == [1, 2]
    assert table["dwell"] == [None, None]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (('perturbed = ["perturbation"]', ""), "[plan] perturbed: names no input of the plant"),
        (("amplitude = [3, 6]", "amplitude = [90]"), "falls in at least 100 % of the trials"),
        (('"0.02 deg", theta2', '"0.05 kg", theta2'), "noise theta1: is in kg"),
        (('"0.02 deg", theta2', '"deg", theta2'), "noise theta1: got deg"),
        (("gain = [[", "gain = [[1.0, "), f"[plan] gain: has rows of {len(GAIN[0]) + 1} numbers"),
        (("gain = [[", "gain = [[nan, 1.0], ["), "[plan] gain"),
        (("u_max = 6.0", 'bounded_states = { theta1 = "data" }'), 'bounded_states: is "data"'),
        (("[plan]", "[plann]"), "plann: is not known"),
    ],
)
def test_a_plan_that_cannot_be_made_is_refused_in_one_line(
    tmp_path: Path, change: tuple[str, str], message: str
) -> None:
    done = planned(tmp_path, PLAN.replace(*change))
    assert done.exit_code == 2
    assert message in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    assert not (tmp_path / "out" / "report.html").exists()


FITTED = {
    "schema": SCHEMA, "command": "impc fit", "made": "", "versions": {}, "files": [],
    "sha256": None, "outputs": ["theta1", "theta2"],
    "plant": {"name": "plants:seated_balance_for", "arguments": {"mass": 70.0, "height": 1.7}},
    "settings": {"u_max": 6.0, "horizon": 20, "body": "linear", "observer": None},
    "trials": [{"rms_residual": [1e-3, 2e-3]}, {"rms_residual": [1e-3, 4e-3]}],
    "K": GAIN,
}  # fmt: skip
LIKE = """
[plan]
perturbed = ["perturbation"]
amplitude = [4]
dwell = [0.25]
duration = 4.0
trials = 1
draws = 1
"""


def planned_like(folder: Path, fitted: dict[str, object], text: str = LIKE) -> Result:
    (folder / "fit").mkdir(exist_ok=True)
    (folder / "fit" / "result.json").write_text(json.dumps(fitted), encoding="utf-8")
    (folder / "plan.toml").write_text(text, encoding="utf-8")
    arguments = ("--like", str(folder / "fit"), "--out", str(folder / "out"))
    return run("plan", str(folder / "plan.toml"), *arguments)


def test_a_person_like_the_one_of_a_fit(tmp_path: Path) -> None:
    done = planned_like(tmp_path, FITTED)
    assert done.exit_code == 0, done.output
    found = json.loads((tmp_path / "out" / "result.json").read_text(encoding="utf-8"))
    assert found["K"] == GAIN
    page = html.unescape((tmp_path / "out" / "report.html").read_text(encoding="utf-8"))
    assert "seat tilt 0.0573°, trunk tilt 0.181°" in page  # roots of mean squares, in degrees
    other = [[1.1 * value for value in GAIN[0]]]
    own = LIKE.replace("[plan]", f"[plan]\ngain = {json.dumps(other)}")
    assert planned_like(tmp_path, FITTED, own).exit_code == 0
    found = json.loads((tmp_path / "out" / "result.json").read_text(encoding="utf-8"))
    assert found["K"] == other


def test_a_person_like_a_simulated_one(tmp_path: Path) -> None:
    out, text = (
        str(tmp_path / "person"),
        LIKE + 'noise = { theta1 = "0.1 deg", theta2 = "0.1 deg" }',
    )
    assert run("simulate", "seated-balance", "--out", out, "--trials", "1", "--duration", "2",
               "--formats", "csv", "--torque-limit", "5").exit_code == 0  # fmt: skip
    (tmp_path / "plan.toml").write_text(text, encoding="utf-8")
    ends = ("--plant", "seated-balance", "--like", out, "--out", str(tmp_path / "out"))
    done = run("plan", str(tmp_path / "plan.toml"), *ends)
    assert done.exit_code == 0, done.output
    found = json.loads((tmp_path / "out" / "result.json").read_text(encoding="utf-8"))
    assert found["K"] == json.loads((tmp_path / "person" / "truth.json").read_text("utf-8"))["K"]
    assert "5 N m" in (tmp_path / "out" / "report.html").read_text("utf-8").replace("\u00a0", " ")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"K": None}, "[plan] gain"),
        ({"trials": 1}, "has no subject"),
        ({"plant": {"name": "os:getcwd", "arguments": {}}}, "names code that would be run"),
    ],
)
def test_a_fit_that_gives_no_person_is_refused(
    tmp_path: Path, change: dict[str, object], message: str
) -> None:
    done = planned_like(tmp_path, {**FITTED, **change})
    assert done.exit_code == 2
    assert message in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


def test_a_plan_needs_a_plant(tmp_path: Path) -> None:
    (tmp_path / "plan.toml").write_text(PLAN, encoding="utf-8")
    done = run("plan", str(tmp_path / "plan.toml"))
    assert done.exit_code == 2
    assert "--plant" in done.stderr
