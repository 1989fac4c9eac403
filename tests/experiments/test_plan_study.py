"""The study of plans, small: it runs, and the fits are where the plan says."""

from __future__ import annotations

import numpy as np
import pytest

from experiments.plan_study import cart, compare, seat
from impc.studies.plan.designs import try_design

pytestmark = pytest.mark.full


@pytest.mark.slow
def test_deviations_are_those_of_a_hundred_fits_and_the_best_is_the_best() -> None:
    found = compare("cart", 100)
    for _, foreseen, seen, gains, gains_seen in found:
        assert np.all(np.abs(np.log(seen / foreseen)) < np.log(1.2))
        assert np.all(np.abs(np.log(gains_seen / gains)) < np.log(1.2))
    planned = min(found, key=lambda row: float(np.mean(row[1] ** 2)))
    assert planned is min(found, key=lambda row: float(np.mean(row[2] ** 2)))


@pytest.mark.parametrize("make", [cart, seat])
def test_the_grid_of_a_study_can_be_planned(make: object) -> None:
    assert callable(make)
    person, perturbation, grid, trials = make()
    told = try_design(person, grid[0], perturbation, trials=trials, draws=trials)
    assert told.falls == 0
    assert told.expected is not None
    assert np.all(np.isfinite(told.expected.deviations))
