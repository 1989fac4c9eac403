"""Comparison of a fit with the truth.json of simulated recordings."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import numpy as np
import pytest

from impc.studies.fit.findings import gain_finding, read_truth, truth_sentence
from tests.studies.fit.test_verdict import fitted

if TYPE_CHECKING:
    from pathlib import Path


def ends() -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """Low and high of each entry, (2, 2)."""
    found = {item.name: item for item in reversed(fitted(1.0).uncertainty.intervals)}
    names = ("K.pull.place", "K.pull.speed")
    return np.array([[found[name].low, found[name].high] for name in names])


@pytest.mark.full
def test_inside_and_outside_are_counted_and_the_farthest_is_named() -> None:
    result, (place, speed) = fitted(1.0), ends()
    middle = np.array([[np.mean(place), np.mean(speed)]])
    assert truth_sentence(result, middle).endswith(
        "2 of the 2 entries of their true gain lie inside their 95 % intervals."
    )
    beyond = np.array([[place[1] + 0.1, speed[1] + 10 * (speed[1] - speed[0])]])
    identified = truth_sentence(result, beyond)
    assert "0 of the 2 entries" in identified
    assert identified.endswith(
        f"The largest deviation is in the gain on speed: interval {speed[0]:.4g} to "
        f"{speed[1]:.4g}, true value {beyond[0, 1]:.4g}."
    )
    rows = gain_finding(result, np.array([[place[1] + 0.1, np.mean(speed)]])).rows
    assert [row[0] for row in rows] == ["place of the cart", "speed"]
    assert [row[-1] for row in rows] == ["no", "yes"]


@pytest.mark.full
@pytest.mark.parametrize(
    ("content", "found"),
    [
        ({"states": ["place", "speed"], "K": [[2.0, 1.0]]}, [[2.0, 1.0]]),
        ({"states": ["speed", "place"], "K": [[2.0, 1.0]]}, None),
        ({"states": ["place", "speed"], "K": [[2.0]]}, None),
        ({"subjects": []}, None),
        (["K"], None),
    ],
)
def test_only_a_truth_of_this_plant_is_one(tmp_path: Path, content: object, found: object) -> None:
    plant = fitted(1.0).given.plant
    files = [tmp_path / "a.csv", tmp_path / "b.csv"]
    assert read_truth(files, plant) is None
    (tmp_path / "truth.json").write_text(json.dumps(content))
    gain = read_truth(files, plant)
    assert (None if gain is None else gain.tolist()) == found
    assert read_truth([*files, tmp_path / "c" / "a.csv"], plant) is None
    (tmp_path / "truth.json").write_text("no json")
    assert read_truth(files, plant) is None
