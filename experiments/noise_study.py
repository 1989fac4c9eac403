"""Compare nine methods over noise levels and torque limits.

The linear seat under a torque limit, one trial of 30 s with white noise on the angles. For each
limit (70, 6 and 4.5 Nm: the subject is at it never, in an eighth and in a third of the samples),
noise level and seed, every method of `impc compare` and inverse KKT is fitted. Its controller then
simulates another trial and is compared with the noise-free truth. Finished subjects are kept in the
folder, so the same command continues an interrupted run. Results: experiments/noise_study.md.

    python -m experiments.noise_study --out results/noise-study
"""

from __future__ import annotations

import argparse
import itertools
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from experiments.benchmarks.workloads import seat
from experiments.driver import Row, kept_rows, noisy
from experiments.inverse_kkt import INVERSE_KKT
from experiments.summary import markdown
from impc.arrays import Array
from impc.assess.variance_accounted_for import vaf
from impc.checking import replace
from impc.control.closed_loop import simulate
from impc.control.simulation import Scenario
from impc.inverse.estimates import Estimate
from impc.inverse.methods import METHODS, fit
from impc.inverse.problem import Problem, controller_for
from impc.inverse.solution_set import natural_coordinates
from impc.model.recordings import Recording
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

__all__ = ["COMPARED", "study_cell"]

#: The methods by name: those of `impc compare` that need no recorded commands, and inverse KKT.
COMPARED = {name: METHODS[name] for name in compared_methods() if name != "command_regression"}
COMPARED["inverse_kkt"] = INVERSE_KKT

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


def study_cell(limit: float, ceiling: float, seed: int) -> Row:
    """Fit every method to a noisy trial, and evaluate it on another trial without noise.

    Torque limit in Nm, VAF of the true controller in %. By method: whether it has a `gain`, the
    `missed` share of the variance of the other trial, mean over outputs, % (100 if the simulation
    diverges), and the gain's `error` ||(K - K_true) T|| / ||K_true T|| in whitened coordinates.
    """
    work = seat(2, 30.0, limit)
    plant, (clean, unseen) = work.problem.plant, work.problem.recordings
    rng = np.random.default_rng([seed, round(100 * ceiling), round(10 * limit)])
    noise = rng.standard_normal(clean.outputs.shape)
    outputs = noisy(np.array(clean.outputs), (100 - ceiling) / ceiling, noise)
    trial = Recording(plant, outputs, clean.disturbance)
    problem = fit_problem(plant, [trial], FitSettings(u_max=limit))
    truth = np.array(work.controller.K)
    judged = replace(work.problem, recordings=(unseen,))
    start = fit(problem)
    return {
        name: _judge(method.estimate(problem, start), judged, work.drives[1], truth)
        for name, method in COMPARED.items()
    }


def _judge(estimate: Estimate, unseen: Problem, drive: Scenario, truth: Array) -> Row:
    if estimate.K is None:
        return {"gain": False, "missed": np.nan, "error": np.nan}
    K, plant = np.array(estimate.K), unseen.plant
    T, _ = natural_coordinates(plant, truth)
    error = float(np.linalg.norm((K - truth) @ T) / np.linalg.norm(truth @ T))
    run = simulate(
        controller_for(COMPARED[estimate.method].restrict(unseen), K, np.array(estimate.S)), drive
    )
    share = 0.0
    if run.complete:
        share = float(np.mean(vaf(unseen.recordings[0].outputs, run.x @ plant.C.T)))
    return {"gain": True, "missed": 100 - max(share, 0.0), "error": error}


def _cell(study: str, seed: int) -> Row:
    limit, ceiling = map(float, study.split())
    return study_cell(limit, ceiling, seed)


def _median(rows: list[Row], name: str) -> tuple[float, float]:
    """Median missed share and gain error over the seeds with a gain; NaN without any."""
    found = [(row[name]["missed"], row[name]["error"]) for row in rows if row[name]["gain"]]
    missed, error = np.median(found, axis=0) if found else (np.nan, np.nan)
    return float(missed), float(error)


def _tables(found: dict[str, list[Row]]) -> str:
    texts = []
    for limit in _LIMITS:
        rows = []
        for name, method in COMPARED.items():
            medians = [_median(found[f"{limit} {ceiling}"], name) for ceiling in _CEILINGS]
            cells = [f"{100 - missed:.2f} ({error:.2g})" for missed, error in medians]
            rows.append([method.label, *(cell if "nan" not in cell else "none" for cell in cells)])
        head = [f"limit {limit:g} Nm", *(f"VAF of the truth {ceiling} %" for ceiling in _CEILINGS)]
        texts.append(markdown(head, rows))
    return "VAF % of an unseen trial without noise (error of the gain)\n\n" + "\n\n".join(texts)


def _figure(found: dict[str, list[Row]]) -> Figure:
    figure = new_figure(HALF, 3.2)
    axes = figure.subplots(1, len(_LIMITS), sharey=True)
    noise = [100 - ceiling for ceiling in _CEILINGS]
    for position, (ax, limit) in enumerate(zip(axes, _LIMITS, strict=True)):
        for name, method in COMPARED.items():
            color, marker, line = _MARKS[name]
            missed = [_median(found[f"{limit} {ceiling}"], name)[0] for ceiling in _CEILINGS]
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
    """Run the study, print the tables, and write the figure."""
    parser = argparse.ArgumentParser(description="Methods over noise and saturation.")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--out", type=Path, default=Path("results", "noise-study"))
    given = parser.parse_args()
    studies = [f"{limit} {ceiling}" for limit, ceiling in itertools.product(_LIMITS, _CEILINGS)]
    tasks = itertools.product(studies, range(given.seeds))
    found = kept_rows(given.out / "subjects.jsonl", _cell, tasks)
    print(_tables(found))
    with page_style():
        write_files(given.out, {"noise-study.png": render(_figure(found), "png")})
    print(f"\nwritten to {given.out}")


if __name__ == "__main__":
    main()
