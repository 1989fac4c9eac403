"""Starts of a search: regulators by Bryson's rule, random ones near them, screened ones."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import Array
from impc.errors import WeightsError
from impc.inverse.prediction import command_sizes
from impc.inverse.solution_set import natural_coordinates
from impc.model.riccati import solve_lqr
from impc.model.weights import Weights, normalised

if TYPE_CHECKING:
    from collections.abc import Iterator

    from impc.inverse.problem import Problem
    from impc.model.riccati import LqrSolution

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
