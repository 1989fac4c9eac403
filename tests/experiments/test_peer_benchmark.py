"""A small study of the four systems; in full: python -m experiments.peer_benchmark."""

from __future__ import annotations

import numpy as np
import pytest

from experiments.peer_benchmark import coverage, demonstration, fit_from
from experiments.peer_systems import SYSTEMS

pytestmark = pytest.mark.full


def test_a_start_a_third_off_recovers_the_identified_products() -> None:
    system = SYSTEMS["rocket"]()
    found = fit_from(system, demonstration(system), system.truth, 0.3, 3)
    assert found.loss < 1e-10
    assert found.error < 1e-5
    assert found.unidentified == "Jx, Jy Jz l"


def test_a_start_without_a_plan_is_a_line_and_not_a_loss() -> None:
    system = SYSTEMS["robot arm"]()
    found = fit_from(system, demonstration(system), system.truth, 0.3, 7)
    assert np.isnan(found.loss)
    assert found.unidentified.startswith("constraint angle[1]: no plan was found that satisfies it")


def test_intervals_of_noisy_recordings_hold_the_truth() -> None:
    held, odd = coverage(3, decibel=40)
    assert odd == []
    assert len(held) == 8
    assert sum(sum(item) for item in held.values()) >= 20  # of 24; 22.8 are expected
