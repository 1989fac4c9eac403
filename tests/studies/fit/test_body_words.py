"""Errors of recorded signals in words that say what is wrong with the recording."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import pytest

import impc
from impc.assess.lack_of_fit import ModelError
from impc.studies.fit.body_words import error_words, remedy_words
from plants import seated_balance_plant

PLANT = impc.Plant(seated_balance_plant(), ["command"])


@pytest.mark.parametrize(
    ("name", "size", "words"),
    [
        ("shift.theta1", 1.0, "a time shift of the seat tilt (it is recorded 10 ± 1 ms too late)"),
        ("shift.perturbation", -0.4, "(it acts 4 ± 1 ms earlier than recorded)"),
        ("scale.theta2", -0.2, "an error of scale of the trunk tilt (by -20 ± 10 %)"),
        ("offset.theta1", 0.02, "an offset of the seat tilt"),  # of one trial: a size in rad
        ("clock.theta2", 1e-3, "a clock error of the trunk tilt (by +0.1 ± 10 %)"),
        ("limit", 0.05, "another limit of the command, by +5.0 ± 10.0 %"),
    ],
)
def test_an_error_is_said_with_its_size(name: str, size: float, words: str) -> None:
    """At 100 samples/s, with a standard error of 0.1."""
    result = cast("Any", SimpleNamespace(given=SimpleNamespace(plant=PLANT)))
    assert error_words(result, ModelError(name, 1e-9, 20.0, size, 0.1)).endswith(words)


def test_a_corrected_error_is_said_with_its_remedy() -> None:
    problem = SimpleNamespace(fitted_errors=[("clock", "theta2", [-1e-4, -3e-4])])
    result = cast("Any", SimpleNamespace(
        given=SimpleNamespace(plant=PLANT), estimate=SimpleNamespace(problem=problem)
    ))  # fmt: skip
    said = remedy_words(result, ModelError("clock.theta2", 1e-9, 20.0, -2e-4, 1e-5))
    assert said == (
        "Correct the trunk tilt for a clock error of \u22120.02 %, in the file or at the device."
    )
