"""Table of the study with sensory noise, from scores that are counted by hand."""

from __future__ import annotations

import numpy as np
import pytest

from experiments.noisy_people_score import Score
from experiments.noisy_people_table import HEADS, means, row
from impc.checking import replace

ONE = Score(
    study="seat, both, VAF 70, met",
    seed=1,
    saturated=0.25,
    vaf=70.0,
    above=3.0,
    converged=True,
    evaluations=60,
    least_error=0.5,
    likely_error=0.1,
    least=[(0.3, 0.1)],
    likely=[(0.01, 0.01), (-0.1, 0.05)],
    expected=[(0.01, 0.01), (-0.09, 0.05)],
    entries=[(-0.2, 0.4), (-3.0, 0.1), (0.1, 0.3)],
    fell=[],
    levels=[1.0, 2.0],
    found=[1.1, 2.2],
    level_intervals=[(0.9, 1.4), (2.1, 2.4)],
    seconds=[1.0, 10.0, 0.0],
)


def test_a_row_counts_what_is_inside() -> None:
    cells = dict(zip(HEADS[:5], row([ONE, replace(ONE, above=-1.0)])[:5], strict=True))
    assert cells["count"] == "2"
    assert cells["at the limit %"] == "25"
    assert cells["ended at the truth or above"] == "1"
    everything = row([ONE])
    assert len(everything) == len(HEADS)
    assert everything[7] == "0 ± 0"  # Least squares, three standard errors off
    assert everything[10:12] == ["50 ± 0", "100 ± 0"]
    assert everything[13] == "50 ± 0 (2), 67 ± 0"
    assert everything[14] == "50 ± 0"


def test_means_have_the_standard_errors_of_draws() -> None:
    rng = np.random.default_rng(4)
    drawn = 0.5 + rng.standard_normal((400, 2))
    (mean, error), (_, other) = means([[(2 * one, 2.0), (two, 1.0)] for one, two in drawn])
    assert mean == pytest.approx(np.mean(drawn[:, 0]))
    assert error == pytest.approx(0.05, rel=0.1)
    assert other == pytest.approx(0.05, rel=0.1)
    # A direction that few subjects identify has no mean.
    assert len(means([[(1.0, 1.0)], [(1.0, 1.0)], [(1.0, 1.0), (2.0, 1.0)]])) == 1
