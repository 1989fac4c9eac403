"""From how many starts the seat's gain is found, by the coordinates in which it is searched."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import scipy.optimize

from experiments.benchmarks.table import Row
from experiments.benchmarks.workloads import Workload, seat
from impc.inverse.direct_and_reduced import start_gains, starting_point
from impc.inverse.residuals import evaluate
from impc.inverse.solution_set import natural_coordinates
from impc.model.riccati import is_stable

if TYPE_CHECKING:
    from pathlib import Path

    from impc.arrays import Array

__all__ = ["search_rows"]

_LIMITS = (4.5, 5.0, 6.0, 70.0)
_BUDGET = 80
_COORDINATES = ("natural coordinates", "raw entries", "raw entries scaled by the Jacobian")


def search_rows(_: int, __: Path) -> list[Row]:
    """Search from the gains of Table 3.1, at several torque limits, in three coordinates."""
    reached = dict.fromkeys(_COORDINATES, 0)
    total = 0
    for limit in _LIMITS:
        work = seat(limit=limit)
        plant = work.problem.plant
        for K, _metric in start_gains(starting_point(work.problem), plant):
            total += 1
            if not is_stable(plant.A - plant.B @ K, discrete=True):
                continue  # no search starts there
            natural, _inputs = natural_coordinates(plant, K)
            eye = np.eye(plant.n)
            for name, basis in zip(_COORDINATES, (natural, eye, eye), strict=True):
                reached[name] += _reaches(work, K, basis, name)
    return [
        Row(
            f"W2 gain found, of {total} searches: {name}",
            "",
            float(count),
            None,
            "",
            f"limits {', '.join(f'{limit:g}' for limit in _LIMITS)} Nm, {_BUDGET} evaluations each",
        )
        for name, count in reached.items()
    ]


def _reaches(work: Workload, start: Array, T: Array, name: str) -> bool:
    problem, metric = work.problem, np.eye(1)
    inverse = np.linalg.inv(T)

    def residual(z: Array) -> Array:
        return evaluate(problem, z[None] @ inverse, metric).residual

    def jacobian(z: Array) -> Array:
        return evaluate(problem, z[None] @ inverse, metric).dK[:, 0] @ inverse.T

    found = scipy.optimize.least_squares(
        residual,
        (start @ T).ravel(),
        jac=jacobian,
        x_scale="jac" if name == _COORDINATES[2] else 1.0,
        max_nfev=_BUDGET,
        ftol=1e-12,
        xtol=1e-12,
        gtol=1e-15,
    )
    error = np.linalg.norm(found.x[None] @ inverse - work.controller.K)
    return bool(error < 1e-6 * np.linalg.norm(work.controller.K))
