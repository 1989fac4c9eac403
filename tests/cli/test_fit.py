"""`impc simulate` and `impc fit` from files to files."""

from __future__ import annotations

import html
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import openpyxl
import pandas as pd
import pytest
from click.testing import CliRunner, Result

from impc.checking import replace
from impc.cli.main import main
from impc.cli.plant import asked_subject
from impc.files.configuration import read_configuration
from impc.files.plant_sources import make_plant, plant_source
from impc.files.reading import read_recordings
from impc.files.results import read_result, results
from impc.studies.fit.asked import asked_plant, fit_problem
from impc.studies.fit.settings import fit_settings
from impc.studies.fit.subject import fit_recordings
from plants import seated_parameters_for
from tests.support import easier_seat

ROOT, WHOLE = Path(__file__).parents[2], "With limit, inverse MPC"
OWN_PLANT = """
import control

def cart(mass=1.0):
    system = control.ss([[0, 1], [0.5, -0.3]], [[0, 0], [1 / mass, 1]], [[1, 0]], 0,
                        states=["=1+1", "$\\\\alpha"], inputs=["$\\\\frac{F}$ <i>", "push"],
                        outputs=["position"])
    return control.c2d(system, 0.05)
"""


def run(*arguments: str) -> Result:
    return CliRunner().invoke(main, list(arguments))


