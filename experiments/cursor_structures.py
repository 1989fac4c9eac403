"""Test three cost structures of people who follow a blurred target, blur by blur.

The cost contains the command and the error alone; error and velocity of the cursor; or error,
velocity and effort (the acceleration of the hand). Each structure is fitted with delay and lag,
tested, and evaluated on held-out trials. The cost weight of velocity is given relative to that of
the error, in s^2, with its profile interval. Results: experiments/cursor_tracking.md.

    python -m experiments.cursor_structures --out results/cursor-structures
"""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from tqdm import tqdm

from experiments.cursor_data import Condition, data_file, read_conditions
from experiments.cursor_tracking import condition_problem
from impc.assess.covariance import gain_covariance
from impc.assess.structured_weights import tangent
from impc.assess.structures import StructureFit, assess_structure
from impc.assess.variance_accounted_for import (
    innovation_roots,
    innovations_criterion,
    predicted,
    vaf,
)
from impc.assess.weight_profiles import WeightProfiles
from impc.control.closed_loop import simulate
from impc.errors import SolverError, WeightsError
from impc.inverse.noisy_fit import fit_controller
from impc.inverse.problem import scenarios
from impc.inverse.structured import fit_structured
from impc.model.structure import Structure
from impc.reporting.rendering import plain
from impc.reporting.writer import write_files

if TYPE_CHECKING:
    from impc.inverse.estimates import Estimate
    from impc.inverse.problem import Problem

__all__ = ["STRUCTURES", "StructureRow", "structure_rows"]

#: Name -> penalised features of the state.
STRUCTURES = {
    "error": ["error"],
    "error, velocity": ["error", "velocity"],
    "error, velocity, effort": ["error", "velocity", "acceleration"],
}


@dataclass(frozen=True)
class StructureRow:
    """One structure at one blur.

    Attributes
    ----------
    blur : float
        Blur of the target, px.
    structure : str
        A key of `STRUCTURES`.
    reason : str
        Reason without a fit; empty otherwise.
    refused : bool
        Whether the structure is rejected at 5 %.
    probability : float
        p value of the test.
    freedom : int
        Directions of the gain that are tested.
    vaf, held_out : float
        VAF of all trials, and mean over held-out trials, %.
    aic : float
        Akaike's criterion; lower is better.
    cost_weights : list of float
        Cost weights at R = 1.
    velocity, low, high : float
        Cost weight of velocity over that of the error, and its 95 % interval, s^2; or NaN.
    """

    blur: float
    structure: str
    reason: str
    refused: bool
    probability: float
    freedom: int
    vaf: float
    held_out: float
    aic: float
    cost_weights: list[float]
    velocity: float
    low: float
    high: float


def structure_rows(condition: Condition) -> list[StructureRow]:
    """Fit every structure to the trials of a condition."""
    problem = condition_problem(condition)
    near = fit_controller(problem)
    rows = [_any_weights(condition.blur, problem, near)]
    for name, features in STRUCTURES.items():
        structure = Structure(problem.plant, features, name=name)
        try:
            found = fit_structured(problem, structure, near)
            fit = assess_structure(problem, structure, found, near, 1.0, held_out=True)
        except (SolverError, WeightsError) as error:
            nothing = float("nan")
            rows.append(
                StructureRow(
                    condition.blur, name, str(error), True, nothing, 0, nothing, nothing, nothing,
                    [], nothing, nothing, nothing,
                )
            )  # fmt: skip
            continue
        rows.append(_row(condition.blur, name, fit))
    return rows


def _any_weights(blur: float, problem: Problem, near: Estimate) -> StructureRow:
    """Row of the unrestricted fit."""
    runs = [simulate(near.controller(), drive) for drive in scenarios(near.problem)]
    simulated = np.concatenate([run.x @ near.problem.plant.C.T for run in runs])
    recorded = np.concatenate([trial.outputs for trial in problem.recordings])
    held = []
    for index, trial in enumerate(problem.recordings):
        other = fit_controller(problem.leaving_out(index), near.stage_weights)
        pair = np.array(other.gain), np.array(other.metric)
        held.append(predicted(other.problem, *pair, trial, 1.0).vaf)
    at = near.problem, np.array(near.gain), np.array(near.metric)
    identified = int(np.count_nonzero(gain_covariance(*at).identified))
    roots = innovation_roots(near)
    nothing = float("nan")
    return StructureRow(
        blur, "any weights", "", False, nothing, 0, float(vaf(recorded, simulated)[0]),
        float(np.mean(held)), innovations_criterion(near, roots, identified), [], nothing,
        nothing, nothing,
    )  # fmt: skip


def _row(blur: float, name: str, fit: StructureFit) -> StructureRow:
    assert fit.test is not None
    assert fit.estimate is not None
    return StructureRow(
        blur,
        name,
        "",
        fit.refused,
        fit.test.probability,
        fit.test.freedom,
        float(fit.vaf[0]),
        float(fit.held_out[0]),
        fit.aic,
        np.exp(np.array(fit.estimate.cost_weights)).tolist(),
        *_velocity(fit),
    )


def _velocity(fit: StructureFit) -> tuple[float, float, float]:
    """Cost weight of velocity over that of the error, with its interval."""
    estimate, covariance = fit.estimate, fit.covariance
    if estimate is None or covariance is None or "velocity" not in fit.structure.labels:
        return (float("nan"),) * 3
    at = tangent(fit.structure, estimate.problem, np.array(estimate.cost_weights))
    profiles, row = WeightProfiles(at, covariance), np.zeros(fit.structure.count)
    error, velocity = (fit.structure.labels.index(name) for name in ("error", "velocity"))
    cost_weights = np.array(estimate.cost_weights)
    if not np.isfinite(cost_weights[velocity]):
        high = profiles.zero(velocity).high - cost_weights[error]
        return 0.0, 0.0, float(np.exp(high))
    row[velocity], row[error] = 1.0, -1.0
    found = profiles.interval(row)
    return tuple(float(np.exp(end)) for end in (found.value, found.low, found.high))  # type: ignore[return-value]


def _table(rows: list[StructureRow]) -> str:
    lines = [
        "| blur, px | structure | rejected at 5 % | p | VAF, % | held out, % | criterion "
        "| velocity over error, s^2 (95 %) |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        ratio = "-"
        if np.isfinite(row.velocity):
            ratio = f"{row.velocity:.2g} ({row.low:.2g} to {row.high:.2g})"
        word = row.reason or ("rejected" if row.refused else "no")
        word = "-" if row.structure == "any weights" else word
        lines.append(
            f"| {row.blur:g} | {row.structure} | {word} | {row.probability:.2g} | {row.vaf:.1f} | "
            f"{row.held_out:.1f} | {row.aic:.0f} | {ratio} |"
        )
    return "\n".join(lines) + "\n"


def main() -> None:
    """Write the table and result.json."""
    parser = argparse.ArgumentParser(description="Cost structures of target tracking.")
    parser.add_argument("--out", type=Path, default=Path("results/cursor-structures"))
    out: Path = parser.parse_args().out
    rows = list[StructureRow]()
    for condition in tqdm(read_conditions(data_file()), disable=None):
        rows += structure_rows(condition)
        table = _table(rows)
        numbers = json.dumps([plain(asdict(row)) for row in rows], indent=1) + "\n"
        write_files(out, {"table.md": table.encode(), "result.json": numbers.encode()})
    print(_table(rows))


if __name__ == "__main__":
    main()
