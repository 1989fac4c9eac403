"""The runs end where they ended when golden.json was written."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tests.golden.runs import GOLDEN, RUNS

KEPT = json.loads(GOLDEN.read_text(encoding="utf-8"))


@pytest.mark.parametrize("name", RUNS)
def test_a_run_ends_where_it_did(name: str, tmp_path: Path) -> None:
    found = json.loads(json.dumps(RUNS[name](tmp_path)))
    kept = KEPT[name]
    assert found
    assert set(found) == set(kept)
    for key, one in kept.items():
        if isinstance(one, dict) and "within" in one:
            away = np.abs(np.subtract(found[key]["value"], one["value"]))
            assert np.all(away <= one["within"]), (key, found[key]["value"], one["value"])
        else:
            assert found[key] == one, key
