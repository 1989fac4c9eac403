"""Coverage of least squares and maximum likelihood on subjects with sensory noise.

The subjects are those of `noisy_people`, each kind in turn. The table has all subjects of the file,
with `--subjects 0` at any time. Results: experiments/output_feedback.md.

    python -m experiments.noisy_people_study --subjects 200 --out a.jsonl
    python -m experiments.noisy_people_study --body seat --vaf 90 --subjects 20 --out a.jsonl
"""

from __future__ import annotations

import argparse
import functools
import itertools
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from experiments.driver import Row, kept_rows
from experiments.noisy_people import BODIES, NOISES, recorded, subject
from experiments.noisy_people_score import Pairs, Score, passed_over, score
from experiments.summary import clustered, markdown
from impc.assess.covariance import TWO_SIDED
from impc.errors import ImpcError

__all__ = ["HEAD", "cells"]

# A limit that is not reached, and one that is, for each body and VAF; those of a pair are a cart's.
_LIMITS = {
    ("cart", 90.0): (5.0, 0.7),
    ("cart", 70.0): (5.0, 0.7),
    ("seat", 90.0): (70.0, 6.0),
    ("seat", 70.0): (70.0, 9.0),
}
#: Headings of the columns; shares are in % with the standard error of independent subjects.
HEAD = (
    "subjects", "count", "at the limit %", "ended at the truth or above", "converged",
    "error of the gain %: least squares", "likelihood", "95 % holds: least squares",
    "sandwich", "expected", "profile", "noise SDs",
)  # fmt: skip
# Fall of the likelihood at either end of a 95 % interval, nats; a search ended at the truth if it
# is at most so far below it, nats.
_LOWER, _ENDED = TWO_SIDED**2 / 2, 0.5


def cells(study: str, scores: Sequence[Score]) -> list[str]:
    """Row of the table for the subjects of one kind."""
    levels = [zip(one.levels, one.level_intervals, strict=True) for one in scores]
    return [
        study,
        f"{len(scores)}",
        f"{100 * np.mean([one.saturated for one in scores]):.0f}",
        f"{sum(one.above >= -_ENDED for one in scores)}",
        f"{sum(one.converged for one in scores)}",
        f"{100 * np.median([one.least_error for one in scores]):.1f}",
        f"{100 * np.median([one.likely_error for one in scores]):.1f}",
        _share([_inside(one.least) for one in scores]),
        _share([_inside(one.likely) for one in scores]),
        _share([_inside(one.expected) for one in scores]),
        _share([[nats <= _LOWER for nats in one.fell] for one in scores]),
        _share([[low <= level <= high for level, (low, high) in each] for each in levels]),
    ]


def _inside(pairs: Pairs) -> list[bool]:
    return [abs(error) <= TWO_SIDED * deviation for error, deviation in pairs]


def _share(held: list[list[bool]]) -> str:
    share, error = clustered(held)
    return "-" if np.isnan(share) else f"{share:.0f} ± {error:.0f} of {sum(map(len, held))}"


def _row(study: str, seed: int, *, profiled: bool) -> Row:
    """Score of a subject, or why there is none."""
    body, noise, vaf, limit = study.split(", ")
    share, met = float(vaf.removeprefix("VAF ")), limit == "met"
    limits = _LIMITS["seat" if body == "seat" else "cart", share]
    try:
        who = subject(body, seed, noise, share, limits[met])
        trials = recorded(who, seed)
        reason = passed_over(who, trials, seed, met=met) if body == "seat" else ""
        return {"passed": reason} if reason else score(who, trials, profiled=profiled)._asdict()
    except ImpcError as error:  # Most are first fits of a diverged cart
        return {"passed": str(error)}


def main() -> None:
    """Score the subjects that the file does not have, and print the table of the file."""
    parser = argparse.ArgumentParser(description="Coverage on subjects with sensory noise.")
    parser.add_argument("--body", choices=BODIES, default="cart")
    parser.add_argument("--noise", choices=tuple(NOISES), nargs="+", default=list(NOISES))
    parser.add_argument("--vaf", type=float, nargs="+", default=[90.0, 70.0], help="90, 70 or both")
    parser.add_argument(
        "--met", choices=("none met", "met"), nargs="+", default=["none met", "met"]
    )
    parser.add_argument("--subjects", type=int, default=200)
    parser.add_argument("--profiles", action="store_true")
    parser.add_argument("--out", type=Path, default=Path("results", "noisy-people.jsonl"))
    given = parser.parse_args()
    tasks = [
        (f"{given.body}, {noise}, VAF {vaf:g}, {met}", seed)
        for seed, noise, vaf, met in itertools.product(
            range(given.subjects), given.noise, given.vaf, given.met
        )
    ]
    found = kept_rows(given.out, functools.partial(_row, profiled=given.profiles), tasks)
    table, others = [], Counter[str]()
    for study, rows in found.items():
        scored = [row for row in rows if "passed" not in row]
        others.update(f"{study}: {row['passed']}" for row in rows if "passed" in row)
        if scored:
            scores = [Score(**{name: row[name] for name in Score._fields}) for row in scored]
            table.append(cells(study, scores))
    print(markdown(HEAD, table))
    for reason, count in others.items():
        print(f"not scored: {reason}: {count}")


if __name__ == "__main__":
    main()
