"""Compare nine methods over noise levels and torque limits.

The linear seat under a torque limit, one trial of 30 s with white noise on the angles. For each
limit (70, 6 and 4.5 Nm: the subject is at it never, in an eighth and in a third of the samples),
noise level and seed, every method of `impc compare` and inverse KKT is fitted. Its controller then
simulates another trial and is compared with the noise-free truth. Finished cells are kept in the
folder, so the same command continues an interrupted run. Results: experiments/noise_study.md.

    python -m experiments.noise_study --out results/noise-study
"""

from __future__ import annotations

import argparse
import itertools
import json
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from tqdm import tqdm

from experiments.benchmarks.workloads import seat
from experiments.inverse_kkt import INVERSE_KKT
from impc.assess.variance_accounted_for import vaf
from impc.checking import replace
from impc.control.closed_loop import simulate
from impc.inverse.methods import METHODS, fit
from impc.inverse.problem import controller_for
from impc.inverse.solution_set import natural_coordinates
from impc.model.recordings import Recording
from impc.reporting.rendering import plain
from impc.reporting.style import (
    BLUE,
    GREEN,
    HALF,
    INK,
    VERMILLION,
    new_figure,
    page_style,
    render,
)
from impc.reporting.writer import write_files
from impc.studies.compare.subject import compared_methods
from impc.studies.fit.asked import fit_problem
from impc.studies.fit.settings import FitSettings

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from impc.arrays import Array
    from impc.control.simulation import Scenario
    from impc.inverse.estimates import Estimate
    from impc.inverse.problem import Problem

__all__ = ["COMPARED", "Cell", "Outcome", "study_cell"]

#: The methods by name: those of `impc compare`, and inverse KKT.
COMPARED = {name: METHODS[name] for name in compared_methods()} | {"inverse_kkt": INVERSE_KKT}

_LIMITS = (70.0, 6.0, 4.5)
_CEILINGS = (99.99, 99.0, 90.0, 70.0, 50.0)
# Colour, marker and line style of each method: colours for families, markers within a family.
_MARKS = {
    "feedback_gain": (INK, "o", ":"),
    "inverse_lqr_gradient": (BLUE, "s", "--"),
    "inverse_lqr_auxiliary": (BLUE, "^", "--"),
    "inverse_lqr_output": (BLUE, "D", "--"),
    "inverse_lqr_lmi": (BLUE, "x", "--"),
    "clipped_lqr": (BLUE, "*", "--"),
    "inverse_kkt": (GREEN, "v", "-."),
    "inverse_mpc_reduced": (VERMILLION, "P", "-"),
    "inverse_mpc": (VERMILLION, "o", "-"),
}


@dataclass(frozen=True)
class Cell:
    """One simulated subject: torque limit (Nm), VAF of the true controller (%), seed."""

    limit: float
    ceiling: float
    seed: int

    @property
    def name(self) -> str:
        """Name of the result file."""
        return f"{self.limit:g}Nm-{self.ceiling:g}-{self.seed}"


@dataclass(frozen=True)
class Outcome:
    """One method in one cell.

    Attributes
    ----------
    vaf : float or None
        VAF of another trial without noise, mean over outputs, %; None without a gain, or if the
        simulation diverges.
    gain_error : float or None
        ||(K - K_true) T|| / ||K_true T||, in whitened coordinates of the truth.
    has_weights : bool
    seconds : float
    reason : str
    """

    vaf: float | None
    gain_error: float | None
    has_weights: bool
    seconds: float
    reason: str


def study_cell(cell: Cell) -> dict[str, Outcome]:
    """Fit every method to a noisy trial, and evaluate it on another trial without noise."""
    work = seat(2, 30.0, cell.limit)
    plant, (clean, unseen) = work.problem.plant, work.problem.recordings
    rng = np.random.default_rng([cell.seed, round(100 * cell.ceiling), round(10 * cell.limit)])
    share = (100 - cell.ceiling) / cell.ceiling
    size = np.sqrt(share * np.mean(clean.outputs**2, axis=0))
    noisy = clean.outputs + size * rng.standard_normal(clean.outputs.shape)
    trial = Recording(plant, noisy, clean.disturbance)
    problem = fit_problem(plant, [trial], FitSettings(u_max=cell.limit))
    truth = np.array(work.controller.K)
    judged = replace(work.problem, recordings=(unseen,))
    start = fit(problem)
    return {
        name: _judge(method.estimate(problem, start), judged, work.drives[1], truth)
        for name, method in COMPARED.items()
    }


def _judge(estimate: Estimate, unseen: Problem, drive: Scenario, truth: Array) -> Outcome:
    if estimate.K is None:
        return Outcome(None, None, False, estimate.seconds, estimate.reason)
    K, plant = np.array(estimate.K), unseen.plant
    T, _ = natural_coordinates(plant, truth)
    error = float(np.linalg.norm((K - truth) @ T) / np.linalg.norm(truth @ T))
    run = simulate(
        controller_for(COMPARED[estimate.method].restrict(unseen), K, np.array(estimate.S)), drive
    )
    share = None
    if run.complete:
        share = float(np.mean(vaf(unseen.recordings[0].outputs, run.x @ plant.C.T)))
    return Outcome(share, error, estimate.weights is not None, estimate.seconds, estimate.reason)


