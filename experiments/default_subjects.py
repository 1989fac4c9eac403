"""Coverage of the gain intervals of subjects made by `impc simulate seated-balance`.

Each subject is simulated, written, read and fitted as the commands do it. The script counts the
entries of the true gain inside the printed 95 % intervals, for the nonlinear body and for
`body = "linear"`, and the CPU time of both fits. Results: experiments/nonlinear.md.

    python -m experiments.default_subjects --seeds 20
    python -m experiments.default_subjects --seeds 20 --motor-noise 0.3
"""

from __future__ import annotations

import argparse
import functools
import json
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

from experiments.driver import Row, kept_rows
from experiments.summary import clustered
from impc.assess.printed_gain import covariance_intervals, gain_estimate
from impc.cli.plant import asked_subject, read_subject
from impc.cli.simulate import command
from impc.inverse.noisy_fit import fit_controller

__all__ = ["Found", "fitted_subject", "simulated_files"]


class Found(NamedTuple):
    """One fit of a simulated subject."""

    inside: list[bool]  # Whether each entry of the true gain is inside its interval
    misfit: float  # 2-norm of the residual
    seconds: float  # CPU time of the fit and of its intervals


def simulated_files(folder: Path, seed: int, *more: str) -> tuple[Path, ...]:
    """Simulate the default subject of a seed into a folder; return the trial files."""
    given = ["--formats", "csv", "--seed", str(seed), "--out", str(folder), *more]
    command.main(["seated-balance", *given], standalone_mode=False)
    return tuple(sorted(folder.glob("trial_*.csv")))


def fitted_subject(files: tuple[Path, ...], body: str) -> Found:
    """Fit the trials with the given body, and compare with the truth."""
    folder = files[0].parent
    config = folder / f"{body}.toml"
    config.write_text(
        (folder / "subject.toml").read_text().replace("[fit]", f'[fit]\nbody = "{body}"')
    )
    subject = read_subject(asked_subject("fit", files, "seated-balance", config))
    begun = time.process_time()
    fitted = fit_controller(subject.problem)
    estimate = gain_estimate(fitted)
    intervals = covariance_intervals(estimate, estimate.covariance, "sandwich")
    seconds = time.process_time() - begun
    truth = np.ravel(json.loads((folder / "truth.json").read_text())["K"])
    pairs = zip(intervals, truth, strict=True)
    inside = [bool(item.low <= value <= item.high) for item, value in pairs]
    return Found(inside, fitted.misfit, seconds)


def _row(study: str, seed: int, bodies: tuple[str, ...]) -> Row:
    with tempfile.TemporaryDirectory() as folder:
        motor = study.partition(" ")[2]
        files = simulated_files(Path(folder, "one"), seed, "--motor-noise", motor)
        return {body: fitted_subject(files, body)._asdict() for body in bodies}


def main() -> None:
    """Fit the subjects that the file does not have, and print the shares of all."""
    parser = argparse.ArgumentParser(description="Coverage of the default subject.")
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--motor-noise", default="0", help="Nm")
    parser.add_argument("--bodies", nargs="+", default=["nonlinear", "linear"])
    parser.add_argument("--out", type=Path, default=Path("results", "default-subjects.jsonl"))
    given = parser.parse_args()
    study, one = f"motor {given.motor_noise}", functools.partial(_row, bodies=tuple(given.bodies))
    rows = kept_rows(given.out, one, [(study, seed) for seed in range(given.seeds)])[study]
    for body in given.bodies:
        held = [row[body]["inside"] for row in rows if body in row]
        share, error = clustered(held)
        inside = sum(map(sum, held)), sum(map(len, held))
        print(f"{body}: {inside[0]} of {inside[1]} inside, {share:.1f} ± {error:.1f} %")
    both = [row for row in rows if {"nonlinear", "linear"} <= row.keys()]
    if both:
        ratios = [row["nonlinear"]["seconds"] / row["linear"]["seconds"] for row in both]
        least, median, most = np.quantile(ratios, [0, 0.5, 1])
        print(f"CPU time, nonlinear over linear: {median:.2f} ({least:.2f} to {most:.2f})")


if __name__ == "__main__":
    main()
