"""The steering study reads the published rows, compares methods fairly, and writes its page."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from experiments import steering_page
from experiments.steering import fit_delayed, read_trials
from experiments.steering_page import METHODS, PI, RATE, REFITTED, Case, Fit, compared, write_page
from impc.arrays import Array
from impc.errors import DataError


def trial(seed: int, kp: float = 2.0, delay: int = 12) -> Array:
    """Trial (2700, 4) of delayed feedback with y' = u + d: time, y, slider, push."""
    rng, time = np.random.default_rng(seed), np.arange(2700) / RATE
    phases = rng.uniform(0, 2 * np.pi, 4)
    sines = [np.sin(2 * np.pi * f * time + p) for f, p in zip((2, 3, 5, 7), phases, strict=True)]
    push, y, u = 0.3 * np.sum([np.sin(0.05 * one) + one for one in sines], axis=0), [0.0], []
    for t in range(len(time)):
        u.append(-kp * y[t - delay] if t >= delay else 0.0)
        y.append(y[-1] + (u[-1] + push[t]) / RATE)
    return np.column_stack([time, y[:-1], u, push])


def test_published_rows_are_aligned(tmp_path: Path) -> None:
    """Row k + 1 of the file has the slider and the disturbance that act from sample k to k + 1."""
    rows = trial(0)
    raw = np.zeros((len(rows) + 1, 6))
    raw[:-1, [0, 5]], raw[1:, 3:5] = rows[:, :2], rows[:, 2:]
    (tmp_path / "ab").mkdir()
    np.savetxt(
        tmp_path / "ab" / "20170901-1_su17v3_fo_r-zer_d-sos+A_s49_p2a1_-1.csv", raw, delimiter=","
    )
    found, digest = read_trials(tmp_path)
    assert list(found) == [("ab", "fo")]
    np.testing.assert_allclose(found["ab", "fo"]["2m"], rows)
    assert digest != steering_page.DIGEST
    with pytest.raises(DataError, match="has no recordings of this study"):
        read_trials(tmp_path / "ab")


def test_a_delayed_controller_is_found() -> None:
    case = Case("ab", "fo", [trial(0)], [trial(1)], [True])
    found = fit_delayed(PI, case.train, case)
    values = {name: float(value) for name, value in found.values.items()}
    assert values == {"kp": 2.0, "ki": 0.0, "delay": 0.2}
    np.testing.assert_allclose(found.test[:, 0], 100, atol=1e-3)


def case(person: str, kind: str, gains: dict[str, float]) -> Case:
    """Case whose methods differ from delayed PI by `gains` points of VAF, and by trials."""
    tests, apart = [trial(seed) for seed in range(3)], np.array([[-1.0], [0.0], [1.0]])
    made = Case(person, kind, tests, tests, [True, False, True], np.full((3, 2), 95.0))
    for label, *_ in METHODS:
        vaf = np.full((3, 2), 60.0) + gains.get(label, 0.0) + (apart if label == REFITTED else 0)
        runs = [one[:, 1:3] for one in tests]
        made.fits.append(Fit(label, vaf, vaf, runs, {"K.a.y": "1"}, ("The residual is 62 %.",)))
    return made


def test_methods_are_compared_over_persons() -> None:
    """Two pairs of one person count as one person; a scatter of a point hides half a point."""
    name = "offset-free inverse MPC"
    values = (("a", "fo", 1.0), ("a", "so", 2.0), ("b", "fo", -4.5))
    cases = [case(p, kind, {name: gain, REFITTED: 0.5}) for p, kind, gain in values]
    found = compared(cases, name)
    assert (found.better, found.worse, found.neither, found.persons) == (2, 1, 0, 2)
    assert (found.median, found.mean) == (1.0, -1.5)
    assert found.half == pytest.approx(3 * 12.7062, rel=1e-4)  # Student's t, 1 d.o.f.
    assert compared(cases, REFITTED).neither == 3


def test_the_page_says_what_the_numbers_say(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(steering_page, "__file__", str(tmp_path / "page.py"))
    (tmp_path / "images").mkdir()
    name = "offset-free inverse MPC"
    for gains, word in (((1.0, -1.0), "as well as delayed PI (PID), not better"),
                        ((3.0, 3.1), "better than delayed PI (PID)"),
                        ((-3.0, -3.1), "worse than delayed PI (PID)")):  # fmt: skip
        cases = [case(p, "fo", {name: gain}) for p, gain in zip("ab", gains, strict=True)]
        cases.append(case("b", "so", {name: gains[1]}))
        write_page(cases, steering_page.DIGEST, ["c so (none)"], 1.0)
        text = " ".join((tmp_path / "steering.md").read_text(encoding="utf-8").split())
        assert f"predicts held-out trials {word}: it is " in text
        assert "In 3 of 3 pairs part of the movement that repeats is unexplained" in text
        assert "The residual is X %. (18 fits)" in text
    assert (tmp_path / "images" / "steering.svg").stat().st_size > 1000
