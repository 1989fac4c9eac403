"""Ends of searches from several starts: intervals are their union."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import impc
from experiments.uncertain_body import cart_person
from impc.arrays import frozen
from impc.assess.printed_gain import GainEstimate, covariance_intervals, gain_estimate
from impc.inverse.ends import relative_error, several_ends
from impc.inverse.estimates import Estimate, SearchEnd
from impc.inverse.minimiser import Ended
from impc.inverse.refit import refit


@pytest.fixture(scope="module")
def found() -> Estimate:
    person = cart_person(1, 99, 0.0)
    assert person is not None
    return impc.fit(person[0])


def with_rivals(found: Estimate, *rises: tuple[float, float]) -> GainEstimate:
    """The estimate with ends at multiples of the gain, so much higher."""
    at = found.problem
    lowest = refit(at, found.gain, found.metric).objective
    rivals = tuple(
        SearchEnd(frozen(scale * found.gain), frozen(found.metric), at.starts, at.logarithms,
                  at.errors, lowest + rise, Ended.CONVERGED)
        for scale, rise in rises
    )  # fmt: skip
    return gain_estimate(impc.replace(found, rivals=rivals))


def test_the_lowest_end_is_first_and_starts_only_add(found: Estimate) -> None:
    first = refit(found.problem, 1.1 * found.gain, found.metric)
    ends = several_ends(found.problem, [first])
    values = [end.objective for end in ends]
    assert values == sorted(values)
    assert len(ends) > 1
    assert any(end is first for end in ends)


def test_the_relative_error_is_that_of_the_largest_entry(found: Estimate) -> None:
    """The noise of these carts is white, so that it agrees with the printed standard error."""
    estimate = gain_estimate(found)
    end = refit(found.problem, found.gain, found.metric)
    ratios = np.ravel(np.array(estimate.covariance.entries) / np.abs(np.array(estimate.K)))
    assert np.min(np.abs(relative_error(end) / ratios - 1)) < 0.15


def test_intervals_reach_over_ends_within_noise_and_no_further(found: Estimate) -> None:
    alone, joined = with_rivals(found), with_rivals(found, (1.3, 2.0), (2.0, 60.0))
    assert len(joined.rivals) == 1
    table = impc.replace(found, rivals=()).intervals()
    single = covariance_intervals(alone, alone.covariance, "sandwich")
    both = covariance_intervals(joined, joined.covariance, "sandwich")
    for one, other in zip(single[: found.gain.size], both, strict=False):
        assert one.value is not None
        assert one.value == other.value
        assert other.low <= one.low
        assert other.high >= one.high
        assert other.low < 1.3 * one.value < other.high
        assert not other.low < 2.0 * one.value < other.high
    assert single[0].determined
    assert bool(table.determined.iloc[0])


def test_an_interval_over_far_ends_is_not_determined(found: Estimate) -> None:
    joined = with_rivals(found, (2.2, 1.0))
    one = covariance_intervals(joined, joined.covariance, "sandwich")[0]
    assert one.identified
    assert not one.determined


def test_other_ends_are_saved(found: Estimate, tmp_path: Path) -> None:
    family = found.problem.family
    again = impc.load(found.save(tmp_path / "fit.json"), family=family)
    assert isinstance(again, Estimate)
    assert len(again.rivals) == len(found.rivals)
    for one, other in zip(found.rivals, again.rivals, strict=True):
        np.testing.assert_array_equal(one.K, other.K)
        assert one.objective == other.objective
    np.testing.assert_array_equal(again.intervals().low, found.intervals().low)
