"""Does a fit find the truth of the subjects that `impc simulate seated-balance` makes?.

Each is simulated, written, read and fitted as the commands do it; counted are the entries of the
true gain inside the 95 % intervals that the page prints. Beside it the same recordings with
`body = "linear"`: how many are inside then, and the CPU time of either fit.

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
from impc.cli.plant import read_subject
from impc.cli.simulate import command
from impc.inverse.noisy_fit import fit_controller

__all__ = ["Found", "fitted_subject", "simulated_files"]


@dataclass(frozen=True)
class Found:
    """One fit of a simulated subject.

    Attributes
    ----------
    inside : int
        Entries of the true gain inside their intervals, of `entries`.
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
    """Trials of the default subject of a seed in a folder, with subject.toml and truth.json."""
    given = ["--formats", "csv", "--seed", str(seed), "--out", str(folder), *more]
    command.main(["seated-balance", *given], standalone_mode=False)
    return tuple(sorted(folder.glob("trial_*.csv")))


def fitted_subject(files: tuple[Path, ...], body: str) -> Found:
    """Fit the trials with the body that is asked for, and compare with their truth."""
    folder = files[0].parent
    config = folder / f"{body}.toml"
    config.write_text(
        (folder / "subject.toml").read_text().replace("[fit]", f'[fit]\nbody = "{body}"')
    )
    subject = read_subject("fit", files, "seated-balance", config)
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
    """Print a line a subject, and the shares over all of them."""
    parser = argparse.ArgumentParser(description="Fits of the default subject beside its truth.")
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--motor-noise", default="0", help="Nm")
    parser.add_argument("--beside", type=int, default=20, help="of them with the linear body too")
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
