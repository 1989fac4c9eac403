"""Run all benchmarks; write results.md and results.json into this folder.

    python -m experiments.benchmarks [--runs 7]

Every number is a ratio of medians measured in turn in this run. About a quarter of an hour.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from tqdm import tqdm

from experiments.benchmarks.fits import fit_rows
from experiments.benchmarks.growth import growth_rows
from experiments.benchmarks.likelihood import likelihood_rows
from experiments.benchmarks.routes import route_rows
from experiments.benchmarks.runner import runner_rows
from experiments.benchmarks.simulation import simulation_rows
from experiments.benchmarks.solvers import solver_rows
from experiments.benchmarks.table import write_tables

_PARTS = {
    "simulation": simulation_rows,
    "solvers": solver_rows,
    "fits": fit_rows,
    "growth": growth_rows,
    "routes": route_rows,
    "likelihood": likelihood_rows,
    "runner": runner_rows,
}


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=7, help="runs of each case (default 7)")
    parser.add_argument("--out", type=Path, default=Path("experiments/benchmarks"))
    chosen = parser.parse_args()
    rows = []
    with tqdm(_PARTS.items()) as parts:
        for name, measure in parts:
            parts.set_description(name)
            rows += measure(chosen.runs)
            written = write_tables(rows, chosen.out, chosen.runs)  # so that no part is lost
    print(written)


if __name__ == "__main__":
    main()
