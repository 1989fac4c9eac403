"""Comparison of a fit with the truth.json of simulated recordings."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import numpy as np
import pytest

from impc.studies.fit.findings import read_truth, truth_found
from tests.studies.fit.test_verdict import fitted

if TYPE_CHECKING:
    from pathlib import Path


def test_inside_and_outside_are_counted() -> None:
    result = fitted(1.0)
    (place, speed) = (result.preferred[name] for name in ("K.pull.place", "K.pull.speed"))
    assert truth_found(result, np.array([[place.low, speed.high]])) == (
        True,
        "The recordings are simulated: 2 of the 2 entries of their true gain lie inside their "
        "95 % intervals.",
    )
    right, said = truth_found(result, np.array([[place.high + 0.1, speed.low]]))
    assert not right
    assert "1 of the 2 entries" in said


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
