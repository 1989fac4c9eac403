"""The table of people who sense with noise, of scores that are counted by hand."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from experiments.noisy_people_score import Score
from experiments.noisy_people_study import main
from experiments.noisy_people_table import HEADS, means, pooled, row
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
    assert everything[7] == "0 ± 0"  # least squares, three deviations off
    assert everything[10:12] == ["50 ± 0", "100 ± 0"]
    assert everything[13] == "50 ± 0 (2), 67 ± 0"
    assert everything[14] == "50 ± 0"


def test_all_rows_of_a_kind_in_one_line() -> None:
    other = replace(ONE, likely=[(-0.01, 0.01), (0.1, 0.05)], converged=False)
    line = pooled([[ONE, other], [ONE]])
    assert line.startswith("3 people: directions 3 of 6 (50.0 %), entries 6 of 9 (66.7 %)")
    assert "settled 2, gains off by more than themselves 0, of which 0 settled" in line
    lost = replace(ONE, likely_error=2.0)
    assert "themselves 2, of which 1 settled" in pooled([[lost, replace(lost, converged=False)]])
    # Means of the first kind are none; of the second one and two deviations.
    assert "mean errors below 0.25 2 of 4" in line
    assert line.endswith("mean errors of all 0.33 ± 0.67, -0.67 ± 1.33")


def test_means_have_the_standard_errors_of_draws() -> None:
    rng = np.random.default_rng(4)
    drawn = 0.5 + rng.standard_normal((400, 2))
    (mean, error), (_, other) = means([[(2 * one, 2.0), (two, 1.0)] for one, two in drawn])
    assert mean == pytest.approx(np.mean(drawn[:, 0]))
    assert error == pytest.approx(0.05, rel=0.1)
    assert other == pytest.approx(0.05, rel=0.1)
    # A direction that few are told along has no mean.
    assert len(means([[(1.0, 1.0)], [(1.0, 1.0)], [(1.0, 1.0), (2.0, 1.0)]])) == 1


def test_files_of_several_runs_are_summed_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    first, second = tmp_path / "a.jsonl", tmp_path / "b.jsonl"
    first.write_text(json.dumps(asdict(ONE)) + "\n", encoding="utf-8")
    passed = {"study": ONE.study, "seed": 2, "passed": "falls"}
    unfitted = {"study": ONE.study, "seed": 3, "reason": "no regulator"}
    lines = [json.dumps(asdict(replace(ONE, seed=4))), json.dumps(passed), json.dumps(unfitted)]
    second.write_text("\n".join(lines), encoding="utf-8")
    monkeypatch.setattr(sys, "argv", ["study", "sum", str(first), str(second)])
    main()
    out = capsys.readouterr().out
    assert "| seat, both, VAF 70, met | 2 | 25 |" in out
    assert "seat, met: 2 people: directions 2 of 4" in out
    assert "(profile)" not in out, "nobody was asked"
    assert "not scored: seat, both, VAF 70, met: falls: 1" in out
    assert "not scored: seat, both, VAF 70, met: no regulator: 1" in out
