"""The same problem sample by sample: where a search that compares whole trajectories begins anew.

The misfit of a simulated trial has local minima, and gains that fall within it, because an error
at one sample is carried into all that follow. From one sample to the next nothing is carried:

    x_k  as recorded,    u_k = controller(x_k),    x_{k+1} = A x_k + B u_k + E d_k

is compared with the recording at k + 1 only. With noise the answer is biased (x_k is on both sides
of the equation), so it is a start and no result. Of random problems with three inputs whose exact
recordings no search over trajectories explains, three in four are explained from here
(docs/fitting.md).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import scipy.optimize

from impc.arrays import Array, frozen
from impc.checking import replace
from impc.inverse.smoothing import smoothed_trials

if TYPE_CHECKING:
    from impc.inverse.problem import Problem

__all__ = ["follows_plant", "one_step", "regressed_gain"]

# Samples looked at, evenly spread: a search takes their number times 0.1 ms an evaluation.
_MOST = 150
# Of the states: noise that a laboratory would call none is above, rounding in files is below.
_FOLLOWS = 1e-6
# A command this near to its bound, of the largest, counts as at it.
_AT_BOUND = 1e-6


def one_step(problem: Problem) -> Problem:
    """Return the problem whose recordings are pairs of neighbouring samples, starts known.

    States are those of the outputs where these determine them, otherwise smoothed ones.
    """
    states = _recorded_states(problem)
    if states is None:
        states = [np.array(item.x) for item in smoothed_trials(problem)]
    places = [(i, k) for i, x in enumerate(states) for k in range(len(x) - 1)]
    pairs = []
    for i, k in places[:: -(-len(places) // _MOST)]:
        trial, mine = problem.recordings[i], slice(k, k + 2)
        pairs.append(
            replace(
                trial,
                outputs=trial.outputs[mine],
                disturbance=trial.disturbance[mine],
                x0=frozen(states[i][k]),
            )
        )
    return replace(
        problem,
        recordings=tuple(pairs),
        unknown_start=False,
        family=None,
        logarithms=frozen(np.zeros(0)),
    )


def follows_plant(problem: Problem) -> bool:
    """Whether the outputs are states that the plant can follow exactly, by some inputs."""
    plant, states = problem.plant, _recorded_states(problem)
    if states is None:
        return False
    left = np.linalg.svd(plant.B)[0][:, np.linalg.matrix_rank(plant.B) :]
    missed, size = 0.0, 0.0
    for x, trial in zip(states, problem.recordings, strict=True):
        rest = x[1:] - x[:-1] @ plant.A.T - trial.disturbance[:-1] @ plant.E.T
        missed += float(np.sum((rest @ left) ** 2))
        size += float(np.sum(x**2))
    return missed <= _FOLLOWS**2 * size


def regressed_gain(problem: Problem) -> Array | None:
    """The gain (m, n) of most samples: the commands' least sum of absolute values of u + K x.

    At a sample from which no bound is met within the horizon the command is -K x exactly; where
    these are the most, the others do not count in a sum of absolute values. None where the outputs
    do not determine states and commands, or no command is inside its bounds.
    """
    plant, states = problem.plant, _recorded_states(problem)
    if states is None or np.linalg.matrix_rank(plant.B) < plant.m:
        return None
    pairs = list(zip(states, problem.recordings, strict=True))
    rest = [x[1:] - x[:-1] @ plant.A.T - trial.disturbance[:-1] @ plant.E.T for x, trial in pairs]
    commands = np.concatenate(rest) @ np.linalg.pinv(plant.B).T
    x = np.concatenate([item[:-1] for item in states])
    low, high = np.array(problem.bounds.u_min), np.array(problem.bounds.u_max)
    size = np.max(np.abs(commands), axis=0)
    inside = np.all((commands > low + _AT_BOUND * size) & (commands < high - _AT_BOUND * size), 1)
    chosen = np.flatnonzero(inside)[:: max(1, int(np.count_nonzero(inside)) // _MOST)]
    unit = np.max(np.abs(x), axis=0)
    if len(chosen) < plant.n or np.any(unit == 0) or np.any(size == 0):
        return None
    x, commands = x[chosen] / unit, commands[chosen] / size
    rows = [_least_absolute(x, command) for command in commands.T]
    return np.asarray(np.array(rows) * size[:, None] / unit)


def _least_absolute(x: Array, u: Array) -> Array:
    """k of the least sum |u + x k|: the linear program with its parts above and below zero."""
    samples, n = x.shape
    cost = np.concatenate([np.zeros(n), np.ones(2 * samples)])
    equations = np.hstack([x, np.eye(samples), -np.eye(samples)])
    limits = [(None, None)] * n + [(0, None)] * (2 * samples)
    found = scipy.optimize.linprog(cost, A_eq=equations, b_eq=-u, bounds=limits, method="highs")
    return np.zeros(n) if found.x is None else np.asarray(found.x[:n])


def _recorded_states(problem: Problem) -> list[Array] | None:
    C = problem.plant.C
    if C.shape[0] != C.shape[1] or np.linalg.matrix_rank(C) < len(C):
        return None
    return [
        np.asarray(np.linalg.solve(C, trial.outputs.T).T, dtype=np.float64)
        for trial in problem.recordings
    ]
