"""A small study with sensory noise: one subject scored; more in the slow test."""

from __future__ import annotations

import numpy as np
import pytest

from experiments.noisy_people import recorded, subject
from experiments.noisy_people_score import Score, above_truth, blind, score
from experiments.noisy_people_study import HEAD, cells
from impc.inverse.methods import fit
from impc.output_feedback.fit import fit_output_feedback
from impc.output_feedback.intervals import person_covariance

pytestmark = pytest.mark.full


def scored(seed: int, limit: float) -> Score:
    who = subject("cart", seed, "motor", 90.0, limit)
    return score(who, recorded(who, seed), profiled=seed == 0)


def test_a_subject_is_scored_against_its_truth() -> None:
    found = scored(0, 0.7)
    assert 80 < found.vaf < 97
    assert found.converged
    assert found.above > 0
    assert len(found.expected) == len(found.fell) == 2
    # The fall of a quadratic log-likelihood is half the squared ratio of error and SE.
    for (error, deviation), nats in zip(found.expected, found.fell, strict=True):
        assert nats == pytest.approx((error / deviation) ** 2 / 2, abs=0.3)
    for error, deviation in found.expected:
        assert abs(error) < 4 * deviation  # seed 0
    assert np.log(found.found[0] / found.levels[0]) == pytest.approx(0, abs=0.3)


def test_on_the_seat_the_gain_is_found_if_least_squares_is_far_off() -> None:
    """Sensory noise: the least-squares gain is more than three times as large."""
    who = subject("seat", 2, "sensory", 90.0, 70.0)
    trials, truth = recorded(who, 2), np.array(who.controller.K)
    first = fit(trials.problem)
    assert np.array(first.gain)[0, 0] > 3 * truth[0, 0]
    found = fit_output_feedback(first, blind(who))
    assert found.converged
    assert found.space.gain == 5
    np.testing.assert_allclose(found.K[0, :4], truth[0, :4], rtol=0.2)
    # The final prior is centred at a gain less than half a whitened unit away.
    assert np.linalg.norm((np.array(found.theta) - found.space.center)[:5]) < 0.5
    covariance = person_covariance(found)
    z = (np.array(found.K) - truth)[0] / np.array(covariance.entries)[0]
    assert np.all(np.abs(z[:4]) < 1.96)


def test_a_search_leaves_a_model_with_exact_rates() -> None:
    """The most likely start leads to that model, 80 nats below the truth, and converges."""
    who = subject("seat", 16, "motor", 70.0, 70.0)
    found = fit_output_feedback(fit(recorded(who, 16).problem), blind(who))
    truth = np.array(who.controller.K)
    assert found.converged
    assert above_truth(found, who) > 0
    np.testing.assert_allclose(found.K[0, :4], truth[0, :4], rtol=0.2)


@pytest.mark.slow
def test_intervals_of_the_likelihood_hold() -> None:
    """Of 40 at 95 % two misses are expected: 8 or more have a probability of 0.1 %."""
    people = [scored(seed, 5.0) for seed in range(40)]
    pairs = np.array([one.expected for one in people])
    assert np.all(np.sum(np.abs(pairs[..., 0]) > 1.96 * pairs[..., 1], axis=0) < 8)


def test_a_row_counts_what_is_inside() -> None:
    """Of two scores that are counted by hand."""
    one = Score(
        saturated=0.25,
        vaf=70.0,
        above=3.0,
        converged=True,
        least_error=0.5,
        likely_error=0.1,
        least=[(0.3, 0.1)],
        likely=[(0.01, 0.01), (-0.1, 0.05)],
        expected=[(0.01, 0.01), (-0.09, 0.05)],
        fell=[],
        levels=[1.0, 2.0],
        found=[1.1, 2.2],
        level_intervals=[(0.9, 1.4), (2.1, 2.4)],
    )
    row = dict(zip(HEAD, cells("seat", [one, one._replace(above=-1.0)]), strict=True))
    assert list(row.values())[:5] == ["seat", "2", "25", "1", "2"]
    assert row["95 % holds: least squares"] == "0 ± 0 of 2"  # Three standard errors off
    assert row["sandwich"] == row["noise SDs"] == "50 ± 0 of 4"
    assert row["expected"] == "100 ± 0 of 4"
    assert row["profile"] == "-"
