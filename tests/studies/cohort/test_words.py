"""Names of columns in words, and what is said of falls."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from impc.studies.cohort.engine import Failures
from impc.studies.cohort.report import _falls
from impc.studies.cohort.study import Unit
from impc.studies.cohort.told import measure_words


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("K.command.theta1_rate", "gain of theta1_rate to command"),
        ("vaf.theta1", "VAF of theta1"),
        ("centre_price.theta.1", "price of theta.1, analytic centre"),
        ("beyond_bound", "beyond bound"),
        ("K", "K"),
        ("drag", "drag"),
    ],
)
def test_words(name: str, words: str) -> None:
    assert measure_words(name) == words


def test_falls_are_counted_by_group() -> None:
    units = [
        Unit("1", "", "", (Path("a"), Path("b")), "old"),
        Unit("2", "", "", (Path("c"), Path("d")), "old"),
        Unit("3", "", "", (Path("e"),), "young"),
    ]
    fits = {"sub-1": {"trials": 1}, "sub-3": {"trials": 1}}
    store: Any = SimpleNamespace(fit=fits.get)
    (line,) = _falls(
        units, store, Failures({"sub-2": "d.csv: angle: the subject fell at 3 s; cut"})
    )
    assert "(3 of group old, 0 of group young)" in line
    assert "compare the numbers of falls" in line
    assert _falls(units[2:], store, Failures()) == []