@pytest.fixture(scope="module")
def subject(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("subject")
    done = run("simulate", "seated-balance", "--out", str(folder), "--duration", "6")
    assert done.exit_code == 0, done.stderr
    return folder


@pytest.fixture(scope="module")
def quick(subject: Path) -> Path:
    """Settings for a fit in 5 % of the time: fewer states, shorter horizon, no draws."""
    text = easier_seat((subject / "subject.toml").read_text(encoding="utf-8"))
    path = subject / "quick.toml"
    path.write_text(text.replace("[fit]", "[fit]\nintent_draws = false"), encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def fitted(subject: Path, quick: Path) -> tuple[Result, Path]:
    out = subject / "fit"
    files = [str(subject / f"trial_{number}.csv") for number in (1, 2, 3)]
    done = run("fit", *files, "--plant", "seated-balance", "--config", str(quick),
               "--out", str(out))  # fmt: skip
    assert done.exit_code == 0, done.stderr
    return done, out


def test_the_subject_is_written_in_every_format(subject: Path) -> None:
    names = {path.name for path in subject.iterdir() if path.is_file()}
    for number in (1, 2, 3):
        for ending in (".csv", ".tsv", ".xlsx", ".mat", ".tdms", ".c3d"):
            assert f"trial_{number}{ending}" in names
    truth = json.loads((subject / "truth.json").read_text())
    assert np.array(truth["K"]).shape == (1, 10)
    configuration = read_configuration(subject / "subject.toml")
    source = plant_source("plants:seated_balance_for", configuration.plant)
    plant = make_plant(source, configuration.recorded)
    first = read_recordings([subject / "trial_1.csv"], configuration, plant)[0]
    for ending in (".tsv", ".xlsx", ".mat", ".tdms", ".c3d"):
        other = read_recordings([subject / f"trial_1{ending}"], configuration, plant)[0]
        np.testing.assert_allclose(other.outputs, first.outputs, atol=1e-7)
        np.testing.assert_allclose(other.disturbance, first.disturbance, atol=1e-6)


def test_the_same_seed_gives_the_same_bytes(subject: Path, tmp_path: Path) -> None:
    again = run("simulate", "seated-balance", "--out", str(tmp_path), "--duration", "6",
                "--formats", "csv,mat")  # fmt: skip
    assert again.exit_code == 0
    names = ("trial_2.csv", "subject.toml")
    for name in names:
        assert (tmp_path / name).read_bytes() == (subject / name).read_bytes()
    assert not (tmp_path / "trial_1.tdms").exists()


def test_a_person_who_senses_with_noise_is_simulated_and_asked_for(tmp_path: Path) -> None:
    done = run("simulate", "seated-balance", "--out", str(tmp_path), "--duration", "6",
               "--formats", "csv", "--observer", "--unknown-perturbation")  # fmt: skip
    assert done.exit_code == 0, done.stderr
    configuration = read_configuration(tmp_path / "subject.toml")
    asked = fit_settings(configuration.fit).observer
    assert asked is not None
    assert asked.sensed == ["theta1", "theta2", "theta1_rate", "theta2_rate"]
    assert not asked.known
    structure = fit_settings(configuration.fit).structure
    assert structure is not None
    assert structure.over == asked.sensed
    assert json.loads((tmp_path / "truth.json").read_text())["settings"]["observer"] is True


@pytest.mark.full
def test_result_json_is_the_fit(fitted: tuple[Result, Path], subject: Path, quick: Path) -> None:
    """Compare with a fit of the same files in Python."""
    found = json.loads((fitted[1] / "result.json").read_text())
    configuration = read_configuration(quick)
    source = plant_source("plants:seated_balance_for", configuration.plant)
    plant, family = asked_plant(
        source, configuration.recorded, fit_settings(configuration.fit), configuration.aimed
    )
    files = [subject / f"trial_{number}.csv" for number in (1, 2, 3)]
    recordings = read_recordings(files, configuration, plant)
    settings = replace(fit_settings(configuration.fit), held_out=False)
    result = fit_recordings(fit_problem(plant, recordings, settings, family), settings)
    np.testing.assert_allclose(found["K"], result.estimate.K, rtol=1e-6)
    np.testing.assert_allclose(found["weights_gain"], result.fitted.gain, rtol=1e-6)
    assert found["horizon"] == 4
    assert found["bounds"]["u_max"] == [6.0]
    assert found["bounds"]["x_max"] == [None] * 6
    for index, name in enumerate(("theta1", "theta2")):
        assert found["vaf"][name] == pytest.approx(result.inverse_mpc.vaf[index])
        assert found["vaf"][name] > 99.5
        assert found["methods"]["inverse_lqr_output"]["vaf"][name] < found["vaf"][name]
    Q, R, P = (np.array(found[key]) for key in "QRP")
    A, B = np.array(found["plant"]["A"]), np.array(found["plant"]["B"])
    K = np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
    there = np.array(found["weights_gain"])
    np.testing.assert_allclose(K, there, rtol=1e-6, atol=1e-6 * np.max(np.abs(K)))
    np.testing.assert_allclose(
        P, A.T @ P @ A - A.T @ P @ B @ K + Q, atol=1e-7 * float(np.max(np.abs(P)))
    )
    values = found["intent"]["eigenvalues"]
    np.testing.assert_allclose(values, np.linalg.eigvalsh(Q), rtol=1e-6, atol=1e-9 * values[-1])
    assert abs(np.dot(found["intent"]["dominant"], found["intent"]["vectors"])[-1]) > 1 - 1e-9
    assert found["identifiability"]["rank"] == result.identifiability.rank
    assert [trial["trial"] for trial in found["trials"]] == ["1", "2", "3"]


def test_the_configuration_alone_suffices(
    fitted: tuple[Result, Path], subject: Path, quick: Path, tmp_path: Path
) -> None:
    """The same result as by FILES and --plant, though the recordings are links elsewhere."""
    for name in ("trial_1.csv", "trial_2.csv", "trial_3.csv", "truth.json"):
        (tmp_path / name).symlink_to(subject / name)
    shutil.copy(quick, tmp_path)
    done = run("fit", "--config", str(tmp_path / quick.name), "--out", str(tmp_path / "fit"))
    assert done.exit_code == 0, done.stderr
    folders = fitted[1], tmp_path / "fit"
    by_hand, alone = ((folder / "result.json").read_text() for folder in folders)
    assert json.loads(alone)["command"] == "impc fit --config quick.toml"
    files = "trial_1.csv trial_2.csv trial_3.csv"
    typed = f"impc fit {files} --plant seated-balance --config quick.toml"
    assert json.loads(by_hand)["command"] == typed
    for name in ("command", "made", "seconds"):  # text or number, or a list of numbers
        each = rf'"{name}": ("[^"]*"|\[[^]]*\]|[^,\s]*)'
        by_hand, alone = (re.sub(each, "", text) for text in (by_hand, alone))
    assert alone.replace(str(tmp_path), str(subject)) == by_hand


def test_the_end_of_the_input_is_an_interruption(quick: Path, tmp_path: Path) -> None:
    """Input itself is not; the same command continues, and says which stages it found."""
    words = [sys.executable, "-m", "impc", "fit", "--config", str(quick), "--out", str(tmp_path)]
    environment = os.environ | {"PYTHONPATH": str(ROOT), "IMPC_PROGRESS": "json"}

    def stages(lines: Iterable[str]) -> Iterator[dict[str, Any]]:
        return (json.loads(line) for line in lines if line.startswith("{"))

    with subprocess.Popen(
        words, env=environment | {"IMPC_STOP_WITH_INPUT": "1"}, stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
    ) as first:  # fmt: skip
        assert first.stdin is not None
        assert first.stderr is not None
        first.stdin.write("no end\n")
        first.stdin.flush()
        begun = [one["title"] for one, _ in zip(stages(first.stderr), range(2), strict=False)]
        first.stdin.close()
        rest = first.stderr.read()
    assert (first.returncode, begun) == (130, ["", WHOLE])
    assert rest.count(WHOLE) == rest.count("the same command continues") == 1
    assert {path.name for path in tmp_path.iterdir()} == {".impc", "fit-in-progress"}
    again = subprocess.run(words, env=environment, capture_output=True, text=True, check=True)
    done = [*stages(again.stderr.splitlines())]
    assert [one["done"] for one in done] == list(range(done[0]["total"] + 1))
    assert {one["title"]: one["found"] for one in done}[WHOLE]
    assert (done[-1]["title"], done[-1]["found"]) == ("report and figures", False)
    assert (tmp_path / "report.html").exists()
    assert not (tmp_path / "fit-in-progress").exists()


def test_fits_of_a_folder_are_a_table(fitted: tuple[Result, Path], tmp_path: Path) -> None:
    """What is no fit is named, and nothing of other people runs; test_verdict.py has the gains."""
    found = json.loads((fitted[1] / "result.json").read_text())
    unit = read_result(fitted[1]).table("gain_per_unit")["for_every"]
    other = found | {"made": "1999", "summary": found["summary"] | {"subject": "=1+1\x1b[31m"}}
    for name, content in {"new": found, "old": other, "b/c": [1]}.items():
        (tmp_path / name).mkdir(parents=True)
        (tmp_path / name / "result.json").write_text(json.dumps(content))
    table = results(tmp_path)
    assert table["folder"].tolist() == ["new", "old", "b/c"]
    first = table.iloc[0]
    assert (first["subject"], first["trials"], first["limit"]) == ("simulated", 3, 6.0)
    assert first["headline"] == found["verdict"]["headline"]
    assert first["vaf.theta2"] == found["vaf"]["theta2"]
    assert first[f"gain.{found['controls'][0]}.theta1_unit"] == f"N m for {unit[0]}"
    words = "results", str(tmp_path), "--out", str(tmp_path / "all.xlsx")
    done = run(*words)
    assert (done.exit_code, done.stderr.partition(":")[0]) == (0, "b/c")
    assert "\x1b" not in done.output
    assert max(map(len, done.stdout.splitlines())) <= 100
    book = openpyxl.load_workbook(tmp_path / "all.xlsx")
    (heads, _, fit, *_), (made, origin, _) = (book[name].values for name in ("fits", "provenance"))
    assert dict(zip(heads, fit, strict=True))["subject"] == r"'=1+1\x1b[31m"
    assert dict(zip(made, origin, strict=True))["sha256 all"] == found["sha256"]["all"]
    assert "already exists" in run(*words).stderr
    assert "no result.json" in run("results", str(tmp_path / "none")).stderr


def test_a_subject_who_falls_in_every_trial_is_a_result(subject: Path, tmp_path: Path) -> None:
    lines = (subject / "trial_1.csv").read_text().splitlines()
    for row in range(-200, 0):  # the last 0.2 s
        time, angle, rest = lines[row].split(",", 2)
        lines[row] = f"{time},{float(angle) + 25 * (row / 200 + 1) ** 2},{rest}"
    (tmp_path / "trial_1.csv").write_text("\n".join(lines))
    text = (subject / "subject.toml").read_text().replace(', "trial_2.csv", "trial_3.csv"', "")
    (tmp_path / "subject.toml").write_text(text)
    words = "--config", str(tmp_path / "subject.toml"), "--out"
    assert run("fit", *words, str(tmp_path / "fit")).exit_code == 0
    (found,) = results(tmp_path).to_dict("records")
    assert (found["trials"], found["verdict"], found["note"]) == (0, "red", "")
    assert found["reason"] == found["headline"] == "The person fell in every trial."
    compared = run("compare", *words, str(tmp_path / "compare"))
    assert compared.exit_code == 2
    assert compared.stderr.startswith("impc: error: recordings: end in a fall: ")


def test_the_page_says_what_the_numbers_say(fitted: tuple[Result, Path]) -> None:
    found = json.loads((fitted[1] / "result.json").read_text())
    page = (fitted[1] / "report.html").read_text()
    shown = html.unescape(page).replace("\u00a0", " ")
    verdict = found["verdict"]
    assert verdict["headline"] in shown
    assert f"{np.mean([one['held_out_vaf'][0] for one in found['trials']]):.2f} %" in shown
    assert page.index("<h1") < page.index("<figure") < page.index('class="keys"')
    shown = re.sub("<[^>]*>", "", shown)
    for path in (fitted[1] / "figures").glob("*.svg"):
        assert path.stat().st_size > 5_000
        assert f'id="{path.stem}-title"' in page
    assert len(page) < 800_000
    assert not (fitted[1] / "fit-in-progress").exists()
    assert max(map(len, fitted[0].stdout.splitlines())) <= 100


def test_the_moving_body_is_that_of_the_table(fitted: tuple[Result, Path]) -> None:
    """Ends of the seat, lumbar joint and neck as complex numbers, from trajectories.csv."""
    page = html.unescape((fitted[1] / "report.html").read_text(encoding="utf-8"))
    (found,) = re.findall(r'<figure class="moving">(.*?)</figure>', page, re.DOTALL)
    data = json.loads(found[found.index("{") : found.index("</script>")])
    ((trial, times),) = re.findall(r"(Trial \d), .* drawn (\d) times as large", found)
    table = pd.read_csv(fitted[1] / "trajectories.csv").query(f"trial == '{trial}'")
    first, stride = (round(100 * data[name]) for name in ("start", "step"))
    table, ours, p = table.iloc[first::stride], [], seated_parameters_for(79.7, 1.66)
    for kind in ("recorded", "simulated"):  # a turn to the right
        angles = np.radians(table[[f"theta1_{kind}_deg", f"theta2_{kind}_deg"]].to_numpy())
        low, up = np.exp(-1j * int(times) * angles).T
        neck = 1j * p.l12 * low + 1.66j * p.l2 * up
        ours.append([(0.05j - 0.25) * low, (0.05j + 0.25) * low, 1j * p.l12 * low, neck])
    drawn = [[one.replace("M", "").split() for one in frames] for frames in data["frames"]]
    numbers = np.array(drawn, float)
    shown = numbers[..., [0, 2, 12, 16]] - 1j * numbers[..., [1, 3, 13, 17]]
    mine = np.swapaxes(ours, 1, 2)
    mine, shown = mine - mine.mean(), shown - shown.mean()
    scale = np.vdot(mine, shown).real / np.vdot(mine, mine).real
    assert scale > 800
    assert np.max(np.abs(shown - scale * mine)) < 1.5  # rounded to whole numbers
    assert data["limit"] == list(abs(table.command_simulated) >= 6 * (1 - 1e-6))
    assert 0 < sum(data["limit"]) < len(table)
    assert found.count(f'd="{data["frames"][1][0]}"') == 2  # a still figure has it too
    assert len(found) < 150_000


def test_the_tables_are_those_of_result_json(fitted: tuple[Result, Path]) -> None:
    """Tables are readable by pandas and MATLAB."""
    found = json.loads((fitted[1] / "result.json").read_text())
    names = ("gain", "weights", "methods", "trajectories")
    tables = {name: pd.read_csv(fitted[1] / f"{name}.csv") for name in names}
    gain, kept = tables["gain"], read_result(fitted[1]).table("gain")
    for name in ("value", "low", "high"):
        np.testing.assert_allclose(gain[name], kept[name].astype(float))
    np.testing.assert_allclose(gain["value"], found["K"][0])
    assert gain.set_index("number").loc["seat tilt", "unit"] == "N m/rad"
    weights = tables["weights"].query("matrix == 'Q'").set_index(["first", "second"]).value
    for index, first in enumerate(found["states"]):
        for column, second in enumerate(found["states"][: index + 1]):
            assert weights[first, second] == found["Q"][index][column]
    ranged = tables["weights"].dropna(subset=["low"])
    assert len(ranged)
    assert all(ranged["low"] <= ranged["high"])
    assert set(tables["methods"].name) == set(found["methods"])
    sway = tables["trajectories"].query("trial == 'Trial 2'")
    recorded, simulated = sway.theta1_recorded_deg.to_numpy(), sway.theta1_simulated_deg.to_numpy()
    share = 100 * (1 - np.sum((recorded - simulated) ** 2) / np.sum(recorded**2))
    assert share == pytest.approx(found["trials"][1]["vaf"][0])
    assert abs(sway.command_simulated).max() <= 6 * (1 + 1e-9)
    for name, table in tables.items():
        for head in table.columns:  # R and MATLAB would change other names
            assert re.fullmatch(r"(?!\d|_)[A-Za-z][A-Za-z0-9._]{0,62}", head), head
        text = (fitted[1] / f"{name}.csv").read_text(encoding="utf-8").splitlines()
        assert {line.count(",") for line in text if '"' not in line} == {len(table.columns) - 1}
    workbook = openpyxl.load_workbook(fitted[1] / "tables.xlsx", read_only=True)
    for name, table in tables.items():
        heads, *rows = workbook[name].iter_rows(values_only=True)
        assert len(heads) == len(table.columns)
        assert len(rows) == len(table)
    heads, *rows = workbook["trajectories"].iter_rows(values_only=True)
    sheet = pd.DataFrame(rows, columns=heads)
    expected = tables["trajectories"].theta1_simulated_deg
    np.testing.assert_allclose(sheet.theta1_simulated_deg, expected, rtol=1e-15)
    assert workbook.sheetnames[0] == "README"


@pytest.mark.full
def test_a_plant_and_a_file_of_ones_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A semicolon file with decimal commas, a local plant, and unusual names."""
    monkeypatch.chdir(tmp_path)
    Path("mine_to_fit.py").write_text(OWN_PLANT)
    rng = np.random.default_rng(0)
    push = np.repeat(rng.choice([-0.85, 0.0, 0.85], 30), 10)
    x = np.zeros(2)
    lines = ["t;pos;push"]
    for index, value in enumerate(push):
        shown = ";".join(f"{v:.9f}".replace(".", ",") for v in (index * 0.05, x[0], value))
        lines.append(shown)
        force = np.clip(-2.5 * x[0] - 2.2 * x[1], -1, 1)
        for _ in range(10):
            x = x + 0.005 * np.array([x[1], 0.5 * x[0] - 0.3 * x[1] + force + value])
    file = Path(os.fsdecode(b"mine\xff$x^$.csv"))
    file.write_text("\n".join(lines))
    Path("mine.toml").write_text(
        '[recording]\ntime = "t"\nsubject = "<script>alert(1)</script>"\n'
        '[signals.position]\ncolumn = "pos"\nunit = "m"\n'
        '[signals.push]\ncolumn = "push"\nunit = "N"\n'
        "[plant]\nmass = 1.0\n[fit]\nhorizon = 10\nu_max = 1.0\n"
    )
    done = run("fit", str(file), "--plant", "mine_to_fit:cart", "--config", "mine.toml",
               "--out", "out", "--solver", "daqp")  # fmt: skip
    assert done.exit_code == 0, done.stderr
    found = json.loads(Path("out/result.json").read_text())
    assert found["solver"] == found["settings"]["solver"] == "daqp"
    assert found["command"].endswith("--solver daqp")
    assert found["vaf"]["position"] > 99
    assert found["held_out_vaf"]["position"] is None
    page = Path("out/report.html").read_text()
    assert "Solved by daqp, of CasADi." in page
    assert "<script>alert" not in page
    assert "&lt;script&gt;alert" in page
    assert "<i>" not in page
    assert r"$\frac{F}$ &lt;i&gt;" in page
    assert found["trials"][0]["trial"] == r"mine\xff$x^$"


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (("u_max = 6.0", 'u_max = "six"'), "u_max"),
        (("horizon = 20", "horizn = 20"), "horizn"),
        (("horizon = 20", 'solver = "best"'), "solver: got 'best'; choose one of"),
        (("mass = 79.7", "mass = -3"), "mass"),
        (("mass = 79.7", "weight = 3"), "weight"),
        (("[signals.theta2]", "[signals.theta3]"), "theta3"),
    ],
)
def test_a_configuration_that_cannot_be(
    subject: Path, tmp_path: Path, change: tuple[str, str], says: str
) -> None:
    text = (subject / "subject.toml").read_text()
    assert change[0] in text
    config = tmp_path / "subject.toml"
    config.write_text(text.replace(*change))
    shutil.copy(subject / "trial_1.csv", tmp_path)
    done = run("fit", str(tmp_path / "trial_1.csv"), "--plant", "seated-balance",
               "--config", str(config), "--out", str(tmp_path / "out"))  # fmt: skip
    assert done.exit_code == 2
    assert done.stderr.count("\n") == 1
    assert says in done.stderr
    assert not (tmp_path / "out").exists()


@pytest.mark.full
@pytest.mark.parametrize(
    ("trials", "changed", "word"),
    [
        ((1, 2), "", "Ready to report"),  # gain and body first end in a local minimum
        ((1, 2, 3), "seed", "Ready to report"),  # likewise, with a good fit and wrong gains
        ((1, 2, 3), "12", "a limit of 12 N m is probably wrong"),
        ((1, 2, 3), "sign", "after a correction of a recorded signal"),
    ],
)
def test_errors_of_users_end_in_the_verdict_that_names_them(
    trials: tuple[int, ...], changed: str, word: str, tmp_path: Path
) -> None:
    """The simulated seat, with two trials, twice the limit, and a reversed perturbation."""
    seed = "3" if changed == "seed" else "0"
    out = ("--out", str(tmp_path), "--formats", "csv", "--seed", seed)
    made = run("simulate", "seated-balance", *out)
    assert made.exit_code == 0, made.stderr
    text = (tmp_path / "subject.toml").read_text(encoding="utf-8")
    text = text.replace("[fit]", "[fit]\nheld_out = false\nintent_draws = false")
    if changed == "12":
        text = text.replace("u_max = 6.0", "u_max = 12.0")
    elif changed == "sign":
        text = text.replace("[signals.perturbation]", "[signals.perturbation]\nsign = -1")
    (tmp_path / "changed.toml").write_text(text, encoding="utf-8")
    done = run("fit", *(str(tmp_path / f"trial_{number}.csv") for number in trials),
               "--plant", "seated-balance", "--config", str(tmp_path / "changed.toml"),
               "--out", str(tmp_path / "fit"))  # fmt: skip
    assert done.exit_code == 0, done.stderr
    assert word in " ".join(done.stdout.split())


def test_the_command_of_a_report_can_be_pasted(subject: Path, tmp_path: Path) -> None:
    path = shutil.copy(subject / "trial_1.csv", tmp_path / "Jürgen's 1.csv")
    config = tmp_path / "meine Person.toml"
    config.write_text(re.sub("(?m)^pattern.*$", "", (subject / "subject.toml").read_text()))
    command = asked_subject("fit", [Path(path)], "seated-balance", config).line
    assert shlex.split(command) == ["impc", "fit", "Jürgen's 1.csv", "--plant", "seated-balance",
                                    "--config", "meine Person.toml"]  # fmt: skip
