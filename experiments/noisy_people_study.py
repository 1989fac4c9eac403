"""Coverage of least squares and maximum likelihood on subjects with sensory noise.

The subjects are those of `noisy_people`. Each line that is written is one subject, of each kind in
turn, so a run can be interrupted, continued and summarised.
Results: experiments/output_feedback.md.

    python -m experiments.noisy_people_study run --subjects 200 --out a.jsonl
    python -m experiments.noisy_people_study run --body seat --vaf 90 --subjects 20 --out b.jsonl
    python -m experiments.noisy_people_study sum a.jsonl b.jsonl
"""

from __future__ import annotations

import argparse
import itertools
import json
from dataclasses import asdict
from pathlib import Path

from experiments.noisy_people import BODIES, NOISES, recorded, subject
from experiments.noisy_people_score import LIMITS, Score, passed_over, score
from experiments.noisy_people_table import pooled, table
from impc.errors import ImpcError

# Digits kept of each number.
_DIGITS = 4


def _run(given: argparse.Namespace) -> None:
    path = Path(given.out)
    path.parent.mkdir(parents=True, exist_ok=True)
    done = set()
    if path.exists():
        kept = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
        done = {(one["study"], one["seed"]) for one in kept}
    kinds = list(itertools.product(given.noise, given.vaf, given.met))
    with path.open("a", encoding="utf-8") as file:
        for seed, (noise, share, met) in itertools.product(
            range(given.first, given.first + given.subjects), kinds
        ):
            study = f"{given.body}, {noise}, VAF {share:g}, {'met' if met else 'none met'}"
            if (study, seed) in done:
                continue
            try:
                who = subject(given.body, seed, noise, share, LIMITS[given.body, share][met])
                trials = recorded(who, seed)
                reason = passed_over(who, trials, seed, met=met) if given.body == "seat" else ""
                line = {"study": study, "seed": seed, "passed": reason}
                if not reason:
                    line = asdict(score(who, trials, study, seed, profiled=given.profiles))
            except ImpcError as error:  # Most are first fits of a diverged cart
                line = {"study": study, "seed": seed, "reason": str(error)}
            file.write(json.dumps(_short(line)) + "\n")
            file.flush()


def _short(value: object) -> object:
    """Round all numbers."""
    if isinstance(value, float):
        return float(f"{value:.{_DIGITS}g}")
    if isinstance(value, dict):
        return {name: _short(item) for name, item in value.items()}
    return [_short(item) for item in value] if isinstance(value, (list, tuple)) else value


def _sum(given: argparse.Namespace) -> None:
    scores: dict[str, list[Score]] = {}
    others: dict[str, int] = {}
    for name in given.files:
        for line in Path(name).read_text(encoding="utf-8").splitlines():
            found = json.loads(line)
            why = found.get("reason") or found.get("passed")
            if why:
                others[f"{found['study']}: {why}"] = others.get(f"{found['study']}: {why}", 0) + 1
            else:
                scores.setdefault(found["study"], []).append(Score(**found))
    for line in table(list(scores.values())):
        print(line)
    print()
    for body, met in itertools.product(BODIES, ("none met", "met")):
        ends = f"{body}, ", f", {met}"
        people = [
            each
            for name, each in scores.items()
            if name.startswith(ends[0]) and name.endswith(ends[1])
        ]
        if people:
            print(f"{body}, {met}: {pooled(people)}")
    for reason, count in others.items():
        print(f"not scored: {reason}: {count}")


def main() -> None:
    """Run a study, or summarise result files."""
    parser = argparse.ArgumentParser(description="Coverage on subjects with sensory noise.")
    which = parser.add_subparsers(required=True)
    run = which.add_parser("run")
    run.add_argument("--body", choices=BODIES, default="cart")
    run.add_argument("--noise", choices=tuple(NOISES), nargs="+", default=list(NOISES))
    run.add_argument("--vaf", type=float, nargs="+", default=[90.0, 70.0])
    run.add_argument("--met", type=int, nargs="+", choices=(0, 1), default=[0, 1])
    run.add_argument("--first", type=int, default=0)
    run.add_argument("--subjects", type=int, default=200)
    run.add_argument("--profiles", action="store_true")
    run.add_argument("--out", required=True)
    run.set_defaults(run=_run)
    summed = which.add_parser("sum")
    summed.add_argument("files", nargs="+")
    summed.set_defaults(run=_sum)
    given = parser.parse_args()
    given.run(given)


if __name__ == "__main__":
    main()
