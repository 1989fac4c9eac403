"""`impc fit` of a user-defined optimal control problem, on the command line."""

from __future__ import annotations

import html
import importlib
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner, Result

import impc
from impc.cli.main import main
from impc.files.results import read_result
from impc.nonlinear.problem import OptimalControlProblem

pytestmark = pytest.mark.full

MODULE = '''
"""A point with drag that is pushed to the origin; its force is limited."""

import casadi as ca
import impc

def point(fault="", horizon=12):
    x = ca.vertcat(ca.SX.sym("place"), ca.SX.sym("speed"))
    u, d = ca.SX.sym("force"), ca.SX.sym("push")
    names = ["mass", "drag", "price", "limit", "far"]
    p = {name: ca.SX.sym(name) for name in names}
    cost = p["price"] * x[0] ** 2 + u**2
    following = x + 0.1 * ca.vertcat(x[1], (u + d - p["drag"] * x[1] * ca.fabs(x[1])) / p["mass"])
    rows = {"force": ca.vertcat(u - p["limit"], -u - p["limit"]), "place": x[0] - p["far"]}
    if fault == "text":
        return "no problem"
    if fault == "raises":
        raise RuntimeError("the sensor is\\nbroken")
    return impc.OptimalControlProblem(
        x, u, p, following, cost, horizon, constraints=rows, disturbances=d, dt=0.1,
        units={"mass": "kg", "drag": "kg/m", "limit": "N", "far": "m", "place": "m",
               "speed": "m/s", "force": "N", "push": "N"},
    )
'''

CONFIG = """
[recording]
time = "t"

[signals.place]
column = "position"
unit = "cm"

[signals.force]
column = "motor"
unit = "N"

[signals.push]
column = "wind"
unit = "N"

[fit]
recorded = "loop"
x0 = { speed = 0.5 }

[fit.parameters]
mass = { known = 1500.0, unit = "gram" }
drag = { start = 0.5 }
price = { start = 8.0 }
limit = { start = 0.9, unit = "N" }
far = { start = 30.0 }
"""
TRUTH = {"mass": 1.5, "drag": 0.3, "price": 5.0, "limit": 0.8, "far": 20.0}


def run(*arguments: str) -> Result:
    return CliRunner().invoke(main, [*arguments, "--plant", "own_point:point"])


def own_problem() -> OptimalControlProblem:
    problem: OptimalControlProblem = importlib.import_module("own_point").point()
    return problem


