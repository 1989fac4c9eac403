"""A column with a single pulse may mark the start of the trial; others do not."""

from __future__ import annotations

import numpy as np
import pytest

import impc
from impc.arrays import Array
from impc.files.alignment import pulse
from impc.files.draft import drafted
from impc.files.plant_sources import plant_source

TIME = np.arange(500) / 100


def high(first: int, last: int, height: float) -> Array:
    return np.where((np.arange(500) >= first) & (np.arange(500) < last), height, 0.0)


@pytest.mark.parametrize("first", [1, 150, 480])
@pytest.mark.parametrize("last", [1, 15])
@pytest.mark.parametrize("height", [5.0, -0.1, 3e4])
def test_a_pulse_is_found_in_noise_and_on_an_offset(first: int, last: int, height: float) -> None:
    noise = 0.02 * height * np.random.default_rng(1).uniform(-1, 1, 500)
    found = pulse(high(first, first + last, height) + noise + 7 * height)
    assert found is not None
    assert found[0] == first
    assert found[1] == pytest.approx(height, rel=0.05)


@pytest.mark.parametrize(
    "values",
    [
        np.zeros(500),
        high(0, 20, 5.0),  # it began before the recording
        high(300, 500, 5.0),  # it does not end
        high(100, 110, 5.0) + high(300, 310, 5.0),
        high(100, 400, 5.0),  # longer than what is beside it
        high(100, 110, 5.0) - high(200, 210, 4.0),
        np.sin(TIME),
        np.random.default_rng(0).standard_normal(500),
        np.where(TIME > 2, np.nan, high(100, 110, 5.0)),
        np.ones(2),
        np.zeros(0),
    ],
)
def test_others_are_no_pulse(values: Array) -> None:
    assert pulse(values) is None


def test_the_draft_asks_whether_the_trial_begins_at_the_pulse() -> None:
    columns = {"time": TIME, "seat": np.sin(TIME), "trunk": np.cos(TIME), "push": np.sin(9 * TIME),
               "sync": high(150, 160, 5.0)}  # fmt: skip
    units = {"time": "s", "seat": "deg", "trunk": "deg", "push": "N*m", "sync": "V"}
    table = impc.make_table("simulated", columns, units)
    found = drafted(table, plant_source("plants:seated_balance_for", {}))
    said = "one pulse of 5 V in 'sync' at 1.5 s: does the trial begin there?"
    assert found.start is not None
    assert found.start[0] == pytest.approx(1.5)
    assert found.start[1] == said
    assert f"# start = 1.5             # {said}" in found.toml()
