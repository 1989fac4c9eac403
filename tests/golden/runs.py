"""Runs as their users type them, and the numbers at which they end.

    python -m tests.golden.runs      runs all and writes golden.json again

An identified number of an exact recording has to agree to 1e-6 of itself, one of a noisy recording
to 1e-3 of its standard error; words have to be the same. Nothing is kept that another processor
might settle differently: no sentences, no timings, no numbers that are chosen by convention only.
What has a known truth is compared with it in other tests.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from click.testing import CliRunner

from impc.cli.main import main
from tests.cli.test_plan import EXACT
from tests.studies.cohort.carts import write_study
from tests.studies.selection.test_methods import MINE, blood_study

__all__ = ["GOLDEN", "RUNS", "Numbers"]

GOLDEN = Path(__file__).with_name("golden.json")
_EXACT, _NOISY = 1e-6, 1e-3
_CART = "tests.studies.cohort.carts:cart_plant"

#: By name: a word, or a number or an array with the distance within which it has to be found.
Numbers = dict[str, Any]


def _within(value: Any, distance: Any) -> dict[str, Any]:
    value = np.asarray(value, dtype=float)
    return {"value": value.tolist(), "within": np.broadcast_to(distance, value.shape).tolist()}


def _exact(value: Any) -> dict[str, Any]:
    value = np.asarray(value, dtype=float)
    return _within(value, _EXACT * np.max(np.abs(value)))


def _typed(folder: Path, *arguments: str) -> dict[str, Any]:
    """Run one command that writes to the folder `out`: its result.json."""
    out = folder / "out"
    done = CliRunner().invoke(main, [*arguments, "--out", str(out)])
    assert done.exit_code == 0, done.output
    content: dict[str, Any] = json.loads((out / "result.json").read_text(encoding="utf-8"))
    return content


def _fitted(found: dict[str, Any]) -> Numbers:
    """What is identified in a fit of noisy recordings."""
    estimate = found["estimate"]
    return {
        "gain": _within(found["K"], _NOISY * np.array(estimate["standard_errors"])),
        "identified": [bool(one) for one in np.ravel(estimate["identified"])],
        "directions": [bool(one) for one in estimate["identified_directions"]],
        "rank": found["identifiability"]["rank"],
        "usable": found["usable"],
        "vaf": _within(list(found["vaf"].values()), 1e-3),
        "weights rejected": found["weights_test"]["rejected"],
    }


def _cart(folder: Path) -> Numbers:
    study = write_study(folder, 1)
    settings = study.read_text(encoding="utf-8").partition("[recording]")
    (folder / "cart.toml").write_text("".join(settings[1:]), encoding="utf-8")
    return _fitted(_typed(
        folder, "fit", str(folder / "sub-01/cart_1.csv"), "--config", str(folder / "cart.toml"),
        "--plant", _CART,
    ))  # fmt: skip


def _cohort(folder: Path) -> Numbers:
    study = write_study(folder, 4)
    _typed(folder, "cohort", str(study), "--workers", "1", "--plant", _CART)
    units = pd.read_csv(folder / "out/units.csv").filter(regex=r"^K(_deviation)?\.")
    gains, deviations = np.split(units.to_numpy(), 2, axis=1)
    return {"gains": _within(gains, _NOISY * deviations)}


def _plan(folder: Path) -> Numbers:
    (folder / "plan.toml").write_text(EXACT, encoding="utf-8")
    found = _typed(folder, "plan", str(folder / "plan.toml"), "--plant", "seated-balance")
    table = pd.read_csv(folder / "out/experiments.csv")
    gains = ("theta1", "theta2", "theta1_rate", "theta2_rate")
    widths = {f"{name} width": _exact(table[f"{name}_percent"]) for name in gains}
    return {"best": found["best"]} | widths


def _reliability(folder: Path) -> Numbers:
    made = CliRunner().invoke(main, [
        "simulate", "reliability-study", "--out", str(folder), "--subjects", "3", "--visits", "2",
        "--trials", "2",
    ])  # fmt: skip
    assert made.exit_code == 0, made.output
    _typed(folder, "reliability", str(folder / "study.toml"))
    found: Numbers = {}
    for measure, unit in (("rms", np.deg2rad(1)), ("energy", np.deg2rad(1) ** 2)):
        scores = pd.read_csv(folder / f"out/icc-{measure}.csv")
        scores["sem"] *= unit
        visits = pd.read_csv(folder / f"out/visits-{measure}.csv")
        for output, rows in visits.groupby("output"):
            found[f"anova {measure}.{output}"] = _exact(rows[["F", "p"]])
        for output, rows in scores.groupby("output"):
            found[f"icc {measure}.{output}"] = _exact(rows[["icc", "low", "high", "sem"]])
    return found


def _selection(folder: Path) -> Numbers:
    study = blood_study(folder, 3, 1)
    found = _typed(folder, "select", str(study), *MINE, "--workers", "1")
    table = pd.read_csv(folder / "out/intervals.csv")
    exact = [f"others_exact_{name}" for name in ("value", "low", "high")]
    intervals = table.sort_values("subject", kind="stable")[exact].to_numpy()
    widths = np.ptp(intervals, axis=1, keepdims=True)
    return {
        "selected": found["selected"],
        "common": found["common"],
        "intervals": _within(intervals, _NOISY * widths),
    }


#: By name, in the order of the design.
RUNS: dict[str, Callable[[Path], Numbers]] = {
    "cart with noise": _cart,
    "cohort of four": _cohort,
    "plan": _plan,
    "reliability": _reliability,
    "selection": _selection,
}


def main_of_all() -> None:
    """Run all and write golden.json."""
    found = {}
    for name, run in RUNS.items():
        with tempfile.TemporaryDirectory() as folder:
            found[name] = run(Path(folder))
        print(name, flush=True)
    GOLDEN.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main_of_all()
