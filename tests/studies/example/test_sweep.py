"""The sweep over the share of samples at the limit: recordings, errors, tests, and the command."""

from __future__ import annotations

import itertools
import json
import math
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner

from impc.cli.example import _setup
from impc.cli.main import main
from impc.errors import SolverError
from impc.levels import Level
from impc.model.riccati import solve_lqr
from impc.reporting.provenance import Provenance
from impc.studies.cache import Cache
from impc.studies.example import sweep as sweep_module
from impc.studies.example.sweep import (
    CONDITIONS,
    LEVELS,
    SWEPT,
    Setup,
    Sweep,
    biased_from,
    compared,
    fit_cell,
    median_interval,
    recorded,
    run_sweep,
)
from impc.studies.example.sweep_report import sweep_figure, sweep_report
from impc.studies.pool import Task, answered


@pytest.mark.parametrize("level", [0, 30, 60])
def test_a_recording_is_at_its_limit_as_often_as_asked_for(level: int) -> None:
    setup = _setup("example")
    law, run, push = recorded(setup, level, 3)
    share = float(np.mean(np.abs(run.u) > float(law.bounds.u_max[0]) * (1 - 1e-9)))
    assert abs(100 * share - level) <= (5 if level else 0)
    x = np.array(run.x)  # the motion is that of the equations, under the push
    A, B = setup.plant.A, setup.plant.B
    np.testing.assert_allclose(x[1:], x[:-1] @ A.T + (run.u + push) @ B.T, atol=1e-9)
    again = recorded(setup, level, 3)[1]
    np.testing.assert_array_equal(again.x, run.x)
    assert not np.array_equal(recorded(setup, level, 4)[1].x, run.x)


def test_a_level_that_is_not_reached_is_an_error() -> None:
    with pytest.raises(SolverError, match="no limit is reached in 99 %"):
        recorded(_setup("example"), 99, 0)


def test_exact_recordings_give_inverse_mpc_the_gain_and_inverse_lqr_another() -> None:
    """Without saturation all methods are exact; the error is that of the unbounded command."""
    free = {
        row["method"]: row["error_percent"] for row in fit_cell(_setup("example"), "exact", 0, 1)
    }
    assert max(free.values()) < 1e-3
    rows = fit_cell(_setup("example"), "exact", 30, 1)
    assert [row["method"] for row in rows] == list(SWEPT)
    errors = {row["method"]: row["error_percent"] for row in rows}
    assert errors["inverse_mpc"] < 1e-3
    assert errors["inverse_lqr_output"] > 1
    missing = [row for row in rows if math.isnan(row["error_percent"])]
    assert all(row["reason"] for row in missing)
    assert rows[0]["at_limit_percent"] == pytest.approx(30, abs=5)


def test_a_wrong_plant_biases_without_saturation_by_what_it_is_wrong() -> None:
    """The command acts 10 % too weakly in the model: the loop is the same with 10 % more gain."""
    setup = _setup("example")
    rows = fit_cell(setup, "plant", 0, 0)
    assert rows[0]["error_percent"] == pytest.approx(10, abs=1)
    K = np.array(solve_lqr(setup.plant, setup.weights).K)
    np.testing.assert_allclose(recorded(setup, 0, 0)[0].K, K, rtol=1e-6)


def made_up(ratios: dict[str, dict[int, float]], seeds: int = 8) -> pd.DataFrame:
    """Fits with inverse LQR errors of `ratios` (condition -> level) times those of inverse MPC."""
    rows, rng = [], np.random.default_rng(1)
    for condition, level, seed in itertools.product(CONDITIONS, LEVELS, range(seeds)):
        ours = rng.uniform(1, 2)
        for method in SWEPT:
            lmi = method == "inverse_lqr_lmi" and level > 0
            factor = 1.0 if method == SWEPT[0] else ratios[condition][level]
            rows.append({
                "condition": condition, "level_percent": level, "seed": seed,
                "at_limit_percent": float(level), "method": method,
                "error_percent": np.nan if lmi else ours * factor,
                "reason": "no weights" if lmi else "",
            })  # fmt: skip
    return pd.DataFrame(rows)


EVERY = dict.fromkeys(LEVELS, 2.0)
NEVER = dict.fromkeys(LEVELS, 0.5)
LATE = {0: 1.0, 10: 3.0, 20: 1.0, 40: 4.0, 60: 9.0}
FITS = made_up({"exact": EVERY, "noise": LATE, "limit": NEVER, "plant": LATE})


def test_biased_is_the_least_level_from_which_all_tests_reject() -> None:
    tests = compared(FITS)
    found = {name: biased_from(tests, name, "inverse_lqr_output") for name in CONDITIONS}
    levels = {name: None if one is None else one["level_percent"] for name, one in found.items()}
    assert levels == {"exact": 0, "noise": 40, "limit": None, "plant": 40}
    row = found["noise"]
    assert row is not None
    assert row["p"] == pytest.approx(0.5**8)  # eight heads in a row
    assert row["p_holm"] == pytest.approx(5 * 0.5**8)
    own = FITS.query("condition == 'noise' and level_percent == 40").pivot_table(
        "error_percent", "seed", "method"
    )
    apart = own["inverse_lqr_output"] - own["inverse_mpc"]
    assert row["difference"] == pytest.approx(np.median(apart))
    assert (row["low"], row["high"]) == pytest.approx((apart.min(), apart.max()))
    few = compared(made_up(dict.fromkeys(CONDITIONS, EVERY), seeds=4))
    assert biased_from(few, "noise", "inverse_lqr_output") is None  # 5 * 0.5^4 > 0.05
    assert few["low"].isna().all()


