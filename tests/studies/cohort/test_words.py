"""Names of columns in words."""

from __future__ import annotations

import pytest

from impc.studies.cohort.words import measure_words


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
