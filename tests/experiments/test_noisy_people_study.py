"""The study of people who sense with noise, small: one subject scored; more in the slow one."""

from __future__ import annotations

import numpy as np
import pytest

from experiments.noisy_people_study import score, subject


def test_a_subject_is_scored_against_its_truth() -> None:
    found = score(subject(0, "motor", 90.0, 0.7), "carts", 0)
    assert 80 < found.vaf < 97
    assert found.converged
    error, deviation = np.array(found.likely) - found.truth, np.array(found.likely_deviations)
    assert np.all(np.abs(error) < 4 * deviation)  # seed 0
    assert np.log(found.found[0] / found.levels[0]) == pytest.approx(0, abs=0.3)


@pytest.mark.slow
def test_intervals_of_the_likelihood_hold() -> None:
    """Of 40 at 95 % two miss: 8 or more have a probability of 0.1 %."""
    people = [score(subject(seed, "motor", 90.0, 5.0), "carts", seed) for seed in range(40)]
    errors = np.array([one.likely for one in people]) - [one.truth for one in people]
    deviations = np.array([one.expected_deviations for one in people])
    assert np.all(np.sum(np.abs(errors) > 1.96 * deviations, axis=0) < 8)
