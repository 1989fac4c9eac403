"""Starts of a search: regulators by Bryson's rule, random ones, and the gain of inactive samples.

At a sample where no bound is active over the horizon, the controller is the linear gain:

    x_{k+1} - A x_k - E d_k  =  -B K x_k

If all states are recorded without noise, any n such samples give B K exactly. Candidate sets (runs
of consecutive samples and random sets) are accepted by consensus: the number of other samples that
satisfy the same equation (docs/why/theory.md).
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np

from impc.arrays import Array, BoolArray
from impc.errors import WeightsError
from impc.inverse.metric_family import fitted_metric, metric_family
from impc.inverse.prediction import command_sizes
from impc.inverse.problem import Problem, recorded_states
from impc.inverse.solution_set import natural_coordinates
from impc.model.riccati import LqrSolution, solve_lqr
from impc.model.weights import Weights, normalised

# Cost weight of unobserved states relative to the others.
_UNSEEN = 1e-8
# Command weights relative to that of the balanced regulator.
_EFFORTS = 10.0 ** np.arange(-4, 5)
# Random weights: share of the identity, and decades of the command weight either way.
_DEFINITE, _DECADES = 0.05, 2.0
# Sizes of drawn initial states, relative to those of the recorded outputs, in turn.
_REACHES = (1.0, 3.0)


def balanced_regulator(problem: Problem, effort: float = 1.0) -> LqrSolution:
    """Regulator with R = effort diag(1/u^2), u the command sizes, and Q = C'diag(1/y^2)C."""
    plant, scale = problem.plant, np.asarray(problem.output_scale)
    Q = plant.C.T @ np.diag(1 / scale**2) @ plant.C
    Q += _UNSEEN * np.trace(Q) / plant.n * np.eye(plant.n)
    R = effort * np.diag(1 / command_sizes(problem) ** 2)
    return solve_lqr(plant, normalised(Weights(Q, R)))


def regulators(problem: Problem) -> list[LqrSolution]:
    """Balanced regulators over eight decades of effort, the plain one first."""
    found: list[LqrSolution] = []
    refused: list[WeightsError] = []
    for effort in sorted(_EFFORTS, key=lambda one: abs(np.log(one))):
        try:
            found.append(balanced_regulator(problem, effort))
        except WeightsError as error:  # R is lost in rounding next to B'PB
            refused.append(error)
    if not found:
        raise refused[0]
    return found


def drawn_starts(problem: Problem, seed: int = 0) -> Iterator[tuple[Problem, LqrSolution]]:
    """Random regulators, with random initial states where the outputs do not observe them."""
    plant, rng = problem.plant, np.random.default_rng(seed)
    T, _ = natural_coordinates(plant, np.array(balanced_regulator(problem).K))
    # Unit of states in which the outputs have their recorded size.
    natural = float(np.linalg.norm(problem.scaled_outputs @ T))
    sizes = T * (np.sqrt(len(plant.outputs)) / natural if natural > 0 else 1.0)
    unseen = np.eye(plant.n) - np.linalg.pinv(plant.C) @ plant.C
    unseen[problem.searched_states :] = 0.0
    for reach in itertools.cycle(_REACHES):
        try:
            regulator = solve_lqr(plant, _random_weights(sizes, command_sizes(problem), rng))
        except WeightsError:  # ill-conditioned draw
            continue
        there = problem
        if problem.unknown_start:
            drawn = rng.standard_normal((len(problem.recordings), plant.n)) @ sizes.T @ unseen.T
            drawn *= reach
            there = problem.at(problem.starts + drawn, np.array(problem.logarithms))
        yield there, regulator


def _random_weights(sizes: Array, commands: Array, rng: np.random.Generator) -> Weights:
    """Random weights of states and commands relative to their sizes."""
    parts = []
    for size in (len(sizes), len(commands)):
        L = np.tril(rng.standard_normal((size, size)))
        parts.append(L @ L.T + _DEFINITE * np.eye(size))
    back, unit = np.linalg.inv(sizes), np.diag(1 / commands)
    R = 10 ** rng.uniform(-_DECADES, _DECADES) * unit @ parts[1] @ unit
    Q = back.T @ parts[0] @ back
    return normalised(Weights((Q + Q.T) / 2, (R + R.T) / 2))


# Relative to the largest command: distance to the bound that counts as at it, and residual.
_AT_BOUND, _EXACT = 1e-6, 1e-8
# Relative to the states: motion that the plant cannot produce, and the least usable state.
_FOLLOWS, _NOTHING = 1e-7, 1e-9
# Candidate sets of each kind, and how many other samples must satisfy the same gain.
_MOST, _MORE = 500, 3


def pair_of_inactive_samples(problem: Problem) -> tuple[Array, Array] | None:
    """Gain (m, n) and metric (m, m) of noise-free recordings of all states, else None."""
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
    """Gain (m, n) that most samples follow; redundant inputs share by their sizes."""
    plant = problem.plant
    sizes = command_sizes(problem)
    B = plant.B * sizes  # scaled commands
    back = np.linalg.pinv(B)
    x, v = [], []
    for values, trial in zip(states, problem.recordings, strict=True):
        moved = values[1:] - values[:-1] @ plant.A.T - trial.disturbance[:-1] @ plant.E.T
        commands = moved @ back.T
        size = max(float(np.max(np.abs(values))), 1e-300)
        if np.linalg.norm(moved - commands @ B.T) > _FOLLOWS * size:
            return None  # recorded motion is outside the range of B
        kept = _inside(problem, commands * sizes)
        kept &= np.linalg.norm(values[:-1], axis=1) > _NOTHING * size
        # A decaying trial has many small samples: weight each by the square root of its norm.
        weight = np.sqrt(np.linalg.norm(values[:-1][kept], axis=1))[:, None]
        x.append(values[:-1][kept] / weight)
        v.append(commands[kept] / weight)
    feedback = _consensus(np.concatenate(x), np.concatenate(v))
    return None if feedback is None else -(feedback.T * sizes[:, None])


def _consensus(x: Array, v: Array) -> Array | None:
    """Linear map (n, m) from x (k, n) to v (k, m) that most rows satisfy; None if few do."""
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
    """Samples whose command is inside its bounds (later planned ones may not be)."""
    low, high = np.array(problem.bounds.u_min), np.array(problem.bounds.u_max)
    margin = _AT_BOUND * np.max(np.abs(commands), axis=0, initial=1e-300)
    return np.asarray(np.all((commands > low + margin) & (commands < high - margin), axis=1))
