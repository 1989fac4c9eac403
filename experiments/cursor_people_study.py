"""Compare models of people who follow a blurred target on held-out trials.

For each blur the even trials are fitted and the odd ones predicted, and the other way round
(`experiments.cursor_people`), with prediction errors and the gain of a model of steps and rests
(`experiments.cursor_steps`). Then all trials of a blur are fitted, with intervals of the noise SDs.
Results: experiments/cursor_tracking.md.

    python -m experiments.cursor_people_study --out results/cursor-people
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from tqdm import tqdm

from experiments.cursor_data import RATE, Condition, data_file, read_conditions
from experiments.cursor_people import FIRST, Follower, fit_follower, judged, nats, regression_nats
from experiments.cursor_steps import Expected, fit_steps, step_nats
from impc.output_feedback.intervals import level_intervals, person_covariance
from impc.output_feedback.models import prediction_errors
from impc.reporting.writer import write_files

if TYPE_CHECKING:
    from impc.arrays import IntArray
    from impc.output_feedback.fit import OutputFeedbackFit

__all__ = ["main"]

_AHEAD = (1, 6, 12, 30)
_IDENTIFIED = ("outside", "steps", "regression")


@dataclass(frozen=True)
class _Row:
    """One half of a blur, evaluated on the other half; or all its trials, with intervals."""

    blur: float
    half: int
    inside: float
    outside: float
    steps: float
    regression: float
    delay: int
    offset: float
    cost_weight: float
    lag: float
    levels: dict[str, float]
    intervals: dict[str, list[float]]
    ahead: list[float]
    evaluations: int
    converged: bool


def _half(condition: Condition, half: int) -> _Row:
    every = np.arange(len(condition.target))
    mine, others = every[half::2], every[1 - half :: 2]
    follower = fit_follower(condition, mine)
    there = judged(follower, condition, others)
    steps = fit_steps(_expected(follower.fit, condition, mine))
    cells = (
        nats(there),
        step_nats(steps, _expected(there, condition, others)),
        regression_nats(condition, mine, others),
    )
    ahead = prediction_errors(there, _AHEAD)[:, 0].tolist()
    return _row(condition.blur, half, follower, cells, {}, ahead)


def _expected(fit: OutputFeedbackFit, condition: Condition, which: IntArray) -> Expected:
    """Predictions of the filter from the first scored sample on."""
    position = condition.response[which]
    off = np.array([trial.innovations[:, 0] for trial in fit.identified.trials])
    spread = np.array([trial.spreads[:, 0, 0] for trial in fit.identified.trials])
    parts = position, np.roll(position, 1, axis=1), position - off, np.sqrt(spread)
    return Expected(*(part[:, FIRST:].ravel() for part in parts))


def _whole(condition: Condition) -> _Row:
    follower = fit_follower(condition, np.arange(len(condition.target)))
    intervals = level_intervals(follower.fit, person_covariance(follower.fit))
    named = dict(zip(follower.fit.space.names, intervals.tolist(), strict=True))
    nothing = float("nan"), float("nan"), float("nan")
    return _row(condition.blur, -1, follower, nothing, named, [])


def _row(
    blur: float,
    half: int,
    follower: Follower,
    outside: tuple[float, float, float],
    intervals: dict[str, list[float]],
    ahead: list[float],
) -> _Row:
    fit = follower.fit
    assert fit.cost_weights is not None
    assert fit.problem.family is not None
    levels = fit.levels
    return _Row(
        blur,
        half,
        nats(fit),
        *outside,
        follower.delay,
        follower.offset,
        float(np.exp(fit.cost_weights[0])),
        float(fit.problem.family.nominal[0] * np.exp(fit.problem.logarithms[0])),
        dict(zip(fit.space.names, levels.tolist(), strict=True)),
        intervals,
        ahead,
        fit.evaluations,
        fit.converged,
    )


def _table(rows: list[_Row]) -> str:
    """Table of the held-out log-likelihoods of both halves."""
    lines = [
        "| blur, px | nats a sample, even, odd trials held out | mean | with steps and rests "
        "| free regression | errors 1, 6, 12, 30 samples ahead, px |",
        "|---|---|---|---|---|---|",
    ]
    for blur in sorted({row.blur for row in rows}):
        pair = sorted(
            (row for row in rows if row.blur == blur), key=lambda row: -row.half
        )  # half 1 leaves the even trials out
        each = ", ".join(f"{row.outside:.4f}" for row in pair)
        cells = " | ".join(f"{_mean(pair, name):.4f}" for name in _IDENTIFIED)
        ahead = np.sqrt(np.mean(np.square([row.ahead for row in pair]), axis=0))
        far = ", ".join(f"{value:.2f}" for value in ahead)
        lines.append(f"| {blur:.0f} | {each} | {cells} | {far} |")
    cells = " | ".join(f"{_mean(rows, name):.4f}" for name in _IDENTIFIED)
    return "\n".join([*lines, f"| mean | | {cells} | |"])


def _mean(rows: list[_Row], name: str) -> float:
    return float(np.mean([getattr(row, name) for row in rows]))


def _numbers(rows: list[_Row]) -> str:
    """Table of the parameters of each blur, with intervals of the noise SDs."""
    names = list(rows[0].levels)
    lines = [
        "| blur, px | delay, ms | lag, ms | offset, px | cost weight of the error, 1/s^2 | "
        + " | ".join(names)
        + " |",
        "|" + "---|" * (5 + len(names)),
    ]
    for row in rows:
        levels = (_spanned(row.levels[name], row.intervals[name]) for name in names)
        lines.append(
            f"| {row.blur:.0f} | {1e3 * row.delay / RATE:.0f} | {1e3 * row.lag:.0f} "
            f"| {row.offset:.1f} | {row.cost_weight:.3g} | " + " | ".join(levels) + " |"
        )
    return "\n".join(lines)


def _spanned(value: float, ends: list[float]) -> str:
    if ends[0] == 0:
        return f"at most {ends[1]:.3g}"
    return f"{value:.3g} ({ends[0]:.3g} to {ends[1]:.3g})"


def main() -> None:
    """Fit every half and every blur, print the tables, and write result.json."""
    parser = argparse.ArgumentParser(description="Sensory noise of a blurred target.")
    parser.add_argument("--out", type=Path, default=Path("results", "cursor-people"))
    given = parser.parse_args()
    if not data_file().exists():
        print(f"{data_file().name} is not there; set IMPC_CURSOR_DATA to its path.")
        return
    conditions = read_conditions(data_file())
    jobs = [(condition, half) for condition in conditions for half in (0, 1)]
    with ProcessPoolExecutor(2) as pool:
        found = list(tqdm(pool.map(_half, *zip(*jobs, strict=True)), total=len(jobs)))
        whole = list(tqdm(pool.map(_whole, conditions), total=len(conditions)))
    print(_table(found), _numbers(whole), sep="\n\n")
    rows = [dataclasses.asdict(row) for row in (*found, *whole)]
    write_files(given.out, {"result.json": json.dumps(rows, indent=1).encode()})


if __name__ == "__main__":
    main()
