"""Coverage of the gain intervals of subjects made by `impc simulate seated-balance`.

Each subject is simulated, written, read and fitted as the commands do it. The script counts the
entries of the true gain inside the printed 95 % intervals, for the nonlinear body and for
`body = "linear"`, and the CPU time of both fits. Results: experiments/nonlinear.md.

    python -m experiments.default_subjects --seeds 20
    python -m experiments.default_subjects --seeds 20 --motor-noise 0.3
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from tqdm import tqdm

from impc.assess.printed_gain import covariance_intervals, gain_estimate
from impc.cli.plant import asked_subject, read_subject
from impc.cli.simulate import command
from impc.inverse.noisy_fit import fit_controller

__all__ = ["Found", "fitted_subject", "simulated_files"]


@dataclass(frozen=True)
class Found:
    """One fit of a simulated subject.

    Attributes
    ----------
    inside : int
        Number of entries of the true gain inside their intervals, of `entries`.
    entries : int
    misfit : float
        2-norm of the residual.
    seconds : float
        CPU time of the fit and of its intervals.
    """

    inside: int
    entries: int
    misfit: float
    seconds: float


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
    inside = sum(bool(item.low <= value <= item.high) for item, value in pairs)
    return Found(inside, len(truth), fitted.misfit, seconds)


def main() -> None:
    """Print a line for each subject, and the shares over all."""
    parser = argparse.ArgumentParser(description="Coverage of the default subject.")
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--motor-noise", default="0", help="Nm")
    parser.add_argument("--beside", type=int, default=20, help="how many with the linear body too")
    given = parser.parse_args()
    found: dict[str, list[Found]] = {"nonlinear": [], "linear": []}
    for seed in tqdm(range(given.first, given.first + given.seeds), unit="subject", disable=None):
        with tempfile.TemporaryDirectory() as folder:
            files = simulated_files(Path(folder, "one"), seed, "--motor-noise", given.motor_noise)
            for body in [*found][: 2 if seed < given.beside else 1]:
                one = fitted_subject(files, body)
                found[body].append(one)
                print(f"seed {seed}, {body}: {one}", flush=True)
    for body, fits in found.items():
        if fits:
            inside, entries = (
                sum(getattr(one, key) for one in fits) for key in ("inside", "entries")
            )
            print(f"{body}: {inside} of {entries} entries inside, {100 * inside / entries:.1f} %")
    pairs = zip(found["nonlinear"], found["linear"], strict=False)
    ratios = [own.seconds / other.seconds for own, other in pairs]
    if ratios:
        least, median, most = np.quantile(ratios, [0, 0.5, 1])
        print(f"CPU time, nonlinear over linear: {median:.2f} ({least:.2f} to {most:.2f})")


if __name__ == "__main__":
    main()