def _run(cells: list[Cell], out: Path) -> dict[str, dict[str, Outcome]]:
    """Read finished cells from the folder; compute and keep the others."""
    kept = out / "cells"
    found: dict[str, dict[str, Outcome]] = {}
    for cell in cells:
        path = kept / f"{cell.name}.json"
        if path.exists():
            content = json.loads(path.read_text())
            found[cell.name] = {name: Outcome(**values) for name, values in content.items()}
    left = [cell for cell in cells if cell.name not in found]
    with (
        ProcessPoolExecutor(2) as pool,
        tqdm(total=len(cells), initial=len(found), unit="subject", disable=None) as bar,
    ):
        pending = {pool.submit(study_cell, cell): cell for cell in left}
        try:
            for done in as_completed(pending):
                cell, outcomes = pending[done], done.result()
                content = plain({name: asdict(item) for name, item in outcomes.items()})
                write_files(kept, {f"{cell.name}.json": json.dumps(content).encode()})
                found[cell.name] = outcomes
                bar.update()
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    return found


def _median(
    found: dict[str, dict[str, Outcome]], limit: float, ceiling: float, seeds: int, name: str
) -> tuple[float, float, int]:
    """Median VAF (a fall counts as 0) and gain error over seeds, and the number with a gain."""
    cells = [Cell(limit, ceiling, seed).name for seed in range(seeds)]
    items = [found[cell][name] for cell in cells if name in found[cell]]
    usable = [item for item in items if item.gain_error is not None]
    if not usable:
        return float("nan"), float("nan"), 0
    shares = [0.0 if item.vaf is None else max(item.vaf, 0.0) for item in usable]
    errors = [item.gain_error for item in usable if item.gain_error is not None]
    return float(np.median(shares)), float(np.median(errors)), len(usable)


def _table(found: dict[str, dict[str, Outcome]], seeds: int) -> str:
    lines = []
    for limit in _LIMITS:
        lines += [
            f"\nlimit {limit:g} Nm: VAF % of an unseen trial without noise (error of the gain)",
            f"{'VAF of the truth':<38}" + "".join(f"{ceiling:>15.2f} %" for ceiling in _CEILINGS),
        ]
        for name, method in COMPARED.items():
            cells = []
            for ceiling in _CEILINGS:
                share, error, count = _median(found, limit, ceiling, seeds, name)
                text = f"{share:.2f} ({error:.2g})" if count else "none"
                cells.append(f"{text:>17}")
            lines.append(f"{method.label:<38}{''.join(cells)}")
    return "\n".join(lines)


def _figure(found: dict[str, dict[str, Outcome]], seeds: int) -> Figure:
    figure = new_figure(HALF, 3.2)
    axes = figure.subplots(1, len(_LIMITS), sharey=True)
    noise = [100 - ceiling for ceiling in _CEILINGS]
    for position, (ax, limit) in enumerate(zip(axes, _LIMITS, strict=True)):
        for name, method in COMPARED.items():
            color, marker, line = _MARKS[name]
            missed = [100 - _median(found, limit, ceiling, seeds, name)[0] for ceiling in _CEILINGS]
            ax.loglog(
                noise,
                np.maximum(missed, 1e-3),
                color=color,
                marker=marker,
                linestyle=line,
                markerfacecolor="white",
                label=method.label,
            )
        ax.set_title(f"({'ABC'[position]}) limit {limit:g} Nm", loc="left")
        ax.set_xlabel("noise (% of the variance)")
    axes[0].set_ylabel("missed on an unseen trial\n(% of the variance)")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=3)
    return figure


def main() -> None:
    """Run the study, print the table, and write figure and result.json."""
    parser = argparse.ArgumentParser(description="Methods over noise and saturation.")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--out", type=Path, default=Path("results", "noise-study"))
    given = parser.parse_args()
    cells = [Cell(*item) for item in itertools.product(_LIMITS, _CEILINGS, range(given.seeds))]
    try:
        found = _run(cells, given.out)
    except KeyboardInterrupt:
        print(f"interrupted; finished cells are kept in {given.out / 'cells'}")
        return
    print(_table(found, given.seeds))
    content: Any = plain(
        {cell: {name: asdict(item) for name, item in row.items()} for cell, row in found.items()}
    )
    files = {"result.json": (json.dumps(content, indent=1) + "\n").encode()}
    with page_style():
        files["noise-study.png"] = render(_figure(found, given.seeds), "png")
    write_files(given.out, files)
    print(f"\nwritten to {given.out}")


if __name__ == "__main__":
    main()