def test_a_lost_fit_of_inverse_mpc_counts_against_it() -> None:
    lost = FITS.copy()
    lost.loc[(lost["method"] == SWEPT[0]) & (lost["seed"] == 0), "error_percent"] = np.nan
    row = biased_from(compared(lost), "exact", "inverse_lqr_output")
    assert row is None  # 7 of 8: 5 * 9 / 2^8 > 0.05
    assert compared(lost).query("method == 'inverse_lqr_lmi'")["fits"].max() == 8


@pytest.mark.parametrize("count", [6, 8, 15, 40])
def test_the_interval_of_a_median_covers_it(count: int) -> None:
    """Every order of signs has the same probability: count those with the median inside."""
    low, high = median_interval(np.arange(1.0, count + 1))
    inside = sum(math.comb(count, k) for k in range(round(low), round(high))) / 2**count
    assert inside >= 0.95
    narrower = sum(math.comb(count, k) for k in range(round(low) + 1, round(high) - 1)) / 2**count
    assert narrower < 0.95
    assert np.isnan(median_interval(np.arange(5.0))).all()


def test_the_page_says_from_which_level_and_with_what_evidence() -> None:
    report = sweep_report(Sweep(FITS, ("noise-60-9: no limit",)), "cart", Provenance())
    verdict = report.verdict
    assert (verdict.level, verdict.words) == (Level.GREEN, "Shown")
    assert verdict.headline == "Inverse LQR is biased from 40 % of the samples at the limit."
    assert "not at 20 %" in verdict.sentence
    assert "larger in 8 of 8 seeds, p_holm = 0.02" in verdict.sentence
    assert [key.value for key in report.keys] == ["40", "-", "40"]
    assert any("any model" in claim.text for claim in verdict.may_not)
    files = report.files()
    assert json.loads(files["result.json"])["biased_from_percent"] == {
        "exact": 0, "noise": 40, "limit": None, "plant": 40
    }  # fmt: skip
    assert len(files["fits.csv"].splitlines()) == len(FITS) + 1
    page = files["report.html"].decode()
    assert "noise-60-9: no limit" in page
    assert "No limit, inverse LQR (exact): 128 of 160." in page
    none = Sweep(made_up(dict.fromkeys(CONDITIONS, NEVER)), ())
    assert sweep_report(none, "cart", Provenance()).verdict.level is Level.AMBER


def test_the_figure_has_a_panel_for_each_condition() -> None:
    panels = sweep_figure(FITS).axes
    assert [ax.get_title(loc="left") or ax.get_title() for ax in panels] == [*CONDITIONS.values()]
    bars: list[Any] = panels[1].containers
    lines = {bar.get_label(): bar.lines[0] for bar in bars}
    assert len(lines) == len(SWEPT)
    own = FITS.query("condition == 'noise' and method == 'inverse_mpc'")
    median = own.groupby("level_percent")["error_percent"].median()
    np.testing.assert_allclose(lines["With limit, inverse MPC"].get_ydata(), median)


class Inline:
    """A pool that runs each task at once; `most` of them, then it is interrupted."""

    threads = 1

    def __init__(self, most: int = 1000) -> None:
        self.left, self.ran = most, list[str]()

    def submit(self, task: Task):  # type: ignore[no-untyped-def]
        if not self.left:
            raise KeyboardInterrupt
        self.left -= 1
        self.ran.append(task.name)
        with ThreadPoolExecutor(1) as pool:
            return pool.submit(answered, task)


def no_fit(_: Setup, condition: str, level: float, seed: int) -> list[dict[str, Any]]:
    """Rows of the made-up fits, as a cheap task."""
    own = FITS.query("condition == @condition and level_percent == @level and seed == @seed")
    return [{str(name): value for name, value in row.items()} for row in own.to_dict("records")]


def test_an_interrupted_sweep_continues(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sweep_module, "fit_cell", no_fit)
    setup, cache, pool = _setup("example"), Cache(tmp_path), Inline(5)
    with pytest.raises(KeyboardInterrupt):
        run_sweep(setup, 1, pool, cache, levels=(0, 10))
    heard = dict[str, bool]()

    def done(title: str, *, found: bool) -> None:
        heard[title] = found

    again = Inline()
    sweep = run_sweep(setup, 1, again, cache, done, levels=(0, 10))
    wanted = FITS.query("seed == 0 and level_percent <= 10").set_index(["condition", "method"])
    found = sweep.fits.set_index(["condition", "method"])["error_percent"]
    assert sorted(found.dropna()) == sorted(wanted["error_percent"].dropna())
    stored = {name for name, found in heard.items() if found}
    assert stored
    assert not stored & {*again.ran}
    assert len(heard) == 2 * len(CONDITIONS)


@pytest.mark.parametrize(
    ("given", "message"),
    [(["--sweep", "seat", "--case", "A"], "remove --case"), (["--seeds", "3"], "is for --sweep")],
)
def test_options_that_do_not_fit_are_refused(
    tmp_path: Path, given: list[str], message: str
) -> None:
    done = CliRunner().invoke(main, ["example", *given, "--out", str(tmp_path / "out")])
    assert done.exit_code == 2
    assert message in done.stderr
