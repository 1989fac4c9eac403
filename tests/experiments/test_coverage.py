"""Intervals of the gain hold the truth as often as they say, whatever the colour of the noise."""

from __future__ import annotations

import numpy as np
import pytest

from experiments.coverage import covered

pytestmark = pytest.mark.full


def shares(count: int, root: float) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """Share of recordings (seeds 0 to count - 1) whose 95 % interval holds each entry of K."""
    scores = np.array([covered(seed, root) for seed in range(count)])
    return np.asarray(np.mean(np.abs(scores) <= 1.96, axis=0))


@pytest.mark.full
def test_fifty_recordings() -> None:
    """Binomial bounds: 50 of 95 % fall below 42 once in a thousand."""
    white, coloured = shares(50, 0.0), shares(50, 0.9)
    assert np.all(white >= 0.84)
    assert np.all(coloured[1] >= 0.82)
    assert np.all(coloured[0] < 0.6)


@pytest.mark.slow
def test_four_hundred_recordings() -> None:
    white, coloured = shares(400, 0.0), shares(400, 0.9)
    assert np.all((white >= 0.92) & (white <= 0.98))
    assert np.all((coloured[1] >= 0.92) & (coloured[1] <= 0.98))
    assert np.all(coloured[0] < 0.6)
