"""Bootstrap, LASSO, key parameters, and the commands."""

from __future__ import annotations

import json
from pathlib import Path

import cvxpy as cp
import numpy as np
import pytest
from click.testing import CliRunner, Result

from experiments.selection_claims import bootstrap_widths, table_c1
from impc.arrays import Array, percentiles
from impc.assess.resampling import block_residuals
from impc.cli.main import main
from impc.studies.selection.analysis import bootstrap_subset, draw_single, key_parameters
from impc.studies.selection.estimation import estimate
from impc.studies.selection.lasso import _box_lasso, proximal_lasso
from impc.studies.selection.model import Trial
from impc.studies.selection.settings import SelectSettings
from tests.studies.selection.dosing import blood_model, in_turn
from tests.studies.selection.heads import line_model
from tests.support import present

SEED = 2


def run(*arguments: str) -> Result:
    return CliRunner().invoke(main, list(arguments))


def line_trial(noise: float) -> Trial:
    rng = np.random.default_rng(SEED)
    u = rng.standard_normal((400, 3))
    return Trial(u, (u @ [2.0, 0.0, -1.0])[:, None] + noise * rng.standard_normal((400, 1)))


def test_bootstrap_of_a_line_is_its_covariance() -> None:
    """Widths against 3.92 standard errors of ordinary least squares, 400 replicates: 15 %."""
    model, trial = line_model(), line_trial(0.5)
    fit = estimate(model, [trial], (0, 1, 2), np.zeros(3))
    drawn = bootstrap_subset(model, [trial], fit, 400, SEED)
    expected = 3.92 * 0.5 * np.sqrt(np.diag(np.linalg.inv(trial.input.T @ trial.input)))
    low, high = percentiles(drawn, 0.95)
    np.testing.assert_allclose(high - low, expected, rtol=0.15)
    np.testing.assert_array_equal(bootstrap_subset(model, [trial], fit, 3, SEED), drawn[:3])
    assert np.all((low < fit.theta) & (fit.theta < high))


def test_blocks_widen_intervals_of_coloured_residuals() -> None:
    model, rng = line_model(), np.random.default_rng(SEED)
    slow = np.repeat(rng.standard_normal(40), 10)[:, None]
    drive = np.repeat(rng.standard_normal((40, 3)), 10, axis=0)
    trial = Trial(drive, (drive @ [2.0, 0.0, -1.0])[:, None] + 0.5 * slow)
    fit = estimate(model, [trial], (0, 1, 2), np.zeros(3))
    single, blocks = (
        np.ptp(percentiles(bootstrap_subset(model, [trial], fit, 200, SEED, draw), 0.95), axis=0)
        for draw in (draw_single, block_residuals)
    )
    assert np.all(blocks > 1.5 * single)


def test_lasso_of_a_line_is_soft_thresholding() -> None:
    """With an orthonormal design (C.5) is a soft threshold; zero means exactly typical."""
    model = line_model()
    u, _ = np.linalg.qr(np.random.default_rng(SEED).standard_normal((300, 3)))
    u *= np.sqrt(300)
    trial = Trial(u, (u @ [2.0, 0.1, -1.0])[:, None])
    weight = 5 * 0.5  # in normalised units: half of the range is 5
    t, _ = proximal_lasso(model, [trial], weight)
    expected = np.sign([2, 0.1, -1]) * np.maximum(np.abs([2, 0.1, -1]) - 0.5 / 2, 0) / 5
    np.testing.assert_allclose(t, expected, atol=1e-8)
    assert t[1] == 0  # exactly typical


def test_nelder_mead_finds_the_same_objective() -> None:
    """Table C.1 and the proximal solver select the same parameters of the linear model."""
    model, trial = line_model(), line_trial(0.1)
    selected, weight, least = table_c1(model, [trial], 2, solves=6)
    t, objective = proximal_lasso(model, [trial], weight)
    assert least == pytest.approx(objective, rel=1e-3)
    assert selected == tuple(np.flatnonzero(np.abs(t) > 0.005))


