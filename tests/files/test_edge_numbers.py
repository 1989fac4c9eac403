"""Extreme numbers and clocks: one line at once, without warnings."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from impc.arrays import Array
from impc.cli.plant import find_plant
from impc.errors import InputError
from impc.files import apart
from impc.files.configuration import read_configuration
from impc.files.draft import draft, summary
from impc.files.formats import read_table
from impc.files.plant_sources import make_plant
from impc.files.reading import read_recordings, recording_of
from impc.files.table import make_table
from impc.model.plant import Plant
from tests.files.damaged_files import PLANT
from tests.files.samples import csv_text, pushed_seat, settings

BASE = pushed_seat()
TIME = 'time = "time"'


def late(column: str, value: float) -> Array:
    """A column that changes by so much half-way."""
    changed = BASE[column].copy()
    changed[300:] += value
    return changed


def ends(value: float) -> Array:
    """The clock with its first and last time moved outward."""
    changed = BASE["time"].copy()
    changed[[0, -1]] = -value, value
    return changed


@pytest.fixture(scope="module")
def seat() -> Plant:
    return make_plant(find_plant(PLANT, {}), ("perturbation",))


def reason(
    folder: Path, seat: Plant, columns: Mapping[str, Array], text: str, rate: float | None = None
) -> str:
    """Reason why the trial is rejected."""
    (folder / "subject.toml").write_text(text)
    table = make_table("trial.csv", {**BASE, **columns}, None, rate)
    shown, *_ = summary(table).split("\ntrial.csv: clock")
    assert shown.count("\n") == len(table.columns) + (rate is not None)
    draft(table).toml()
    with pytest.raises(InputError) as caught:
        recording_of(table, read_configuration(folder / "subject.toml"), seat)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize(
    ("columns", "says"),
    [
        ({"seat": np.clip(BASE["seat"], -1, 1) * 1e308}, "which is implausible"),
        ({"seat": BASE["seat"] * 1e200}, "which is implausible"),
        ({"seat": BASE["seat"] * 5e-324}, "which is implausible"),
        ({"seat": BASE["seat"] * 1e-310}, "which is implausible"),
        (
            {"seat": late("seat", 1e308)},
            "theta1 (column 'seat'): is 1e+308 deg in sample 301 (3 s)",
        ),
        ({"push": BASE["push"] * 1e307}, "which is implausible"),
        ({"push": BASE["push"] * 5e-324}, "which is implausible"),
        ({"time": BASE["time"] * 1e300}, "reaches 5.99e+300 s"),
        ({"time": BASE["time"] * 1e-300}, "has a sample every 1e-302 s"),
        ({"time": BASE["time"] * 5e-324}, "has only 7 times in 600 samples"),
        ({"time": BASE["time"] * 1e12}, "reaches 5.99e+12 s"),
        ({"time": BASE["time"] * 1e-12}, "has a sample every 1e-14 s"),
        ({"time": ends(1.7e308)}, "reaches 1.7e+308 s"),
        # Regression: took 4.9 GB.
        (
            {"time": BASE["time"] * 1e6},
            "has a sample every 1e+04 s, far slower than the plant (dt = 0.01",
        ),
        (
            {"time": BASE["time"] * 1e3},
            "has a sample every 10 s, far slower than the plant (dt = 0.01 s)",
        ),
    ],
)
def test_columns(tmp_path: Path, seat: Plant, columns: dict[str, Array], says: str) -> None:
    assert says in reason(tmp_path, seat, columns, settings())


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ((TIME, "rate = 1e-12"), "has a sample every 1e+12 s"),
        ((TIME, "rate = 1e12"), "has a sample every 1e-12 s"),
        ((TIME, "rate = 5e-324"), "has a sample every inf s"),
        ((TIME, "rate = 1e308"), "has a sample every 1e-308 s"),
        ((TIME, "rate = 1e6"), "has 1 samples at the plant's rate, 50 are needed"),
        (("limit = 12.0", "offset = 1.7e308"), "which is implausible"),
        (("limit = 12.0", "limit = 5e-324"), "exceeds its mechanical stop"),
        ((TIME, f"{TIME}\nstart = 1e308"), "has 0 samples between"),
        ((TIME, f"{TIME}\nstop = 1e308"), "recording.stop"),
    ],
)
def test_settings(tmp_path: Path, seat: Plant, change: tuple[str, str], says: str) -> None:
    assert says in reason(tmp_path, seat, {}, settings(change))


@pytest.mark.parametrize("rate", [1e-12, 1e12, 1e308, 1e-308])
def test_rates_of_the_file(tmp_path: Path, seat: Plant, rate: float) -> None:
    assert "has a sample every" in reason(tmp_path, seat, {}, settings((TIME, "")), rate)


def test_a_gap_of_years_that_may_be_filled(tmp_path: Path, seat: Plant) -> None:
    text = settings((TIME, f"{TIME}\nfill_gaps = 1e308"))
    found = reason(tmp_path, seat, {"time": late("time", 1e9)}, text)
    assert "has 600 samples at 1e+11 uniform instants" in found


@pytest.mark.parametrize(
    ("step", "unit"),
    [(0.01, "s"), (0.1, "s"), (1.0, "ms"), (10.0, "ms"), (1e3, "us"), (1e4, "us"), (1e7, "ns")],
)
def test_the_guess_of_a_clocks_unit(step: float, unit: str) -> None:
    table = make_table("trial.csv", {"time": step * np.arange(50.0), "seat": np.arange(50.0) ** 2})
    assert f'time_unit = "{unit}"' in draft(table).toml()


def test_a_pattern_that_never_ends(
    tmp_path: Path, seat: Plant, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(apart, "_SECONDS", 1)  # of computing
    path = tmp_path / f"{'a' * 60}.csv"
    path.write_text(csv_text(pushed_seat()))
    config = tmp_path / "subject.toml"
    config.write_text(settings((TIME, f"{TIME}\npattern = '(?P<trial>(a+)+x)'")))
    with pytest.raises(InputError, match="cannot be matched") as caught:
        read_recordings([path], read_configuration(config), seat)
    assert "\n" not in str(caught.value)
    config.write_text(settings((TIME, f"{TIME}\npattern = '(?P<trial>a+)'")))
    (trial,) = read_recordings([path], read_configuration(config), seat)
    assert trial.label.trial == "a" * 60


def test_a_name_that_is_not_utf_8(tmp_path: Path) -> None:
    for ending, content in ((".csv", csv_text(BASE).encode()), (".tdms", b"TDSm")):
        path = tmp_path / os.fsdecode(b"trial\xff\n" + ending.encode())
        try:
            path.write_bytes(content)
        except OSError:
            pytest.skip("this file system has names in UTF-8 only")
        if ending == ".csv":
            assert read_table(path).samples == 600
        else:
            with pytest.raises(InputError, match="has no column"):
                read_table(path)
