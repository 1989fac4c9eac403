"""Gain by regression on recorded commands, at samples with inactive bounds.

    u_t - u_s = -K (x_t - x_s) + noise

x_t are the recorded states, or those of the plant driven by the recorded commands (assumed exact,
initial state fitted to the outputs). Nothing is simulated in closed loop, so white noise of the
subject does not bias the gain; coloured noise, which is correlated with the states, and errors of
x_t do. The fitted controller decides at which samples no bound is active over the horizon.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from impc.arrays import Array, BoolArray, frozen
from impc.control.aims import aim_of
from impc.control.constraint_rows import build_rows, directions
from impc.control.controller import Controller
from impc.errors import DataError, SolverError
from impc.inverse.problem import Problem, controller_for, drive_of, recorded_states
from impc.model.recordings import Recording

# Largest error of the driven plant relative to the 2-norm of the outputs.
_FOLLOWS = 0.5


@dataclass(frozen=True)
class CommandRegression:
    """Gain and the data of its regression."""

    K: Array  # (m, n)
    deviations: list[Array]  # x - x_s of each trial (samples - 1, n); zero where excluded
    residuals: list[Array]  # u + K (x - x_s) - u_s of each trial (samples - 1, m); likewise
    used: int  # Number of samples used


def regress_commands(problem: Problem, gain: Array, metric: Array) -> CommandRegression:
    """Regress the recorded commands; a `gain` (m, n) and `metric` (m, m) define active bounds."""
    if not all(len(trial.commands) for trial in problem.recordings):
        raise DataError(
            "recorded commands are needed", "these files have none",
            "pass Recording(..., commands=...)",
        )  # fmt: skip
    controller = controller_for(problem, gain, metric)
    x, u, used = [], [], 0
    for trial, states in zip(problem.recordings, _states(problem), strict=True):
        aim = aim_of(controller, drive_of(trial, trial.x0), directions(controller, 0))
        away, command = states[:-1], np.array(trial.commands[:-1])
        if len(aim.x):
            away, command = away - aim.x, command - aim.u
        kept = _free(controller, away, aim.taken, aim.held)
        kept &= np.all(np.isfinite(command), axis=1)
        used += int(np.count_nonzero(kept))
        x.append(np.where(kept[:, None], away, 0.0))
        u.append(np.where(kept[:, None], command, 0.0))
    together = np.concatenate(x)
    if used < problem.plant.n or np.linalg.matrix_rank(together) < problem.plant.n:
        raise SolverError(
            "commands",
            f"{used} samples with inactive bounds do not determine a gain",
            "record more samples below the limits",
        )
    K = -np.linalg.lstsq(together, np.concatenate(u))[0].T
    return CommandRegression(
        frozen(K), x, [one + part @ K.T for one, part in zip(u, x, strict=True)], used
    )


def _states(problem: Problem) -> list[Array]:
    """States (samples, n) of every trial: recorded, or of the plant driven by its commands."""
    found = recorded_states(problem.plant, problem.recordings)
    if found is None:
        return [_driven(problem, trial) for trial in problem.recordings]
    back = np.linalg.inv(problem.plant.C)
    return [x - trial.offset @ back.T for x, trial in zip(found, problem.recordings, strict=True)]


def _driven(problem: Problem, trial: Recording) -> Array:
    """States of the linear plant driven by recorded commands; fits unknown initial states."""
    plant, commands = problem.plant, trial.commands[:-1]
    if np.isnan(commands).any():
        raise DataError(
            "commands", "have gaps although not all states are recorded", "fill the gaps"
        )
    pushes = commands @ plant.B.T + drive_of(trial, trial.x0).disturbance @ plant.E.T
    free = np.empty((trial.samples, plant.n, plant.n))
    x = np.empty((trial.samples, plant.n))
    free[0], x[0] = np.eye(plant.n), trial.x0
    with np.errstate(over="ignore", invalid="ignore"):
        for t, push in enumerate(pushes):
            free[t + 1], x[t + 1] = plant.A @ free[t], plant.A @ x[t] + push
    known = np.isfinite(trial.outputs)
    missed = (trial.corrected - x @ plant.C.T)[known]
    searched = problem.searched_states
    if searched and np.all(np.isfinite(free)):
        table = (plant.C @ free[..., :searched])[known]
        start = np.linalg.lstsq(table, missed)[0]
        x += free[..., :searched] @ start
        missed = missed - table @ start
    if not np.linalg.norm(missed) <= _FOLLOWS * np.linalg.norm(trial.outputs[known]):
        raise SolverError(
            "commands",
            "the plant driven by them does not reproduce the recorded outputs",
            "check their sign and unit, or remove them",
        )
    return x


def _free(controller: Controller, away: Array, taken: Array, held: Array) -> BoolArray:
    """Mask of the deviations (samples, n) at which no bound is active over the horizon."""
    rows = build_rows(controller)
    right = np.tile(rows.b, (len(away), 1))
    if len(taken):
        ahead = len(taken) - len(away)
        at = np.arange(len(away))[:, None] + np.minimum(rows.stage, ahead)
        right -= taken[at, rows.family] + held[:, rows.family]
    return np.asarray(np.all(away @ rows.T.T <= right, axis=1))