def test_key_parameters_of_a_line() -> None:
    """Six subjects, two visits: a and c differ between subjects, b is noise; a, c are reliable."""
    rng = np.random.default_rng(SEED)
    model = line_model(pathways=["x", "x", "y"])
    recorded = {}
    for subject in range(6):
        own = np.array([rng.normal(0, 1), 0.0, rng.normal(0, 1)])
        for visit in ("1", "2"):
            u = rng.standard_normal((60, 3))
            theta = own + np.array([0, rng.normal(0, 0.3), 0])
            y = (u @ theta)[:, None] + 0.2 * rng.standard_normal((60, 1))
            recorded[str(subject), visit] = [Trial(u, y)]
    found = key_parameters(
        model, recorded, SelectSettings(), in_turn(model), bound=0.5, least_vaf=10.0
    )
    assert found.selection.size == 3
    assert found.chosen == ()
    pairs = {item.subset: item for item in found.candidates}
    assert pairs[0, 1, 2].diversity == 2
    assert pairs[0, 1, 2].reliability < 0.75


@pytest.mark.slow
def test_widths_of_table_4_3() -> None:
    """Ten subjects around the FIM column, each with its own VAF."""
    widths = bootstrap_widths(0.2, 0.6, 60)
    inside = [abs(item.mean - item.quoted) <= item.deviation for item in widths]
    assert sum(inside) >= 4


@pytest.mark.full
def test_head_tracking_from_files_to_files(tmp_path: Path) -> None:
    made = run("simulate", "head-tracking", "--out", str(tmp_path), "--subjects", "1",
               "--trials", "1", "--duration", "8")  # fmt: skip
    assert made.exit_code == 0, made.stderr
    study = tmp_path / "study.toml"
    study.write_text(study.read_text().replace("replicates = 200", "replicates = 20\nstarts = 1"))
    done = run("select", str(study), "--out", str(tmp_path / "out"), "--workers", "1")
    assert done.exit_code == 0, done.stderr
    found = json.loads((tmp_path / "out" / "result.json").read_text())
    assert set(found["selected"]) == {"fim", "lasso"}
    assert {"common", "vaf", "findings"} <= set(found)
    (scalings,) = found["unseen_scalings"].values()
    assert ["Kvis", "Kvcr", "Kccr", "B", "K"] in scalings
    page = (tmp_path / "out" / "report.html").read_text()
    words = "visual gain, vestibular gain, proprioceptive gain, intrinsic damping"
    assert f"{words}, intrinsic stiffness" in page
    assert "These 5 can all be 2.7 times larger" in page
    # One trial of 8 s: each interval ends at the search range.
    assert found["verdict"]["headline"] == "None of 12 parameters can be estimated."
    assert all(found["findings"]["intervals"]["table"]["note"])
    bias = found["findings"]["parameters"]["table"]["bias_percent_of_the_range"]
    largest = max(one for one in bias if one is not None)
    wrong = f"up to {largest:.3g} %" if largest < 100 else "more than its whole search range"
    assert wrong in page.replace("&nbsp;", " ").replace("\u00a0", " ")


MINE = ("--model", "tests.studies.selection.dosing:blood_model")


def blood_study(folder: Path, subjects: int, visits: int) -> Path:
    """Subjects with doses every eight hours for two days."""
    identified, rng = blood_model(), np.random.default_rng(SEED)
    dose = np.zeros((192, 1))
    dose[::32] = 400.0
    for subject in range(subjects):
        own = np.array([1.0, 0.1, 30.0]) * np.exp(0.3 * rng.standard_normal(3))
        for visit in range(visits):
            theta = own * np.exp(0.02 * rng.standard_normal(3))
            level = identified["simulate"](theta, dose)
            noisy = level + 0.03 * np.std(level) * rng.standard_normal(level.shape)
            rows = np.column_stack([np.arange(192) * 0.25, dose, noisy])
            np.savetxt(
                folder / f"p{subject + 1}_v{visit + 1}.csv", rows, delimiter=",",
                header="time,dose,level", comments="",
            )  # fmt: skip
    (folder / "study.toml").write_text(
        """\
[study]
model = "tests.studies.selection.dosing:blood_model"
recordings = "p{subject}_v{visit}.csv"
[recording]
time = "time"
[signals.dose]
column = "dose"
unit = "dimensionless"
[signals.concentration]
column = "level"
unit = "dimensionless"
[select]
bound = 0.05
size = 2
replicates = 40
"""
    )
    return folder / "study.toml"