def write_trial(path: Path, place: Any, force: Any, push: Any) -> None:
    table = {
        "t": 0.1 * np.arange(len(place)),
        "position": 100 * np.asarray(place),
        "motor": [*np.ravel(force), np.nan],
        "wind": [*np.ravel(push), 0.0],
    }
    pd.DataFrame(table).to_csv(path, index=False)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Two recordings of a closed loop without the speed, one with a gap."""
    folder = tmp_path_factory.mktemp("optimal")
    (folder / "own_point.py").write_text(MODULE, encoding="utf-8")
    (folder / "point.toml").write_text(CONFIG, encoding="utf-8")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.syspath_prepend(str(folder))
        problem = own_problem()
        for index, x0 in enumerate(([1.0, 0.5], [-0.8, 0.5])):
            push = 0.3 * np.sin(np.arange(25.0) + index)[:, None]
            loop = problem.closed_loop(TRUTH, x0, 25, d=push)
            place = loop.x[:, 0].copy()
            if index:
                place[7:9] = np.nan
            write_trial(folder / f"trial_{index + 1}.csv", place, loop.u, push)
        yield folder
    sys.modules.pop("own_point", None)


def fitted(folder: Path, config: str, out: str, *options: str) -> Result:
    (folder / f"{out}.toml").write_text(config, encoding="utf-8")
    trials = "trial_1.csv", "trial_2.csv"
    return run("fit", *trials, "--config", f"{out}.toml", "--out", out, *options)


@pytest.fixture(scope="module")
def done(folder: Path) -> Result:
    opened: list[str] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("click.launch", opened.append)
        done = fitted(folder, CONFIG, "out", "--open")
    assert done.exit_code == 0, done.stderr
    assert opened == [str(Path("out", "report.html"))]
    return done


def test_the_parameters_are_those_that_made_the_recordings(folder: Path, done: Result) -> None:
    result = read_result(folder / "out")
    found, table = result.content, result.table("parameters").set_index("parameter")
    for name in ("drag", "price", "limit"):
        one = table.loc[name]
        assert one["value"] == pytest.approx(TRUTH[name], rel=1e-5)
        assert one["low"] <= one["value"] <= one["high"]
        assert one["identified"] == "yes"
    assert dict(table.loc["mass"].dropna()) == {"unit": "kg", "value": 1.5, "identified": "known"}
    assert table.loc["far", "identified"] == "no"
    assert table["high"].isna()["far"]
    assert found["combinations"]["unidentified"][0]["exponents"] == {"far": 1.0}
    np.testing.assert_allclose(found["x0"], [[1.0, 0.5], [-0.8, 0.5]], atol=1e-5)
    limits = pd.read_csv(folder / "out" / "limits.csv").set_index("constraint")["at_its_limit"]
    assert limits["force"] > 5
    assert limits["place"] == 0
    assert found["problem"]["dt"] == 0.1
    assert found["methods"]["nonlinear_inverse_mpc"]["vaf"]["place"] == pytest.approx(100)
    assert found["methods"]["nonlinear_inverse_mpc"]["vaf"]["speed"] is None
    samples, recorded = pd.read_csv(folder / "out/trajectories.csv"), pd.read_csv("trial_2.csv")
    own = samples[samples["trial"] == samples["trial"].unique()[1]].reset_index(drop=True)
    np.testing.assert_allclose(own["time"], recorded["t"], atol=1e-12)
    np.testing.assert_allclose(own["place_recorded"], recorded["position"] / 100, rtol=1e-12)
    assert own["speed_recorded"].isna().all()
    kept = own["place_recorded"].notna()
    np.testing.assert_allclose(own["place_simulated"][kept], own["place_recorded"][kept], atol=1e-6)
    np.testing.assert_allclose(own["force_simulated"][:-1], recorded["motor"][:-1], atol=1e-5)
    assert (folder / "out" / "figures" / "movement.svg").stat().st_size > 5_000


def test_page_tables_terminal_and_numbers_say_the_same(folder: Path, done: Result) -> None:
    out = folder / "out"
    found = read_result(out)
    assert found.methods["nonlinear_inverse_mpc"].status in {"explained", "settled"}
    page = html.unescape(re.sub("<[^>]*>", "", (out / "report.html").read_text("utf-8")))
    page = page.replace("\u00a0", " ")
    verdict = found.content["verdict"]
    assert verdict["level"] == "amber"
    assert verdict["headline"].endswith("but far cannot be determined.")
    for sentence in (verdict["headline"], verdict["alerts"][0]["found"]):
        assert sentence in page
        assert sentence in done.stdout.replace("\n  ", " ")
    assert "far is not identified: near its value it affects nothing that was measured." in page
    results = page.partition("Copy for your paper")[2]
    assert "mass" in results  # amber: what may be reported can be copied, and nothing else
    assert not re.search(r"\bfar [\d.]+ \(95 % CI", results)
    table = pd.read_csv(out / "parameters.csv").set_index("parameter")
    kept = found.table("parameters").set_index("parameter")
    np.testing.assert_array_equal(table["value"], kept["value"])
    assert list(table["identified"]) == list(kept["identified"])
    assert table.loc["mass", "unit"] == "kg"
    assert "2 samples are missing, the first sample 8 (0.7 s); they count as not measured" in page


def test_one_plan_by_another_solver(folder: Path, done: Result) -> None:
    """The same report from a single plan; the command line names the solver."""
    problem = own_problem().with_horizon(25)
    plan = problem.plan(TRUTH, [1.0, 0.5])
    write_trial(folder / "plan.csv", plan.x[:, 0], plan.u, np.zeros(25))
    text = CONFIG.replace('"loop"', '"plan"\nhorizon = 25\nunknown_start = false')
    (folder / "plan.toml").write_text(text, encoding="utf-8")
    given = ("plan.csv", "--config", "plan.toml", "--solver", "fatrop", "--out", "plan-out")
    identified = run("fit", *given)
    assert identified.exit_code == 0, identified.stderr
    found = read_result(folder / "plan-out")
    assert "--solver fatrop" in found.command
    assert found.content["settings"]["solver"] == "fatrop"
    for name in ("drag", "price", "limit"):
        values = found.table("parameters").set_index("parameter")["value"]
        assert values[name] == pytest.approx(TRUTH[name], rel=1e-4)
    assert "but far cannot be determined" in identified.stdout


def test_the_same_page_from_python(folder: Path, done: Result, tmp_path: Path) -> None:
    problem = own_problem().with_known({"mass": 1.5, "far": 20.0})
    plan = problem.plan({name: TRUTH[name] for name in ("drag", "price", "limit")}, [1.0, 0.5])
    start = {"drag": 0.5, "price": 8.0, "limit": 0.9}
    found = impc.fit_optimal_control(problem, [problem.recorded_plan(plan.x, plan.u)], start)
    names = {path.name for path in impc.report(found, tmp_path)}
    ours = {path.name for path in (folder / "out").iterdir() if path.is_file()}
    assert names == (ours - {".impc", "configuration.toml"}) | {"movement.svg"}
    content = read_result(tmp_path).content
    assert content["verdict"]["level"] == "amber"  # one recording: nothing is left to check it
    assert content["verdict"]["alerts"][0]["title"] == "One recording cannot check itself"
    assert any("recording was left out" in one for one in content["verdict"]["may_not_report"])
    page = (tmp_path / "report.html").read_text("utf-8")
    assert "was fitted to 1 recording by nonlinear least squares" in page.replace("\u00a0", " ")
    assert content["findings"]["parameters"]["table"]["start"][0] == 0.5
    with pytest.raises(impc.InputError, match="estimate: expected a Estimate, got dict of 3"):
        impc.report(start, tmp_path)  # type: ignore[arg-type]


def fault(name: str) -> tuple[str, str]:
    return "[fit]", f'[plant]\nfault = "{name}"\n[fit]'


WRONG: dict[str, tuple[tuple[str, str], str]] = {
    "a function that fails": (
        fault("raises"), "plant own_point:point: raised RuntimeError (the sensor is\\nbroken)"
    ),
    "no such solver": (
        ('recorded = "loop"', 'solver = "snopt"'), "solver: got 'snopt'; choose one of ipopt, "
    ),
    "a plan of another length": (
        ('"loop"', '"plan"'), "states: has 26 samples; give 13"
    ),
    "no horizon": (
        ('recorded = "loop"', "horizon = 0"), "horizon: got 0; give a whole number of at least 1 "
    ),
    "no evaluations": (
        ('recorded = "loop"', "evaluations = 0"), "[fit] evaluations: got 0; give at least 1"
    ),
    "no start": (('recorded = "loop"', "starts = 0"), "[fit] starts: got 0; give at least 1"),
    "a setting of the linear fit": (
        ('recorded = "loop"', "u_max = 3.0"), "[fit] u_max: is not a setting; known: parameters"
    ),
    "a kind that is none": (
        ('"loop"', '"walk"'), "[fit] recorded: Invalid enum value 'walk'; give loop or plan"
    ),
    "a parameter without a word": (
        ("drag = { start = 0.5 }", ""), "[fit.parameters] drag: is missing; give it start or known"
    ),
    "a parameter that is not there": (
        ("[fit.parameters]", "[fit.parameters]\ncolor = { start = 1.0 }"),
        "[fit.parameters] color: is no parameter of the problem; it has mass, drag, price",
    ),
    "both": (
        ("start = 0.5", "start = 0.5, known = 0.5"), "drag: has both start and known; write { start"
    ),
    "no number": (("start = 0.5", 'unit = "kg/m"'), "drag: needs start or known; write { start ="),
    "a bare number": (
        ("{ start = 0.5 }", "0.5"), "drag: Expected 'object', got 'float'; write {"
    ),
    "a misspelt key": (("start = 0.5", "begin = 0.5"), "drag begin: is not a setting; write {"),
    "not filled in": (("start = 0.5", 'start = "?"'), "drag start: Expected 'float | null'"),
    "another kind of unit": (
        ('"gram"', '"cm"'), "mass.unit: is 'cm', but the problem has kg; correct the unit"
    ),
    "all are known": (
        (CONFIG[CONFIG.index("drag =") :],
         "".join(f"{name} = {{ known = 1.0 }}\n" for name in ("drag", "price", "limit", "far"))),
        "parameters: are all known; leave at least one to be estimated",
    ),
    "no initial state": (
        ("speed = 0.5", ""), "[fit.x0] speed: is missing, and was not recorded; set it; a guess"
    ),
    "an initial state of nothing": (
        ("speed = 0.5", "pace = 0.5"), "[fit.x0] pace: is no state of the problem; it has pl"
    ),
    "a signal that is not there": (
        ("[signals.force]", "[signals.forse]"),
        "signals.forse: is no signal of the problem; did you mean force?",
    ),
    "a signal in another kind of unit": (
        ('unit = "cm"', 'unit = "deg"'), "signals.place.unit: is 'deg', but the plant has place in"
    ),
    "no disturbance": (
        ('[signals.push]\ncolumn = "wind"\nunit = "N"', ""),
        "signals.push: is missing; record every disturbance",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_bad_input_ends_in_one_line_and_nothing_is_written(folder: Path, case: str) -> None:
    (old, new), words = WRONG[case]
    assert old in CONFIG
    done = fitted(folder, CONFIG.replace(old, new), "wrong")
    assert done.exit_code == 2
    (line,) = done.stderr.strip().splitlines()
    assert words in line
    assert not (folder / "wrong").exists()


def test_commands_for_linear_plants_say_that_they_are(folder: Path) -> None:
    (folder / "compare.toml").write_text(CONFIG[: CONFIG.index("[fit]")], encoding="utf-8")
    done = run("compare", "trial_1.csv", "--config", "compare.toml", "--out", "wrong")
    assert done.exit_code == 2
    assert "plant own_point:point: is an optimal control problem; use `impc fit`" in done.stderr
