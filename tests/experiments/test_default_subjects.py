"""The default subject's truth lies within the intervals that its fit prints."""

from __future__ import annotations

from pathlib import Path

import pytest

from experiments.default_subjects import fitted_subject, simulated_files

pytestmark = pytest.mark.full


def test_the_truth_of_a_short_default_subject_is_found(tmp_path: Path) -> None:
    """Seed 0, a trial of 10 s: the nonlinear body explains what the linear plant cannot.

    So short a trial tells little, and the intervals of either are wide.
    """
    files = simulated_files(tmp_path / "one", 0, "--trials", "1", "--duration", "10")
    own, linear = (fitted_subject(files, body) for body in ("nonlinear", "linear"))
    assert own.inside == own.entries == 10
    assert linear.misfit > 1.1 * own.misfit


@pytest.mark.slow
def test_twenty_default_subjects(tmp_path: Path) -> None:
    """As `python -m experiments.default_subjects` has it, without the CPU times."""
    found = []
    for seed in range(20):
        files = simulated_files(tmp_path / str(seed), seed)
        found.append(fitted_subject(files, "nonlinear"))
    assert sum(one.inside for one in found) >= 0.92 * sum(one.entries for one in found)
