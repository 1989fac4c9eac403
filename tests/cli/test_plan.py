"""`impc plan` from its file to its page, as its users type it."""

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
from impc.files.formats import write_table
from impc.files.results import read_result
from impc.files.table import make_table

PLAN = """
[plant]
mass = 79.7
height = 1.66

[fit]
u_max = 6.0
body = "linear"

[fit.structure]
Q = "diagonal"
over = ["theta1", "theta2"]

[plan]
cost_weights = { theta1 = 6e3, theta2 = 9e3 }
noise = { theta1 = "0.05 deg", theta2 = "0.05 deg" }
correlation = 0.02
stops = { theta1 = "12 deg" }
perturbed = ["perturbation"]
amplitude = [2, 4]
dwell = [0.25]
duration = 8.0
trials = 1
draws = 2
"""


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
    assert "The best of 2 experiments, 1 trial of 8 s: 4 N m" in done.output
    return folder


def test_the_page_the_table_and_the_numbers_say_the_same(folder: Path) -> None:
    found = json.loads((folder / "out" / "result.json").read_text(encoding="utf-8"))
    table = pd.read_csv(folder / "out" / "experiments.csv")
    page = (folder / "out" / "report.html").read_text(encoding="utf-8")
    assert table["amplitude"].tolist() == [2, 4]
    assert found["best"] == {"amplitude": 4, "dwell": 0.25}
    errors = table["theta1_standard_error"]
    kept = found["findings"]["experiments"]["table"]["theta1_standard_error"]
    assert kept == pytest.approx(list(errors))
    # Twice the torque halves what noise adds, and not what is uncertain of the body.
    assert errors[0] / 2 < errors[1] < errors[0]
    weights = pd.read_csv(folder / "out" / "cost_weights.csv")
    assert np.all(weights["with_an_exact_body"] < weights["standard_error_of_the_logarithm"])
    body = pd.read_csv(folder / "out" / "body.csv").set_index("parameter")
    assert body.loc["tau_m", "stated_percent"] == pytest.approx(25)
    assert found["findings"]["body"]["table"]["theta1_narrower_percent"] == pytest.approx(
        list(body["theta1_narrower_percent"])
    )
    assert "Measuring " in " ".join(found["sentences"])
    text = html.unescape(re.sub("<[^>]*>", "", page))  # words link to what they mean
    for sentence in found["sentences"]:
        assert sentence in text
    assert read_result(folder / "out").content["best"] == found["best"]
    for name in ("cost_weights", "experiments"):
        assert (folder / "out" / f"{name}.png").stat().st_size > 10_000


EXACT = PLAN.replace("[fit]", "[plant.uncertainty]\nall = 0\n\n[fit]", 1)


def test_a_body_that_is_exact_is_said_to_be(tmp_path: Path) -> None:
    done = planned(tmp_path, EXACT)
    assert done.exit_code == 0, done.output
    assert "The body is taken as exact" in done.output
    # Twice the torque in a body that nothing stops: half the standard error.
    errors = pd.read_csv(tmp_path / "out" / "experiments.csv")["theta1_standard_error"]
    assert errors[1] == pytest.approx(errors[0] / 2, rel=1e-6)
    assert not (tmp_path / "out" / "body.csv").exists()


def test_an_interval_without_an_upper_end_is_infinite_not_a_large_number(tmp_path: Path) -> None:
    done = planned(tmp_path, PLAN.replace("0.05 deg", "100000 deg").replace("[2, 4]", "[2]"))
    assert done.exit_code == 0, done.output
    assert "says next to nothing of theta1" in done.output
    found = json.loads((tmp_path / "out" / "result.json").read_text("utf-8"))["findings"]
    (row,) = pd.read_csv(tmp_path / "out" / "experiments.csv").to_dict("records")
    assert found["experiments"]["table"]["theta1_high"] == [None]
    assert row["theta1_low"] == 0
    assert row["theta1_high"] == np.inf


def test_a_perturbation_from_a_file_is_scaled(folder: Path) -> None:
    time = np.arange(800) / 100
    push = np.where(np.floor(time * 4) % 3 == 0, 2.0, -1.0)
    write_table(folder / "push.csv", make_table("push", {"time": time, "motor": push}))
    signals = (
        '\n[recording]\ntime = "time"\n[signals.perturbation]\ncolumn = "motor"\nunit = "N*m"\n'
    )
    text = PLAN.replace("dwell = [0.25]", 'files = ["push.csv"]').replace(
        "amplitude = [2, 4]", "amplitude = [1, 2]"
    )
    done = planned(folder, text + signals, "file")
    assert done.exit_code == 0, done.output
    assert "the recorded perturbation times 2" in done.output
    found = json.loads((folder / "file" / "result.json").read_text(encoding="utf-8"))
    table = found["findings"]["experiments"]["table"]
    assert table["amplitude"] == [1, 2]
    assert table["dwell"] == [None, None]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (('perturbed = ["perturbation"]', ""), "[plan] perturbed: names no input of the plant"),
        (("amplitude = [2, 4]", "amplitude = [90]"), "falls in 100 % of the trials or more"),
        (('"0.05 deg", theta2', '"0.05 kg", theta2'), "noise theta1: is in kg"),
        (('"0.05 deg", theta2', '"deg", theta2'), "noise theta1: got deg"),
        (("theta1 = 6e3, ", ""), "[plan] cost_weights: lacks 'theta1'"),
        (("theta1 = 6e3", "theta1 = 0"), "cost_weights theta1: got 0"),
        (("theta1 = 6e3", "angle = 1, theta1 = 6e3"), "cost_weights angle: is not a feature"),
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
