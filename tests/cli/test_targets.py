"""`impc fit` of targets, recorded commands, gaps, offsets and observers, from files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import control
import numpy as np
import pytest
from click.testing import CliRunner

import impc
from impc.arrays import Array
from impc.cli.main import main
from impc.cli.plant import asked_subject, read_subject
from impc.files.configuration import read_configuration
from impc.files.reading import read_recordings, require_whole
from impc.studies.fit.asked import fit_problem
from impc.studies.fit.settings import FitSettings

SAMPLES, RATE, OFFSET = 151, 1.5, 0.02
CART = """
import control

def cart(drag=0.3):
    system = control.ss([[1, 0.1], [-0.02, 1 - 0.1 * drag]], [[0, 0], [0.1, 0.1]],
                        [[1, 0], [0, 1]], 0, 0.1,
                        states=["x", "v"], inputs=["push", "wind"], outputs=["x", "v"])
    system.units = {"x": "m", "v": "m/s", "push": "N", "wind": "N"}
    return system
"""
SETTINGS = """
[recording]
time = "t"
keep_gaps = true
[signals.x]
column = "pos"
unit = "cm"
target = "goal"
[signals.v]
column = "vel"
unit = "m/s"
[signals.wind]
column = "gust"
unit = "N"
[signals.push]
column = "force"
unit = "N"
command = true
[fit]
horizon = 10
u_max = 0.8
intent_draws = false
methods = []
observer_rate = 0.8
free = ["observer_rate"]
offsets = ["x"]
"""


def cart() -> impc.Plant:
    system = control.ss([[1, 0.1], [-0.02, 0.97]], [[0, 0], [0.1, 0.1]], np.eye(2), 0, 0.1,
                        states=["x", "v"], inputs=["push", "wind"],
                        outputs=["x", "v"])  # fmt: skip
    return impc.Plant(system, ["push"])


def columns(law: impc.Controller, start: list[float]) -> dict[str, Array]:
    """A recorded trial in cm with noise, an offset and empty cells."""
    rng, wind = np.random.default_rng(1), 0.3 + 0.1 * np.sin(np.arange(SAMPLES) / 7)
    goal = 0.3 * np.cumsum((rng.random(SAMPLES) < 0.1) * rng.normal(size=SAMPLES))
    run = law.simulate(start, disturbance=wind[:-1], target={"x": goal})
    noise = 0.002 * rng.normal(size=(3, SAMPLES))
    last = run.x[1:, 2] if law.plant.commands else run.u[:, 0]
    pos = 100 * (run.x[:, 0] + OFFSET + noise[0])
    pos[4::9] = np.nan
    force = np.append(last, last[-1]) + noise[2]
    t = 0.1 * np.arange(SAMPLES)
    return {"t": t, "pos": pos, "vel": run.x[:, 1] + noise[1], "gust": wind, "goal": 100 * goal,
            "force": force}  # fmt: skip


def written(folder: Path, table: dict[str, Array], text: str = SETTINGS) -> tuple[Path, Path]:
    (folder / "lab.toml").write_text(text)
    (folder / "tracked_cart.py").write_text(CART)
    rows = [",".join(table)]
    for row in zip(*table.values(), strict=True):
        rows.append(",".join("" if np.isnan(value) else f"{value:.9f}" for value in row))
    (folder / "trial.csv").write_text("\n".join(rows) + "\n")
    return folder / "trial.csv", folder / "lab.toml"


@pytest.fixture(scope="module")
def law() -> impc.Controller:
    plant = impc.with_observer(cart(), RATE)
    bounds = impc.Bounds(plant, u_min=-0.8, u_max=0.8)
    return impc.Controller(
        plant, impc.Weights(np.diag([4.0, 0.3]), 1), bounds, 10, terminal_set=False
    )


@pytest.mark.usefixtures("blank_figures")
def test_a_tracked_target_with_all_of_it(
    law: impc.Controller, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    trial, config = written(tmp_path, columns(law, [0.5, 0.0]))
    done = CliRunner().invoke(main, ["fit", str(trial), "--plant", "tracked_cart:cart", "--config",
                                     str(config), "--out", "out"])  # fmt: skip
    assert done.exit_code == 0, done.stderr
    found: dict[str, Any] = json.loads(Path("out/result.json").read_text())
    assert found["failures"] == {}
    assert found["K"][0] == pytest.approx(law.K[0], rel=0.02)
    aim = found["aim"]
    assert aim["targets"] == ["x"]
    assert aim["commands"] == ["push"]
    assert aim["observer_rate"]["wind"] == pytest.approx(RATE, rel=0.05)
    (error,) = aim["errors"]
    assert (error["kind"], error["signal"]) == ("offset", "x")
    assert error["values"] == pytest.approx([OFFSET], abs=0.002)
    assert found["findings"]["signal_errors"]["table"]["unit"] == ["m"]
    assert found["trials"][0]["missing"] == 17
    page = Path("out/report.html").read_text().replace("\u00a0", " ")
    assert "regulates to the target of x; it assumes that the wind persists and learns it" in page
    assert "at a rate of 1." in page
    assert "(fitted, 95 %: 1." in page
    assert "the x has an offset in each trial, 0.0" in page
    assert "recorded commands (push) are fitted in addition to the outputs." in page
    assert "17 of 151 samples are missing or not finite" in page
    assert "11 % count as not measured" in page


def test_rates_and_preview_make_the_plant(law: impc.Controller, tmp_path: Path) -> None:
    text = SETTINGS.replace('free = ["observer_rate"]', "rates = { push = 0.2 }\npreview = 3")
    text = text.replace("observer_rate = 0.8", "observer_rate = { wind = inf }")
    trial, config = written(tmp_path, columns(law, [0.5, 0.0]), text)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path)
        problem = read_subject(asked_subject("fit", [trial], "tracked_cart:cart", config)).problem
    plant = problem.plant
    assert plant.states == ("x", "v", "push", "x step 1", "x step 2", "x step 3")
    assert plant.observer[0] == np.inf
    assert problem.bounds.x_max[:3].tolist() == [np.inf, np.inf, 0.8]
    assert problem.bounds.u_max.tolist() == [0.2]
    force = np.loadtxt(trial, delimiter=",", skiprows=1, usecols=5)
    assert problem.recordings[0].commands[1:-1, 0] == pytest.approx(np.diff(force)[:-1], abs=1e-8)
    assert problem.recordings[0].target[:, 0] == pytest.approx(columns(law, [0.5, 0])["goal"] / 100)


def test_targets_are_held_and_gaps_stay_at_another_rate(tmp_path: Path) -> None:
    t = np.arange(0, 12, 0.02)
    pos = 100 * np.sin(t)
    table = {"t": t, "pos": pos, "vel": np.cos(t), "gust": np.sign(np.sin(3 * t)),
             "goal": np.where(t < 1.03, 0.0, 5.0), "force": np.cos(2 * t)}  # fmt: skip
    table["pos"] = np.where((t > 5.0) & (t < 5.5) | (t > 11.7), np.nan, pos)
    trial, config = written(
        tmp_path, table, SETTINGS.replace("[signals.v]", "offset = 1\n[signals.v]")
    )
    found = read_recordings([trial], read_configuration(config), cart())[0]
    at = 0.1 * np.arange(found.samples)
    assert found.target[:, 0] == pytest.approx(np.where(at < 1.05, -0.01, 0.04))
    lost = np.isnan(found.outputs[:, 0])
    assert lost[51:55].all()
    assert lost[-2:].all()
    assert np.isfinite(found.outputs[:, 0])[(at < 4.75) | (at > 5.75) & (at < 11.45)].all()
    assert found.outputs[~lost, 0] == pytest.approx(np.sin(at[~lost]) - 0.01, abs=0.01)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        (
            'column = "gust"',
            'column = "gust"\ntarget = 1.0',
            "wind.target: is allowed for outputs only",
        ),
        ('"goal"', '"gaol"', "signals.x.target may be"),
        ('"goal"', '"pos"', "at an end|samples are missing"),
        ("keep_gaps = true", "", "or set recording.keep_gaps = true"),
        ('column = "pos"', 'column = "half"', "at most half of a signal may be missing"),
        ('target = "goal"', "", "preview: needs an output with a target"),
        ("rate = 0.8", "rate = { gust = 1 }", "observer_rate.gust: is not a disturbance"),
        ("observer_rate = 0.8", "", "free observer_rate: has no nominal value"),
        ("rate = 0.8", "rate = -1.0", "observer_rate: got -1.0; give at least 0"),
        ('["x"]', '["y"]', "no output is named 'y'; choose from: x, v"),
        ('["x"]', '["x", "x"]', "offsets: contains x twice"),
        ("[fit]", "[fit]\nrates = { pull = 1.0 }", "rates pull: is not a command"),
        ('[signals.wind]\ncolumn = "gust"\nunit = "N"\n', "", "needs a recorded disturbance"),
    ],
)
def test_what_cannot_be(
    law: impc.Controller,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    old: str,
    new: str,
    says: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    table = columns(law, [0.5, 0.0])
    table["half"] = np.where(np.arange(SAMPLES) % 3 == 0, table["vel"], np.nan)
    text = SETTINGS + "preview = 2\n"
    assert old in text
    trial, config = written(tmp_path, table, text.replace(old, new))
    with pytest.raises(impc.ImpcError, match=says):
        read_subject(asked_subject("fit", [trial], "tracked_cart:cart", config))


def test_gaps_and_settings_are_refused_where_nothing_knows_them() -> None:
    plant, y = cart(), np.ones((30, 2))
    y[3] = np.nan
    trial = impc.Recording(plant, y)
    with pytest.raises(impc.InputError, match="impc reliability needs every sample"):
        require_whole([trial], "reliability")
    for settings in (FitSettings(rates=True), FitSettings(preview=2), FitSettings(observer_rate=1)):
        with pytest.raises(impc.InputError, match="is set, but the plant was made without it"):
            fit_problem(plant, [trial], settings)
