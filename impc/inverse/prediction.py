"""One-step-ahead predictions: correct the simulated state by the recorded outputs.

    e   = y - C x                innovation, the residual
    x_f = x + M e                corrected state
    u   = controller(x_f)
    x+  = A x_f + B u + E d

M = 0 is the simulation; with the gain M of a stationary Kalman filter e is a one-step prediction
error. The effect of a wrong gain then decays within the memory of the filter: the loop does not
diverge, and the sum of squares has few local minima in K, where that of a simulation has many. The
dynamics are linear in (x_f, u, d, y):

    x_f+ = (I - MC)(A x_f + B u + E d) + M y+,        e = (I - CM)^-1 (y - C x_f)

so the same loop simulates them, with other matrices and y as a further disturbance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg

from impc.arrays import Array
from impc.checking import replace
from impc.control.simulation import Scenario
from impc.inverse.problem import Problem, scenarios

# Process noise on every mode relative to command noise, for modes that B does not reach; the larger
# values are tried if the Riccati equation fails in double precision.
_EVERYWHERE = (1e-9, 1e-6, 1e-3)


@dataclass(frozen=True)
class Correction:
    """Kalman correction for one problem."""

    M: Array  # Gain of the correction (n, p)

    def moves(self, problem: Problem) -> tuple[Array, Array, Array]:
        """A (n, n), B (n, m) and (E, M) (n, columns) of the corrected state."""
        plant, kept = problem.plant, self.kept(problem)
        return kept @ plant.A, kept @ plant.B, np.hstack([kept @ plant.E, self.M])

    def kept(self, problem: Problem) -> Array:
        """I - MC (n, n), the map from simulated to corrected state."""
        return np.asarray(np.eye(problem.plant.n) - self.M @ problem.plant.C)

    def weighting(self, problem: Problem) -> Array:
        """Matrix (p, p) that converts C x_f - y into the residual: inverse and output scales."""
        C = problem.plant.C
        return np.asarray(
            np.linalg.inv(np.eye(len(C)) - C @ self.M) / problem.output_scale[:, None]
        )

    def drives(self, problem: Problem) -> list[Scenario]:
        """Signals that drive each recording: its disturbance, and its outputs one sample later."""
        kept, drives = self.kept(problem), []
        for trial, drive in zip(problem.recordings, scenarios(problem), strict=True):
            y = without_gaps(trial.outputs) - trial.offset
            pushes = np.hstack([drive.disturbance, y[1:]])
            drives.append(replace(drive, x0=kept @ trial.x0 + self.M @ y[0], disturbance=pushes))
        return drives


def without_gaps(outputs: Array) -> Array:
    """Outputs (samples, p) with missing values interpolated; zero if all are missing."""
    filled, places = np.nan_to_num(outputs), np.arange(len(outputs))
    for column, known in enumerate(np.isfinite(outputs).T):
        if np.any(known) and not np.all(known):
            filled[:, column] = np.interp(places, places[known], outputs[known, column])
    return filled


def correction(problem: Problem, ratio: float) -> Correction:
    """Stationary Kalman correction; zero if no stable filter exists.

    Assumes output noise as large as the outputs and command errors of `ratio` times their size: a
    small ratio gives a slow filter with long memory.
    """
    plant, scale = problem.plant, np.asarray(problem.output_scale)
    C, outputs = plant.C / scale[:, None], np.eye(len(scale))
    commands = plant.B * (ratio * command_sizes(problem))
    driving = commands @ commands.T
    for share in _EVERYWHERE:
        floor = share * np.trace(driving) * np.eye(plant.n)
        try:
            P = scipy.linalg.solve_discrete_are(plant.A.T, C.T, driving + floor, outputs)
        except (np.linalg.LinAlgError, ValueError):
            continue
        return Correction(P @ C.T @ np.linalg.inv(C @ P @ C.T + outputs) / scale)
    return Correction(np.zeros((plant.n, len(scale))))


def command_sizes(problem: Problem) -> Array:
    """Size of each input (m,): its bound, or the size that moves the outputs by their scale."""
    plant, scale = problem.plant, np.asarray(problem.output_scale)
    bounds = np.maximum(-problem.bounds.u_min, problem.bounds.u_max)
    if np.all(np.isfinite(bounds)):
        return np.asarray(bounds)
    moved, reach = plant.B, np.zeros(plant.m)
    for _ in range(plant.n + 1):
        reach += np.linalg.norm((plant.C @ moved) / scale[:, None], axis=0)
        moved = plant.A @ moved
    return np.where(np.isfinite(bounds), bounds, 1 / np.where(reach > 0, reach, 1.0))
