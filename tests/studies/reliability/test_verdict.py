"""What the page of a reliability study says first, and where it says nothing."""

from __future__ import annotations

import numpy as np
import pytest

from impc.arrays import Array, frozen
from impc.studies.reliability.analysis import MeasureResult, Reliability
from impc.studies.reliability.icc import icc, measurement_error
from impc.studies.reliability.measures import Passband
from impc.studies.reliability.verdict import answer, interval_band


def study(scores: Array, outputs: int = 1) -> Reliability:
    """RMS in radians of `outputs` outputs, all with these scores (subjects, visits)."""
    subjects, visits = scores.shape
    measures = tuple(
        MeasureResult(
            "rms", f"theta{number + 1}", "EO", frozen(scores),
            icc(scores, "A,k", method="generalised") if visits > 1 else None,
            measurement_error(scores) if visits > 1 else None,
        )
        for number in range(outputs)
    )  # fmt: skip
    names = [tuple(str(k + 1) for k in range(count)) for count in (subjects, visits)]
    band = Passband(0.1, 0.5, np.array([1, 5]))
    return Reliability(names[0], names[1], ("EO",), ("theta1",), band, measures, (), {}, ())


def scores(subjects: int, visits: int, spread: float) -> Array:
    rng = np.random.default_rng(3)
    person = 0.05 + 0.02 * rng.standard_normal((subjects, 1))
    return np.asarray(person + spread * rng.standard_normal((subjects, visits)))


@pytest.mark.parametrize(
    ("low", "high", "word"),
    [(0.8, 0.9, "excellent"), (0.61, 0.7, "good"),
     (-3.22, 0.95, "not identified: poor to excellent"),
     (0.7, 0.8, "not identified: good to excellent"), (-1, 0.3, "poor")],
)  # fmt: skip
def test_a_word_is_that_of_the_interval(low: float, high: float, word: str) -> None:
    assert interval_band(low, high) == word


def test_a_reliable_test_is_called_so_with_the_change_that_shows() -> None:
    made = scores(30, 3, 0.002)
    lines = answer(study(made))
    assert lines[0] == (
        "Reliability between visits is excellent for root-mean-square about upright of theta1, EO."
    )
    change = 1.96 * np.sqrt(2) * np.degrees(np.sqrt(np.mean(np.var(made, axis=1, ddof=1))))
    shown = float(lines[1].split("from: ")[1].split(" deg")[0])
    assert shown == pytest.approx(change, rel=0.1)


def test_few_subjects_tell_nothing_however_high_the_estimate() -> None:
    made = scores(4, 2, 0.01)
    found = icc(made, "A,k", method="generalised")
    assert found.value > 0.6
    lines = answer(study(made))
    assert "4 subjects and 2 visits do not decide" in lines[0]
    assert not any("is excellent" in line or "is good" in line for line in lines)
