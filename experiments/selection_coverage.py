"""Coverage of the intervals of selected parameters, on simulated subjects.

    python -m experiments.selection_coverage --people 10 --seeds 0 1

The subjects of `impc simulate head-tracking` vary in all twelve parameters (log-SD 0.25). The
parameters that are not selected are fixed at their typical values, or have a prior with the stated
standard deviation between subjects, or one with a quarter of their range. Results:
experiments/reliability_selection.md.
"""

from __future__ import annotations

import argparse
import itertools
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from click.testing import CliRunner

from experiments.driver import each
from experiments.summary import markdown
from impc.assess.long_run_covariance import white_noise
from impc.cli.main import main as impc
from impc.cli.select import read_model_study
from impc.studies.selection.estimation import estimate, estimate_with_prior, free_indices
from impc.studies.selection.report import read_truths

__all__ = ["coverage"]

#: The subset that `impc select` finds in the subjects of seed 0, and that of the dissertation.
_SUBSETS = (("Kccr", "tau", "tauMS1"), ("Kvis", "Kccr", "tau", "tau1A", "tauCNS1"))
_STATED = ("exactly typical", "stated deviations", "a quarter of the range")


def coverage(task: tuple[int, int, tuple[str, ...]]) -> dict[str, np.ndarray]:
    """For each of `_STATED`: covered, and width over range, shape (subjects, parameters, 2).

    A task is the number of subjects, the seed, and the selected parameters.
    """
    people, seed, names = task
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "data"
        given = ["--subjects", str(people), "--seed", str(seed), "--out", str(folder)]
        done = CliRunner().invoke(impc, ["simulate", "head-tracking", *given])
        assert done.exit_code == 0, done.output
        _, source, recorded, _ = read_model_study(folder / "study.toml", None, False)
        truths = read_truths(folder, source.model)
    model = source.model
    free = free_indices(model, names)
    deviations = (np.zeros(model.size), model.deviation, model.gain / 2)
    rows: dict[str, list[np.ndarray]] = {stated: [] for stated in _STATED}
    for key, trials in recorded.items():
        theta = truths[" visit ".join(key)][list(free)]
        start = np.array(estimate(model, trials, free, np.array(model.typical)).theta)
        for stated, deviation in zip(_STATED, deviations, strict=True):
            other = replace(model, deviation=deviation)
            found = estimate_with_prior(other, trials, free, start, white_noise)
            inside = (found.low <= theta) & (theta <= found.high)
            width = (found.high - found.low) / (2 * model.gain[list(free)])
            rows[stated].append(np.column_stack([inside, width]))
    return {stated: np.array(found) for stated, found in rows.items()}


def main() -> None:
    """Print the share covered, and the median width of each parameter."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--people", type=int, default=10)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    given = parser.parse_args()
    tasks = [(given.people, seed, names) for names in _SUBSETS for seed in given.seeds]
    found, rows = each(coverage, tasks), []
    for names, stated in itertools.product(_SUBSETS, _STATED):
        both = np.concatenate(
            [one[stated] for task, one in zip(tasks, found, strict=True) if task[2] == names]
        )
        held, narrow = both[..., 0], both[both[..., 1] < 1 - 1e-9, 0]
        widths = ", ".join(f"{100 * one:.0f}" for one in np.median(both[..., 1], axis=0))
        shares = [f"{one.sum():.0f} of {one.size}" for one in (held, narrow)]
        rows.append([", ".join(names), stated, *shares, widths])
    print(markdown(["selected", "others", "inside", "without whole ranges", "widths, %"], rows))


if __name__ == "__main__":
    main()
