"""Exact recordings of all states: the gain by regression on samples that no bound reaches.

From a sample at which no bound is met within the horizon the plan is the gain's, so that

    x_{k+1} - A x_k - E d_k  =  -B K x_k

exactly. Any n of them give B K, and to how many of the others it applies shows whether they were
such: runs of neighbours are tried, since they come in runs, and sets from anywhere. The metric is
then one of the family that weights can have with this gain (`consistent_metrics`). With noise
there are no such samples, and no start from here (docs/theory.md, section 2).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Array, BoolArray
from impc.inverse.explaining_weights import fitted_metric, metric_family
from impc.inverse.prediction import command_sizes
from impc.inverse.problem import recorded_states

if TYPE_CHECKING:
    from impc.inverse.problem import Problem

# A command this near to its bound counts as at it, and of the commands: what exact samples leave.
_AT_BOUND, _EXACT = 1e-6, 1e-8
# Of the states: what the plant cannot do, and below which a sample says nothing.
_FOLLOWS, _NOTHING = 1e-7, 1e-9
# Runs of neighbours and sets from anywhere that are tried, and how many others must follow.
_MOST, _MORE = 500, 3


def pair_of_inactive_samples(problem: Problem) -> tuple[Array, Array] | None:
    """Gain (m, n) and metric (m, m) of exact recordings of all states; None of any others."""
    states = recorded_states(problem.plant, problem.recordings)
    if states is None:
        return None
    gain = _regressed(problem, states)
    if gain is None:
        return None
    family = metric_family(problem.plant, gain)
    if family is None:
        return None
    known = problem.at(np.array([x[0] for x in states]), np.array(problem.logarithms))
    return gain, family.metric(fitted_metric(known, gain, family))


def _regressed(problem: Problem, states: list[Array]) -> Array | None:
    """The gain (m, n) that most samples follow; redundant inputs share by their size."""
    plant = problem.plant
    sizes = command_sizes(problem)
    B = plant.B * sizes  # commands over their sizes
    back = np.linalg.pinv(B)
    x, v = [], []
    for values, trial in zip(states, problem.recordings, strict=True):
        moved = values[1:] - values[:-1] @ plant.A.T - trial.disturbance[:-1] @ plant.E.T
        commands = moved @ back.T
        size = max(float(np.max(np.abs(values))), 1e-300)
        if np.linalg.norm(moved - commands @ B.T) > _FOLLOWS * size:
            return None  # not what this plant can do
        kept = _inside(problem, commands * sizes)
        kept &= np.linalg.norm(values[:-1], axis=1) > _NOTHING * size
        # A decaying trial has many small samples: each counts by the root of its size.
        weight = np.sqrt(np.linalg.norm(values[:-1][kept], axis=1))[:, None]
        x.append(values[:-1][kept] / weight)
        v.append(commands[kept] / weight)
    feedback = _consensus(np.concatenate(x), np.concatenate(v))
    return None if feedback is None else -(feedback.T * sizes[:, None])


def _consensus(x: Array, v: Array) -> Array | None:
    """The linear function (n, m) of x (k, n) that most of v (k, m) follow exactly, if many do."""
    count, n = x.shape
    if count < n + _MORE:
        return None
    first = np.arange(0, count - n + 1, max(1, (count - n + 1) // _MOST))
    anywhere = np.random.default_rng(0).integers(count, size=(_MOST, n))
    sets = np.concatenate([first[:, None] + np.arange(n), anywhere])
    sets = sets[np.linalg.cond(x[sets]) < 1 / _EXACT]
    functions = np.linalg.solve(x[sets], v[sets])
    limit = _EXACT * np.max(np.linalg.norm(v, axis=1))
    follow = np.array([np.linalg.norm(v - x @ one, axis=1) <= limit for one in functions])
    most = follow[int(np.argmax(np.sum(follow, axis=1)))] if len(follow) else np.zeros(count, bool)
    if np.count_nonzero(most) < n + _MORE:
        return None
    return np.asarray(np.linalg.lstsq(x[most], v[most])[0])


def _inside(problem: Problem, commands: Array) -> BoolArray:
    """Samples at which no command is at its bound; at some of them a later one of the plan is."""
    low, high = np.array(problem.bounds.u_min), np.array(problem.bounds.u_max)
    margin = _AT_BOUND * np.max(np.abs(commands), axis=0, initial=1e-300)
    return np.asarray(np.all((commands > low + margin) & (commands < high - margin), axis=1))