@pytest.mark.full
def test_a_model_from_another_field(tmp_path: Path) -> None:
    study = blood_study(tmp_path, 6, 3)
    done = run("select", str(study), *MINE, "--out", str(tmp_path / "select"), "--workers", "1")
    assert done.exit_code == 0, done.stderr
    found = json.loads((tmp_path / "select" / "result.json").read_text())
    assert found["selected"]["fim"] == ["ka", "ke", "V"]
    assert found["verdict"]["headline"] == "3 of 3 parameters can be estimated."
    assert found["verdict"]["headline"] in done.stdout
    done = run(
        "key-parameters", str(study), *MINE, "--out", str(tmp_path / "key"), "--workers", "1"
    )
    assert done.exit_code == 0, done.stderr
    found = json.loads((tmp_path / "key" / "result.json").read_text())
    assert found["chosen"] == ["ka", "ke", "V"]
    assert found["findings"]["candidates"]["table"]["pathways"][0] == 3


def test_faults_are_one_line(tmp_path: Path) -> None:
    study = blood_study(tmp_path, 1, 1)
    text = study.read_text()
    before, wrong = "bound = 0.05\nsize = 2\nreplicates = 40", (
        "replicates = 0", "replicates = 1", "replicates = 9223372036854775807", "starts = 0",
        "seed = -1", "bounds = []", "bounds = [nan]", "bound = -1.0",
    )  # fmt: skip
    for old, new, match in (
        ('model = "tests.studies.selection.dosing:blood_model"', "", "study.model"),
        ("dosing:blood_model", "dosing:nothing", "nothing"),
        ("bound = 0.05", "bond = 0.05", "is not a setting"),
        ("bound = 0.05", "draw = 'x'", "give single or block"),
        *((before, one, f"[select] {one.split()[0]}") for one in wrong),
    ):
        study.write_text(text.replace(old, new))
        done = run("select", str(study), "--allow-model", "--out", str(tmp_path / "out"))
        assert done.exit_code == 2, done.stdout
        assert match in done.stderr
        assert len(done.stderr.strip().splitlines()) == 1
        assert not (tmp_path / "out").exists()


def problem(seed: int) -> tuple[Array, Array, Array, Array, float]:
    """2 to 12 parameters, columns of sizes from 0.01 to 10, some of t and typical at a bound."""
    rng = np.random.default_rng(seed)
    k = 2 + seed % 11
    J = rng.standard_normal((k + 3, k)) * 10 ** rng.uniform(-2, 1, k)
    t = np.clip(rng.uniform(-1.3, 1.3, k), -1, 1)
    typical = np.clip(rng.uniform(-1.2, 1.2, k), -1, 1)
    typical[0] = t[0]
    g = rng.standard_normal(k) * 10 ** rng.uniform(-1, 2)
    return J.T @ J + 1e-6 * np.eye(k), g, t, typical, float(10 ** rng.uniform(-6, 2))


@pytest.mark.parametrize("seed", range(60))
def test_the_quadratic_program(seed: int) -> None:
    """Objective not above Clarabel's, inside the bounds, exact typical values."""
    H, g, t, typical, weight = problem(seed)
    x = _box_lasso(H, g, t, typical, weight)

    def objective(at: Array) -> float:
        moved = at - t
        away = float(np.sum(np.abs(at - typical)))
        return float(g @ moved + moved @ H @ moved / 2) + weight * away

    z = cp.Variable(len(t))
    moved = z - t
    quadratic = cp.sum_squares(np.linalg.cholesky(H).T @ moved) / 2
    cost = g @ moved + quadratic + weight * cp.norm1(z - typical)
    cp.Problem(cp.Minimize(cost), [z <= 1, z >= -1]).solve(solver="CLARABEL")
    other = np.asarray(present(z.value))
    reference = objective(np.clip(other, -1, 1))
    assert objective(x) <= reference + 1e-9 * (1 + abs(reference))
    assert np.all(np.abs(x) <= 1)
    near = np.abs(other - typical) < 1e-9
    np.testing.assert_array_equal(x[near], typical[near])
